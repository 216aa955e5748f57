"""Fit of an object's own image in one frame: centre, amplitude, background, slopes.

Generalised least squares by Gauss-Newton, with analytic derivatives. What is fitted is the
expected pixel: of a magnitude the Rician mean of the image, of other pixels the image itself. All
pixels weigh alike, but for the correlation that the frames show, softened; the covariance is that
of these weights in the noise as measured, level by level (a sandwich), so that it holds where the
weights are not the best.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import NotConvergedError, ObjectAtBorderError, TemplateMismatchError
from sr_engine.noise import NoiseKind, moments
from sr_engine.signal import SLOPE_SCALES, mixture_precision
from sr_engine.template.image import ObjectImage

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

    mask (n, n): pixels of the patch that count. kind, sigma: of magnitudes, the noise std per
    channel; scale: by how much their variance is more than that. variances (3,): of other pixels
    in air, at the edge and on the plateau, top being its level. correlation, weights: (p, p) of
    the p pixels of the mask, None where the noise is white (weights None: not used). widened:
    factor of the covariance.
    """

    mask: Mask
    kind: NoiseKind
    sigma: float
    variances: Array
    scale: float = 1.0
    top: float = 1.0
    correlation: Array | None = None
    weights: Array | None = None
    widened: float = 1.0

    @classmethod
    def white(cls, mask: Mask, kind: NoiseKind, sigma: float) -> "Metric":
        return cls(mask, kind, sigma, np.full(3, sigma**2))

    def variance(self, signal: Array) -> Array:
        if self.kind == "rician":
            return moments(signal, self.sigma, "rician").variance * self.scale
        air, edge, plateau = self.variances
        return np.interp(signal / self.top, _KNOTS, (air, air, edge, plateau))


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
    surroundings: Array  # (n, n) background and slopes
    residual: Array  # (p,)


def patch_of(frame: Array, centre: Array, size: int) -> Array:
    """(size, size) pixels about a whole pixel at index size//2; beyond the border as at it."""
    rows = np.clip(np.arange(size) - size // 2 + int(centre[0]), 0, frame.shape[0] - 1)
    cols = np.clip(np.arange(size) - size // 2 + int(centre[1]), 0, frame.shape[1] - 1)
    return np.asarray(frame[rows[:, None], cols[None, :]], dtype=float)


def _places(mask: Mask) -> tuple[Array, Array]:
    places = np.argwhere(mask).astype(np.float64) - len(mask) // 2
    return places[:, 0], places[:, 1]


def linear_fit(values: Array, signal: Array, metric: Metric, size: int) -> LinearFit:
    """Amplitude, background and slopes of one patch, its centre known. values, signal: (p,)."""
    row, col = _places(metric.mask)
    expected = moments(signal, metric.sigma, metric.kind)
    basis = np.stack([signal * expected.slope, np.ones(row.size), row, col], axis=1)
    weight = 1 / np.sqrt(metric.variance(signal))
    prior = _prior(np.zeros(6), metric)[_AMPLITUDE:] if metric.kind == "rician" else np.zeros(4)
    weighed = basis * weight[:, None]
    target = values - expected.mean + signal * expected.slope
    system = weighed.T @ weighed + np.diag(prior + 1e-12 * np.sum(weighed**2, axis=0))
    a, b, by_row, by_col = np.linalg.solve(system, weighed.T @ (target * weight))
    x = np.arange(size) - size // 2
    plane = b + by_row * x[:, None] + by_col * x[None, :]
    left = values - moments(a * signal, metric.sigma, metric.kind).mean - plane[metric.mask]
    return LinearFit(float(a), plane, left)


def _prior(parameters: Array, metric: Metric) -> Array:
    """(6,) inverse variances: as in `signal`, slopes are weak or strong, a magnitude's air dark."""
    precision = np.zeros(6)
    slopes = mixture_precision(parameters[4:] / metric.top, SLOPE_SCALES)
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
    row, col = _places(metric.mask)
    parameters = np.zeros(6)
    parameters[:2], parameters[_AMPLITUDE] = start, 1.0
    first = linear_fit(values, image.at(start)[0][metric.mask], metric, image.size)
    parameters[_AMPLITUDE] = max(first.amplitude, 0.05)
    for _ in range(_ITERATIONS):
        signal, d_row, d_col = (part[metric.mask] for part in image.at(parameters[:2]))
        amplitude, background, by_row, by_col = parameters[_AMPLITUDE:]
        expected = moments(amplitude * signal, metric.sigma, metric.kind)
        variance = metric.variance(max(amplitude, 0.05) * signal)
        # alike for all pixels: air is surer, but it is there that a template is least so
        weight = np.full_like(variance, 1 / np.sqrt(float(variance.mean())))
        slope = expected.slope * weight
        jacobian = np.stack(
            [amplitude * d_row * slope, amplitude * d_col * slope, signal * slope,
             weight, row * weight, col * weight], axis=1
        )  # fmt: skip
        residual = (values - expected.mean - background - by_row * row - by_col * col) * weight
        weighed = jacobian if metric.weights is None else metric.weights @ jacobian
        precision = _prior(parameters, metric)
        system = weighed.T @ jacobian + np.diag(precision)
        try:
            inverse = np.linalg.inv(system)
        except np.linalg.LinAlgError:
            raise NotConvergedError("the template has no contrast left") from None
        step = inverse @ (weighed.T @ residual - precision * parameters)
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
    gain = (weighed @ inverse.T) * (np.sqrt(variance) * weight)[:, None]
    spread = gain if metric.correlation is None else metric.correlation @ gain
    standard = residual / (np.sqrt(variance) * weight)
    return _Settled(parameters, gain.T @ spread + np.outer(pull, pull), standard)


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
    noise = metric.sigma if metric.kind == "rician" else float(np.sqrt(metric.variances[-1]))
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
