"""Fit of an object's own image in one frame: centre, amplitude, background, slopes.

Generalised least squares by Gauss-Newton, with analytic derivatives. What is fitted is the
expected pixel: of a magnitude the Rician mean of the image, of other pixels the image itself. All
pixels weigh alike, but for the correlation that the frames show, softened; the covariance is that
of these weights in the noise as measured, level by level (a sandwich), so that it holds where the
weights are not the best.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import NotConvergedError, ObjectAtBorderError, TemplateMismatchError
from sr_engine.noise import NoiseKind
from sr_engine.signal import SLOPE_SCALES, mixture_precision
from sr_engine.template.correlation import Colour
from sr_engine.template.image import ObjectImage
from sr_engine.template.magnitude import Expected, expected

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ITERATIONS = 25
_LONGEST_STEP_PX = 0.7
_SETTLED_SIGMA = 0.01  # of the centre
_BACKGROUND_SCALE = 0.02  # of the highest signal: what a magnitude's air differs by
_KNOTS = (0.0, 0.15, 0.4, 0.8)  # of the highest signal, between which the variance runs
_GROSS = 6.0  # chi2 a pixel at which a frame is of something else
_ROW, _COL, _AMPLITUDE, _BACKGROUND = range(4)


@dataclass(frozen=True, eq=False)
class Metric:
    """How the pixels of a frame scatter about the template.

    mask (n, n): pixels of the patch that count. kind "rician": magnitudes of so many channels, of
    noise std sigma each; "gaussian": other pixels. scales (3,): variance of air, edge and plateau,
    top being its level, over that of the magnitudes, or as it is. slope: std of the surroundings'
    slopes, of top a pixel. colour: correlation of the noise at the object's edge, None where it is
    white; weighing: of all pixels, where the fit heeds it. widened: factor of the
    covariance.
    """

    mask: Mask
    kind: NoiseKind
    sigma: float
    scales: Array
    channels: float = 1.0
    top: float = 1.0
    slope: float = SLOPE_SCALES[0]
    colour: Colour | None = None
    weighing: Colour | None = None
    widened: float = 1.0

    @classmethod
    def white(cls, mask: Mask, sigma: float, channels: float | None) -> "Metric":
        """Of magnitudes of so many channels, or of other pixels (None)."""
        if channels is None:
            return cls(mask, "gaussian", sigma, np.full(3, sigma**2))
        return cls(mask, "rician", sigma, np.ones(3), channels)

    def expected(self, signal: Array) -> Expected:
        """Of pixels (p,) of the noise-free image, not negative where they are magnitudes."""
        if self.kind == "rician":
            mean, slope, variance = expected(signal, self.sigma, self.channels)
        else:
            mean, slope, variance = signal, np.ones_like(signal), np.ones_like(signal)
        air, edge, plateau = self.scales
        scale = np.interp(signal / self.top, _KNOTS, (air, air, edge, plateau))
        return Expected(mean, slope, variance * scale)

    def weighed(self, rows: Array) -> Array:
        """(c, p) rows, as the fit weighs them."""
        return rows if self.weighing is None else self.weighing.weighed(rows.T, self.mask).T

    @cached_property
    def places(self) -> tuple[Array, Array]:
        """(p,) rows and columns of the pixels that count, from the middle of the patch."""
        row, col = np.nonzero(self.mask)
        middle = len(self.mask) // 2
        return row.astype(np.float64) - middle, col.astype(np.float64) - middle

    @cached_property
    def used(self) -> NDArray[np.intp]:
        """(p,) indices of the pixels that count, in the flattened patch."""
        return np.flatnonzero(self.mask)


@dataclass(frozen=True, eq=False)
class TemplateFit:
    """centre_px (row, col) in the frame; covariance_px2: of it, as a displacement.

    residual: (n, n) standardised, 0 where no pixel counts. significance: amplitude over its std.
    """

    centre_px: Array
    covariance_px2: Array
    amplitude: float
    background: float
    sigma: float
    snr: float
    chi2_per_dof: float
    significance: float
    residual: Array


class LinearFit(NamedTuple):
    amplitude: float
    slopes: Array  # (2,) by row and column
    slope_variance: float
    surroundings: Array  # (n, n) background and slopes
    residual: Array  # (p,)


def patch_of(frame: Array, centre: Array, size: int) -> Array:
    """(size, size) pixels about a whole pixel at index size//2; beyond the border as at it."""
    rows = np.clip(np.arange(size) - size // 2 + int(centre[0]), 0, frame.shape[0] - 1)
    cols = np.clip(np.arange(size) - size // 2 + int(centre[1]), 0, frame.shape[1] - 1)
    return np.asarray(frame[rows[:, None], cols[None, :]], dtype=float)


def linear_fit(values: Array, signal: Array, metric: Metric) -> LinearFit:
    """Amplitude, background and slopes of a given image (p,) in the pixels (p,) of the mask."""
    shown = metric.expected(signal)
    basis, system = _linear_system(signal, shown, metric)
    target = basis @ ((values - shown.mean + basis[0]) / shown.variance)
    inverse = np.linalg.inv(system)
    a, b, by_row, by_col = inverse @ target
    x = np.arange(len(metric.mask)) - len(metric.mask) // 2
    plane = b + by_row * x[:, None] + by_col * x[None, :]
    again = metric.expected(max(float(a), 0.0) * signal)
    left = values - again.mean - plane[metric.mask]
    slopes, variance = np.array([by_row, by_col]), float(np.diag(inverse)[2:].mean())
    return LinearFit(float(a), slopes, variance, plane, left)


def _linear_system(signal: Array, shown: Expected, metric: Metric) -> tuple[Array, Array]:
    row, col = metric.places
    basis = np.stack([signal * shown.slope, np.ones(row.size), row, col])
    prior = np.zeros(4)
    if metric.kind == "rician":
        prior[1] = 1 / (_BACKGROUND_SCALE * metric.top) ** 2
    system = (basis / shown.variance) @ basis.T
    system.flat[::5] += prior + 1e-12 * system.diagonal()
    return basis, system


def taken_by_fit(signal: Array, metric: Metric) -> Array:
    """(p, 4) T: a linear fit takes T T' of the standardised pixels."""
    shown = metric.expected(signal)
    basis, system = _linear_system(signal, shown, metric)
    lower = np.linalg.cholesky(system)
    return np.asarray(np.linalg.solve(lower, basis / np.sqrt(shown.variance)).T)


def _prior(parameters: Array, metric: Metric) -> Array:
    """(6,) inverse variances: slopes as the template's frames have them, or strong as in `signal`;
    a magnitude's air is dark."""
    precision = np.zeros(6)
    slopes = mixture_precision(parameters[4:] / metric.top, (metric.slope, SLOPE_SCALES[1]))
    precision[4:] = slopes / metric.top**2
    if metric.kind == "rician":
        precision[_BACKGROUND] = 1 / (_BACKGROUND_SCALE * metric.top) ** 2
    return precision


def fit_image(frame: Array, image: ObjectImage, metric: Metric, start_px: Array) -> TemplateFit:
    """The image in a frame (rows, cols), begun within about a pixel of start_px.

    Raises ObjectAtBorderError, NotConvergedError, and TemplateMismatchError where what is there
    is not what the template shows.
    """
    whole = np.rint(start_px)
    _refuse_border(whole, frame, metric)
    fit = None
    for _ in range(3):  # the patch follows the object
        values = patch_of(frame, whole, image.size)[metric.mask]
        fit = _settled(values, image, metric, start_px - whole)
        centre = whole + fit.parameters[:2]
        if np.all(np.abs(fit.parameters[:2]) <= 0.75):
            break
        start_px, whole = centre, np.rint(centre)
        _refuse_border(whole, frame, metric)
    assert fit is not None
    return _summary(fit, whole, metric)


def _refuse_border(whole: Array, frame: Array, metric: Metric) -> None:
    reach = int(np.ceil(np.sqrt(np.count_nonzero(metric.mask) / np.pi)))
    for name, at, n in zip(("row", "col"), whole, frame.shape, strict=True):
        if not reach / 2 <= at <= n - 1 - reach / 2:
            raise ObjectAtBorderError(
                f"the object at {name} {at:.0f} is cut by the border of {n} {name}s"
            )


@dataclass(frozen=True, eq=False)
class _Settled:
    parameters: Array
    covariance: Array  # (6, 6), less what widens it
    residual: Array


def _settled(values: Array, image: ObjectImage, metric: Metric, start: Array) -> _Settled:
    row, col = metric.places
    parameters = np.zeros(6)
    parameters[:2] = start
    parts = image.at(start)
    first = linear_fit(values, parts[0].take(metric.used), metric)
    parameters[_AMPLITUDE] = max(first.amplitude, 0.05)
    jacobian = np.empty((6, values.size))
    for number in range(_ITERATIONS):
        parts = parts if number == 0 else image.at(parameters[:2])
        signal, d_row, d_col = (part.take(metric.used) for part in parts)
        amplitude, background, by_row, by_col = parameters[_AMPLITUDE:]
        shown = metric.expected(max(amplitude, 0.05) * signal)
        # alike for all pixels: air is surer, but it is there that a template is least so
        weight = 1 / np.sqrt(float(shown.variance.mean()))
        slope = shown.slope * weight
        jacobian[:3] = amplitude * d_row, amplitude * d_col, signal
        jacobian[:3] *= slope
        jacobian[3], jacobian[4], jacobian[5] = weight, row * weight, col * weight
        residual = (values - shown.mean - background - by_row * row - by_col * col) * weight
        weighed = metric.weighed(jacobian)
        precision = _prior(parameters, metric)
        try:
            inverse = np.linalg.inv(weighed @ jacobian.T + np.diag(precision))
        except np.linalg.LinAlgError:
            raise NotConvergedError("the template has no contrast left") from None
        step = inverse @ (weighed @ residual - precision * parameters)
        longest = float(np.max(np.abs(step[:2])))
        if not np.all(np.isfinite(step)):
            raise NotConvergedError("the template has no contrast left")
        step = step * min(1.0, _LONGEST_STEP_PX / max(longest, 1e-12))
        parameters = parameters + step
        if not np.all(np.abs(parameters[:2]) < 4.0):
            raise NotConvergedError("the template fit diverged from its start")
        if longest < _SETTLED_SIGMA * float(np.sqrt(inverse[0, 0])):
            break
    else:
        raise NotConvergedError(f"the template fit did not converge in {_ITERATIONS} steps")
    pull = inverse @ (precision * parameters)
    spread = np.sqrt(shown.variance) * weight
    gain = (inverse @ weighed * spread).T
    both = gain if metric.colour is None else metric.colour.correlated(gain, metric.mask)
    return _Settled(parameters, gain.T @ both + np.outer(pull, pull), residual / spread)


def _summary(fit: _Settled, whole: Array, metric: Metric) -> TemplateFit:
    n = fit.residual.size
    chi2 = float(fit.residual @ fit.residual) / (n - 6)
    amplitude = float(fit.parameters[_AMPLITUDE])
    if not (chi2 < _GROSS and amplitude > 0):
        raise TemplateMismatchError(
            f"the object at row {whole[0]:.0f}, col {whole[1]:.0f} is not the template's object "
            f"(chi2 {chi2:.1f} per pixel, amplitude {amplitude:.2f} of the template's)"
        )
    grown = metric.widened * max(1.0, chi2 if chi2 > 1 + 4 * np.sqrt(2 / n) else 1.0)
    noise = float(np.sqrt(metric.scales[-1])) * (metric.sigma if metric.kind == "rician" else 1.0)
    residual = np.zeros(metric.mask.shape)
    residual[metric.mask] = fit.residual
    return TemplateFit(
        centre_px=whole + fit.parameters[:2],
        covariance_px2=fit.covariance[:2, :2] * grown,
        amplitude=amplitude * metric.top,
        background=float(fit.parameters[_BACKGROUND]),
        sigma=noise,
        snr=amplitude * metric.top / noise,
        chi2_per_dof=chi2,
        significance=amplitude / float(np.sqrt(fit.covariance[_AMPLITUDE, _AMPLITUDE])),
        residual=residual,
    )
