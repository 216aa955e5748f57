"""The fiducial's own image as the template: learnt at known displacements, for any shape.

Where it is known how the object was displaced from frame to frame, its image follows (see
`image`), and every frame can be fitted with that image instead of with a disc. The frames
also show what remains: the noise's size at every level of signal, its correlation, and whether they
were displaced as is said.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.checks import checked_frames, checked_shifts
from sr_engine.errors import EngineError, TemplateError
from sr_engine.template.correlation import Colour, Lags, believed, lag_correlation
from sr_engine.template.fit import (
    Metric,
    TemplateFit,
    fit_image,
    linear_fit,
    patch_of,
    taken_by_fit,
)
from sr_engine.template.image import (
    Averaged,
    ObjectImage,
    Views,
    averaged_image,
    magnitude_image,
)
from sr_engine.template.magnitude import channels_of_air
from sr_engine.template.middle import absolute_centre, outline_middle
from sr_engine.template.moving import Moving, moving_object
from sr_engine.template.search import find_object

Array = NDArray[np.float64]

LEAST_FRAMES = 3
MARGIN_PX = 4.0  # about the object, fitted with it; half its radius where that is more
TAPER_PX = 5.0  # beyond, in which the image is let fade
LARGEST_MARGIN_PX = 8.0
LAGS_PX = 4  # over which noise may be correlated
_ROUNDS = 2
_LEVELS = (0.12, 0.75)  # of the highest signal: air, edge and plateau have their own noise
_LEAST_CHANCE = 0.8  # of the covariance: scatter that is smaller than that is luck
_LEVEL_PIXELS = 300.0  # what the noise of all levels weighs, beside that of one
_LEAST_LEVEL_PIXELS = 30.0  # the same, of pixels that are no magnitudes
_MAGNITUDES, _NO_MAGNITUDES = 1.4, 2.5  # unevenness: below they are, beyond they are none
_MOST_SCATTER = 12.0  # chi2 a degree of freedom of the displacements: more is no chance
_MOST_ALONE = 36.0  # of the others' chi2 that is usual: one in 10^7 frames by chance
_LEAST_NOISE = 0.05  # of the noise power at any frequency: none is without
_PRIOR_FRAMES = 10.0  # what the pixels' own account of the noise weighs, in frames
_LEAST_VARIANCE = 0.1  # of a level's noise, over that of all: denoised air is not sure
_LEAST_WEIGHT = 0.1  # of a pixel away from the edge, where correlation is measured
_LEAST_SLOPE = 2e-4  # of the highest signal, a pixel: surroundings are never quite even
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
    shifts_are_fitted: bool = False,
) -> Template:
    """Learn the image of the object that moves by shifts_px.

    frames (M, rows, cols) of one size; shifts_px (M, 2) displacement (row, col) of the object in
    each from the reference pose. radius_px: least and largest radius of its outline. centre_px:
    where it is in the reference pose, to a pixel; else it is looked for: the one compact thing
    that moves as is said. shift_sigma_px: std per axis of a shift. shifts_are_fitted: they
      were found in these very frames, so that the frames agree with them better than others will.
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
    seen = _begun(stack, found, shifts)
    learnt = _learnt(seen, seen.channels)
    if seen.channels is not None and learnt.unevenness > _MAGNITUDES:
        others = _learnt(seen, None)
        if learnt.unevenness > _NO_MAGNITUDES or others.misfit < learnt.misfit:
            learnt = others
    least = 1.0 if shifts_are_fitted else _LEAST_CHANCE
    return _checked(learnt, seen.found, stack, shifts, shift_sigma_px, least)


@dataclass(frozen=True, eq=False)
class _Seen:
    """The patches about the object, and a first account of it.

    found: its origin moved to the middle of its outline. amplitudes (M,), surroundings (M, n, n) of
    the patches. channels: of the magnitudes that the air speaks for; None for other pixels.
    """

    found: Moving
    views: Views
    mask: NDArray[np.bool_]
    surroundings: Array
    channels: float | None
    air_power: float


@dataclass(frozen=True, eq=False)
class _Learnt:
    averaged: Averaged
    metric: Metric
    misfit: float  # mean square of what the others leave of each frame

    @property
    def unevenness(self) -> float:
        """How many times more noise there is at one level of the signal than at another.

        Of magnitudes of some channels it is even: else something was done to them.
        """
        return float(self.metric.scales.max() / self.metric.scales.min())


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


def _distance(size: int, offset: Array | None = None) -> Array:
    x = np.arange(size) - size // 2
    row, col = (0.0, 0.0) if offset is None else offset
    return np.asarray(np.hypot(x[:, None] - row, x[None, :] - col))


def _window(size: int, offset: Array, reach: float) -> Array:
    """1 within reach of the object, falling to 0 at the border of the patch."""
    inner, outer = reach + 0.5, size // 2 - 1.0
    share = np.clip((_distance(size, offset) - inner) / (outer - inner), 0, 1)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * share))


def _begun(stack: Array, found: Moving, shifts: Array) -> _Seen:
    patches, offsets = _patches(stack, found, shifts)
    image = averaged_image(_views(patches, offsets, found)).image
    middle = outline_middle(image, found.radius_px)  # what is round is so about its middle
    found = replace(found, centre_px=found.centre_px + middle)
    patches, offsets = _patches(stack, found, shifts)
    views = _views(patches, offsets, found)
    reach = _geometry(found.radius_px)[0]
    mask = _distance(patches.shape[1]) <= reach
    averaged = averaged_image(views)
    metric = replace(Metric.white(mask, views.sigma, None), top=_top(averaged.shown, mask))
    amplitudes, surroundings, *_ = _levels_of(patches, averaged.shown, metric)
    views = replace(views, patches=patches, amplitudes=amplitudes / amplitudes.mean())
    air = patches[:, ~mask]
    return _Seen(found, views, mask, surroundings, channels_of_air(air), float(np.mean(air**2)))


def _views(patches: Array, offsets: Array, found: Moving) -> Views:
    """The patches less the level about the object."""
    size = patches.shape[1]
    reach = _geometry(found.radius_px)[0]
    air = patches[:, _distance(size) > reach]
    levels = np.median(air, axis=1)
    spread = 1.4826 * float(np.median(np.abs(air - levels[:, None])))
    return Views(
        patches=patches - levels[:, None, None],
        offsets_px=offsets,
        windows=np.array([_window(size, offset, reach) for offset in offsets]),
        amplitudes=np.ones(len(patches)),
        sigma=max(spread, 1e-6 * float(np.ptp(patches)), 1e-12),
        noise_power=np.ones((size, size)),
    )


def _top(images: Array, mask: NDArray[np.bool_]) -> float:
    return max(float(np.percentile(images[:, mask], 97)), 1e-12)


def _levels_of(patches: Array, shown: Array, metric: Metric) -> tuple[Array, Array, Array, float]:
    """Amplitudes (M,), surroundings (M, n, n), what is left (M, n, n) of the patches, and the
    slopes of the surroundings, std relative to the highest signal."""
    mask = metric.mask
    fits = [
        linear_fit(patch[mask], signal[mask], metric)
        for patch, signal in zip(patches, shown, strict=True)
    ]
    amplitudes = np.array([fit.amplitude for fit in fits])
    if not np.all(amplitudes > 0.05 * np.median(amplitudes)) or amplitudes.mean() <= 0:
        raise TemplateError(
            "no common image: the frames do not show one object at the given displacements"
        )
    left = np.zeros_like(patches)
    left[:, mask] = [fit.residual for fit in fits]
    slopes = np.mean([np.mean(fit.slopes**2) - fit.slope_variance for fit in fits])
    slope = max(float(np.sqrt(max(slopes, 0.0))) / metric.top, _LEAST_SLOPE)
    return amplitudes, np.array([fit.surroundings for fit in fits]), left, slope


def _learnt(seen: _Seen, channels: float | None) -> _Learnt:
    views, surroundings = seen.views, seen.surroundings
    patches = views.patches
    if channels is not None:
        sigma = float(np.sqrt(seen.air_power / (2 * channels)))
        views = replace(views, sigma=max(sigma, 1e-6 * float(np.ptp(patches)), 1e-12))
    metric = Metric.white(seen.mask, views.sigma, channels)
    start: NDArray[np.complex128] | None = None
    for _ in range(_ROUNDS):
        if channels is None:
            averaged = averaged_image(replace(views, patches=patches - surroundings))
        else:
            averaged = magnitude_image(views, channels, seen.found.radius_px, start)
        metric = replace(metric, top=_top(averaged.shown, seen.mask))
        amplitudes, surroundings, left, slope = _levels_of(patches, averaged.shown, metric)
        metric = replace(metric, slope=slope)
        mean = float(amplitudes.mean())
        averaged = averaged.scaled(mean)
        start = averaged.image.spectrum
        metric = _measured(metric, left, averaged.shown, averaged.extra)
        power = views.noise_power if metric.weighing is None else metric.weighing.power
        views = replace(
            views, amplitudes=amplitudes / mean, noise_power=np.maximum(power, _LEAST_NOISE)
        )
        if channels is None:
            views = replace(views, sigma=float(np.sqrt(np.mean(metric.scales))))
    return _Learnt(averaged, metric, float(np.mean(left[:, seen.mask] ** 2)))


def _measured(metric: Metric, left: Array, shown: Array, extra: float) -> Metric:
    """The metric with the noise that is left of frames when the others are taken away."""
    mask = metric.mask
    pixels = shown[:, mask]
    metric = replace(metric, top=_top(shown, mask), scales=np.ones(3))
    squares = left[:, mask] ** 2 / (metric.expected(pixels).variance * (1 + extra))
    level = np.digitize(pixels / metric.top, _LEVELS)
    prior = _LEVEL_PIXELS if metric.kind == "rician" else _LEAST_LEVEL_PIXELS
    overall = float(squares.mean())
    counts, sums = np.zeros(3), np.zeros(3)
    for i in range(3):
        counts[i], sums[i] = np.count_nonzero(level == i), squares[level == i].sum()
    scales = (sums + prior * overall) / (counts + prior)
    scales = np.maximum(scales, _LEAST_VARIANCE * overall + 1e-12 * metric.top**2)
    metric = replace(metric, scales=scales)
    standard = np.zeros_like(left)
    standard[:, mask] = left[:, mask] / np.sqrt(metric.expected(pixels).variance)
    taken = taken_by_fit(pixels.mean(axis=0), metric)
    colours, lost = [], 1.0
    for weights in (_at_edge(shown, mask), mask.astype(np.float64)):
        lost, table, error = lag_correlation(standard, Lags(weights, LAGS_PX), taken)
        lags = believed(table, error)
        colours.append(None if lags is None else Colour.of_lags(lags, len(mask)))
    return replace(metric, scales=scales * lost, colour=colours[0], weighing=colours[1])


def _at_edge(shown: Array, mask: NDArray[np.bool_]) -> Array:
    """(n, n) how steep the image is on average, 1 at most; a little everywhere in the mask."""
    by_row, by_col = np.gradient(shown, axis=(1, 2))
    steep = np.hypot(by_row, by_col).mean(axis=0)
    return np.where(mask, np.maximum(steep / steep[mask].max(), _LEAST_WEIGHT), 0.0)


def _weighings(metric: Metric) -> list[Metric]:
    """The ways to weigh the pixels: alike, and by their correlation where there is any."""
    plain = replace(metric, weighing=None)
    return [plain] if metric.weighing is None else [plain, metric]


def _checked(
    learnt: _Learnt,
    found: Moving,
    stack: Array,
    shifts: Array,
    shift_sigma_px: float,
    least_widened: float,
) -> Template:
    """The template, with the weights that place its own frames best.

    What a weighing promises and what the frames show are taken together, so that weights that
    promise much for a noise that is not as they take it lose to those that promise less.
    """
    ways = []
    errors: list[EngineError] = []
    for metric in _weighings(learnt.metric):
        try:
            ways.append(_placed(learnt.averaged, metric, found, stack, shifts, shift_sigma_px))
        except TemplateError:
            raise
        except EngineError as error:
            errors.append(error)
    if not ways:
        raise TemplateError(f"the frames do not show one object: {errors[0]}")
    best = ways[0]
    for way in ways[1:]:
        # weights whose promise the scatter keeps less well are not the noise's own
        if way.variance_px2 < best.variance_px2 and way.chi2 < best.chi2:
            best = way
    _refuse_scattered(best)
    widened = max(least_widened, best.ratio)
    metric = replace(best.metric, widened=widened)
    count = len(stack)
    common = (best.mean_px2 * widened + np.eye(2) * shift_sigma_px**2) / count
    image = learnt.averaged.image
    middle, systematic = absolute_centre(image, found.radius_px)
    return Template(
        image=image,
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
    """The template's own frames, each placed by the others: how far from their displacements."""

    metric: Metric
    apart_px: Array  # (M, 2) less the mean
    squares: Array  # (M,) over what is expected
    mean_px2: Array  # (2, 2) mean covariance

    @property
    def dof(self) -> int:
        return 2 * len(self.squares) - 2

    @property
    def chi2(self) -> float:
        """A degree of freedom."""
        return float(self.squares.sum()) / self.dof

    @property
    def variance_px2(self) -> float:
        return float(np.trace(self.mean_px2)) * self.ratio

    @property
    def ratio(self) -> float:
        """Scatter over what is expected, 1 where there are few frames to tell it."""
        prior = 2 * _PRIOR_FRAMES
        return float((prior + self.squares.sum()) / (prior + self.dof))


def _placed(
    averaged: Averaged,
    metric: Metric,
    found: Moving,
    stack: Array,
    shifts: Array,
    shift_sigma_px: float,
) -> _Placed:
    fits = []
    for number, (frame, shift) in enumerate(zip(stack, shifts, strict=True)):
        fit = fit_image(frame, averaged.leaving_out(number), metric, found.centre_px + shift)
        if not fit.significance > _LEAST_SIGNIFICANCE:
            raise TemplateError(f"frame {number} does not show the same object as the others")
        fits.append(fit)
    apart = np.array([fit.centre_px for fit in fits]) - shifts - found.centre_px
    apart = apart - apart.mean(axis=0)
    covariances = np.array([fit.covariance_px2 for fit in fits])
    # what the others have in common is uncertain by the share of one of them
    expected = (covariances + np.eye(2) * shift_sigma_px**2) * len(fits) / (len(fits) - 1)
    squares = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(expected), apart)
    return _Placed(metric, apart, squares, np.asarray(covariances.mean(axis=0)))


def _refuse_scattered(placed: _Placed) -> None:
    scatter = placed.chi2
    typical = max(float(np.median(placed.squares)), 1.0) / (2 * np.log(2))
    # what one wrong displacement leaves is taken for noise in part, in all frames alike
    if not (scatter < _MOST_SCATTER and placed.squares.max() < _MOST_ALONE * typical):
        worst = int(np.argmax(placed.squares))
        row, col = placed.apart_px[worst]
        raise TemplateError(
            f"the frames disagree with their displacements (chi2 {scatter:.0f} per degree of "
            f"freedom), worst in frame {worst}, by row {row:+.3f} col {col:+.3f} px: the "
            "displacements are wrong, or the object moved differently"
        )
