"""The fiducial's own image as the template: learnt at known displacements, for any shape.

Where it is known how the object was displaced from frame to frame, its image follows (see
`image`), and every frame can be fitted with that image instead of with a disc. The frames
also show what remains: the noise's size at every level of signal, its correlation, and whether they
were displaced as is said.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.checks import checked_frames, checked_shifts
from sr_engine.errors import EngineError, TemplateError
from sr_engine.noise import NoiseKind
from sr_engine.template.correlation import (
    believed,
    correlation_matrix,
    lag_correlation,
    weight_matrix,
)
from sr_engine.template.fit import Metric, TemplateFit, fit_image, linear_fit, patch_of
from sr_engine.template.image import ObjectImage, Views, averaged_image, magnitude_image
from sr_engine.template.middle import absolute_centre
from sr_engine.template.moving import Moving, moving_object
from sr_engine.template.search import find_object

Array = NDArray[np.float64]

LEAST_FRAMES = 3
MARGIN_PX = 4.0  # about the object, fitted with it; half its radius where that is more
TAPER_PX = 5.0  # beyond, in which the image is let fade
LARGEST_MARGIN_PX = 8.0
LAGS_PX = 4  # over which noise may be correlated
_ROUNDS = 3
_LEVELS = (0.12, 0.75)  # of the highest signal: air, edge and plateau have their own noise
_AIR_RATIO = (np.pi / 4, 0.03)  # mean squared over mean square of Rayleigh noise, and how near
_MOST_SCATTER = 12.0  # chi2 a degree of freedom of the displacements: more is no chance
_PRIOR_FRAMES = 10.0  # what the pixels' own account of the noise weighs, in frames
_LEAST_VARIANCE = 0.1  # of a level's noise, over that of all: denoised air is not sure
_LEAST_SIGNIFICANCE = 8.0  # of the amplitude


@dataclass(frozen=True, eq=False)
class Template:
    """The image of one object, and the noise of its frames.

    reference_px: where the object is in the reference pose (row, col); radius_px: of the disc of
      its outline's area. common_px2 (2, 2): how uncertain the template's own place is; it is
      common to all that is localized by it, so it cancels in displacements. middle_px: from the
      template's origin to the middle of the outline; systematic_px: how far that may be wrong,
      std (row, col), likewise common to all.
    """

    image: ObjectImage
    metric: Metric
    reference_px: Array
    radius_px: float
    common_px2: Array
    middle_px: Array
    systematic_px: Array
    n_frames: int

    def fit(
        self,
        frame: ArrayLike,
        start_px: ArrayLike | None = None,
        region: tuple[int, int, int, int] | None = None,
    ) -> TemplateFit:
        """The object in one frame (rows, cols), its centre the middle of its outline.

        start_px: where it is, to within a pixel or two; without, it is looked for in region (r0,
        c0, r1, c1) or everywhere. Raises an EngineError where it is not there.
        """
        pixels = checked_frames(frame)[0]
        if start_px is None:
            begin = find_object(pixels, self.image, self.metric, region)
        else:
            begin = np.asarray(start_px, float) - self.middle_px
        fit = fit_image(pixels, self.image, self.metric, begin)
        return replace(fit, centre_px=fit.centre_px + self.middle_px)


def learn_template(
    frames: ArrayLike,
    shifts_px: ArrayLike,
    *,
    radius_px: tuple[float, float] | None = None,
    centre_px: ArrayLike | None = None,
    shift_sigma_px: float = 0.0,
) -> Template:
    """Learn the image of the object that moves by shifts_px.

    frames (M, rows, cols) of one size; shifts_px (M, 2) displacement (row, col) of the object in
    each from the reference pose. radius_px: least and largest radius of its outline. centre_px:
    where it is in the reference pose, to a pixel; else it is looked for: the one compact thing
    that moves as is said. shift_sigma_px: std per axis of a shift.
    Raises TemplateError where the frames do not make a template, and says why.
    """
    stack = checked_frames(frames)
    shifts = checked_shifts(shifts_px, len(stack))
    if len(stack) < LEAST_FRAMES:
        raise TemplateError(
            f"a template needs at least {LEAST_FRAMES} frames at known displacements, got "
            f"{len(stack)}"
        )
    near = None if centre_px is None else np.asarray(centre_px, float)
    found = moving_object(stack, shifts, radius_px, near)
    candidates = [_learnt(stack, found, shifts, kind) for kind in _kinds(stack, found, shifts)]
    best = min(candidates, key=lambda learnt: learnt.misfit)
    return _checked(best, best.found, stack, shifts, shift_sigma_px)


@dataclass(frozen=True, eq=False)
class _Learnt:
    image: ObjectImage
    metric: Metric
    found: Moving  # the object, its origin moved to the middle of its outline
    misfit: float  # mean square of what is left of a frame that the template was not made from


def _geometry(radius: float) -> tuple[float, int]:
    """(reach of the fitted region, size of the patch)."""
    margin = float(np.clip(0.5 * radius, MARGIN_PX, LARGEST_MARGIN_PX))
    return radius + margin, 2 * int(np.ceil(radius + margin + TAPER_PX))


def _patches(stack: Array, found: Moving, shifts: Array) -> tuple[Array, Array]:
    size = _geometry(found.radius_px)[1]
    centres = found.centre_px + shifts
    whole = np.rint(centres)
    patches = np.array([patch_of(f, w, size) for f, w in zip(stack, whole, strict=True)])
    return patches, centres - whole


def _kinds(stack: Array, found: Moving, shifts: Array) -> Sequence[NoiseKind]:
    """Magnitudes show Rayleigh noise where there is no signal; what was processed does not."""
    patches, _ = _patches(stack, found, shifts)
    values = patches[:, _distance(patches.shape[1]) > _geometry(found.radius_px)[0]]
    power = float(np.mean(values**2))
    ratio = float(values.mean() ** 2 / power) if power > 0 else 0.0
    is_air = values.min() >= 0 and abs(ratio - _AIR_RATIO[0]) < _AIR_RATIO[1]
    return ("rician", "gaussian") if is_air else ("gaussian",)


def _distance(size: int, offset: Array | None = None) -> Array:
    x = np.arange(size) - size // 2
    row, col = (0.0, 0.0) if offset is None else offset
    return np.asarray(np.hypot(x[:, None] - row, x[None, :] - col))


def _window(size: int, offset: Array, reach: float) -> Array:
    """1 within reach of the object, falling to 0 at the border of the patch."""
    inner, outer = reach + 0.5, size // 2 - 1.0
    share = np.clip((_distance(size, offset) - inner) / (outer - inner), 0, 1)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * share))


def _learnt(stack: Array, found: Moving, shifts: Array, kind: NoiseKind) -> _Learnt:
    patches, offsets = _patches(stack, found, shifts)
    count, size = patches.shape[:2]
    reach = _geometry(found.radius_px)[0]
    windows = np.array([_window(size, offset, reach) for offset in offsets])
    mask = _distance(size) <= reach
    far = _distance(size) > reach
    air = patches[:, far]
    levels = np.median(air, axis=1)
    spread = 1.4826 * float(np.median(np.abs(air - levels[:, None])))
    sigma = float(np.sqrt(np.mean(air**2) / 2)) if kind == "rician" else spread
    sigma = max(sigma, 1e-6 * float(np.ptp(patches)), 1e-12)
    surroundings = np.zeros_like(patches)
    if kind == "gaussian":
        surroundings = surroundings + levels[:, None, None]
    views = Views(patches, offsets, windows, np.ones(count), sigma, np.ones((size, size)))
    metric = Metric.white(mask, kind, sigma)
    for number in range(_ROUNDS):
        views = replace(views, patches=patches - surroundings, offsets_px=offsets)
        if kind == "rician":
            image = magnitude_image(views, found.radius_px)
        else:
            image = averaged_image(views)
        if number < _ROUNDS - 1:  # what is round is so about its middle
            middle, _ = absolute_centre(image, found.radius_px)
            found = replace(found, centre_px=found.centre_px + middle)
            offsets, image = offsets + middle, image.recentred(middle)
        signals = np.array([image.at(offset)[0] for offset in offsets])
        top = float(np.percentile(signals[:, mask], 97))
        metric = replace(metric, top=max(top, 1e-12))
        fits = [
            linear_fit(patch[mask], signal[mask], metric, size)
            for patch, signal in zip(patches, signals, strict=True)
        ]
        amplitudes = np.array([fit.amplitude for fit in fits])
        if not np.all(amplitudes > 0.05 * np.median(amplitudes)) or amplitudes.mean() <= 0:
            raise TemplateError(
                "no common image: the frames do not show one object at the given displacements"
            )
        mean = float(amplitudes.mean())
        image = replace(image, spectrum=image.spectrum * mean)
        views = replace(views, amplitudes=amplitudes / mean)
        if kind == "gaussian":
            surroundings = np.array([fit.surroundings for fit in fits])
        residuals = np.zeros_like(patches)
        residuals[:, mask] = [fit.residual for fit in fits]
        metric, power = _measured(metric, residuals, signals * mean, image.leverage)
        views = replace(views, noise_power=power)
        if kind == "gaussian":
            views = replace(views, sigma=float(np.sqrt(np.mean(metric.variances))))
    left = np.mean(residuals[:, mask] ** 2) / (1 - image.leverage) ** 2
    return _Learnt(image, metric, found, float(left))


def _measured(
    metric: Metric, residuals: Array, signals: Array, leverage: float
) -> tuple[Metric, Array]:
    """The metric with the noise that the residuals show, and the power spectrum of that noise."""
    mask = metric.mask
    size = len(mask)
    n = int(mask.sum())
    free = max(1 - leverage - 4 / n, 0.2)
    top = float(np.percentile(signals[:, mask], 97))
    squares = residuals[:, mask] ** 2 / free
    if metric.kind == "rician":
        metric = replace(metric, top=top, scale=1.0)
        expected = np.array([metric.variance(signal[mask]) for signal in signals])
        metric = replace(metric, scale=float(np.mean(squares / expected)))
    else:
        level = np.digitize(signals[:, mask] / top, _LEVELS)
        overall = float(squares.mean())
        variances = [
            float(squares[level == i].mean()) if np.count_nonzero(level == i) > 30 else overall
            for i in range(len(_LEVELS) + 1)
        ]
        floor = _LEAST_VARIANCE * overall + 1e-12 * top**2
        metric = replace(metric, top=top, variances=np.maximum(variances, floor))
    standard = np.zeros_like(residuals)
    for one, signal, residual in zip(standard, signals, residuals, strict=True):
        one[mask] = residual[mask] / np.sqrt(metric.variance(signal[mask]) * free)
    table, error = lag_correlation(standard, mask, LAGS_PX)
    table = believed(table, error / np.sqrt(free))
    if np.count_nonzero(table) == 1:
        return replace(metric, correlation=None, weights=None), np.ones((size, size))
    matrix = correlation_matrix(table, mask)
    metric = replace(metric, correlation=matrix, weights=weight_matrix(matrix))
    return metric, _power(table, size)


def _power(table: Array, size: int) -> Array:
    reach = len(table) - 1
    lags = np.zeros((size, size))
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            lags[i, j] = table[abs(i), abs(j)]
    power = np.maximum(np.fft.fft2(lags).real, 0.05)
    return np.asarray(power / power.mean())


def _weighings(metric: Metric) -> list[Metric]:
    """The ways to weigh the pixels: alike, and by their correlation where there is any."""
    plain = replace(metric, weights=None)
    return [plain] if metric.weights is None else [plain, metric]


def _checked(
    learnt: _Learnt, found: Moving, stack: Array, shifts: Array, shift_sigma_px: float
) -> Template:
    """The template, with the weights that place its own frames best.

    What a weighing promises and what the frames show are taken together, so that weights that
    promise much for a noise that is not as they take it lose to those that promise less.
    """
    ways = []
    errors: list[EngineError] = []
    for metric in _weighings(learnt.metric):
        try:
            ways.append(_placed(learnt.image, metric, found, stack, shifts, shift_sigma_px))
        except TemplateError:
            raise
        except EngineError as error:
            errors.append(error)
    if not ways:
        raise TemplateError(f"the frames do not show one object: {errors[0]}")
    best = min(ways, key=lambda way: way.variance_px2)
    _refuse_scattered(best)
    metric = replace(best.metric, widened=best.widened)
    count = len(stack)
    common = (best.mean_px2 * best.widened + np.eye(2) * shift_sigma_px**2) / count
    middle, systematic = absolute_centre(learnt.image, found.radius_px)
    return Template(
        image=learnt.image,
        metric=metric,
        reference_px=found.centre_px + middle,
        radius_px=found.radius_px,
        common_px2=common,
        middle_px=middle,
        systematic_px=np.sqrt(systematic**2 + np.diag(common)),
        n_frames=count,
    )


@dataclass(frozen=True, eq=False)
class _Placed:
    """The template's own frames, placed by it: how far apart from their displacements."""

    metric: Metric
    apart_px: Array  # (M, 2) less the mean
    squares: Array  # (M,) over what is expected
    mean_px2: Array  # (2, 2) mean covariance

    @property
    def dof(self) -> int:
        return 2 * len(self.squares) - 2

    @property
    def widened(self) -> float:
        prior = 2 * _PRIOR_FRAMES
        return max(1.0, float((prior + self.squares.sum()) / (prior + self.dof)))

    @property
    def variance_px2(self) -> float:
        prior = 2 * _PRIOR_FRAMES
        ratio = float((prior + self.squares.sum()) / (prior + self.dof))
        return float(np.trace(self.mean_px2)) * ratio


def _placed(
    image: ObjectImage,
    metric: Metric,
    found: Moving,
    stack: Array,
    shifts: Array,
    shift_sigma_px: float,
) -> _Placed:
    fits = []
    for number, (frame, shift) in enumerate(zip(stack, shifts, strict=True)):
        fit = fit_image(frame, image, metric, found.centre_px + shift)
        if not fit.significance > _LEAST_SIGNIFICANCE:
            raise TemplateError(f"frame {number} does not show the same object as the others")
        fits.append(fit)
    apart = np.array([fit.centre_px for fit in fits]) - shifts - found.centre_px
    apart = apart - apart.mean(axis=0)
    covariances = np.array([fit.covariance_px2 for fit in fits])
    # a frame draws the template after itself by its own share
    expected = covariances * (1 - 1 / len(fits)) + np.eye(2) * shift_sigma_px**2
    squares = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(expected), apart)
    return _Placed(metric, apart, squares, np.asarray(covariances.mean(axis=0)))


def _refuse_scattered(placed: _Placed) -> None:
    scatter = float(placed.squares.sum()) / placed.dof
    if not scatter < _MOST_SCATTER:
        worst = int(np.argmax(placed.squares))
        row, col = placed.apart_px[worst]
        raise TemplateError(
            f"the frames disagree with their displacements (chi2 {scatter:.0f} per degree of "
            f"freedom), worst in frame {worst}, by row {row:+.3f} col {col:+.3f} px: the "
            "displacements are wrong, or the object moved differently"
        )
