"""Maximum-likelihood fit of one round object in one frame, with its covariance.

Model of the noise-free signal, x = pixel - reference pixel:

    m = (A s(pixel - c; R, psf) + B) (1 + b . x) + a . x

c centre, R radius, A amplitude, B background, b relative shading, a slope of the surroundings.
The pixels have the Rician mean and variance that belong to m (or Gaussian ones, from a camera).
Noise that passed a k-space filter is coloured and is whitened with the correlation that the filter
gives it. Solved by Levenberg-Marquardt with analytic derivatives.

Priors, all of mean zero. Unknown shading costs 10 to 25 % of precision, no shading allowed for
costs 0.45 b R in bias; the prior is what is known of coils:
  b   a mixture: typical shading of 0.5 % a pixel, or (one frame in two) strong, of 3 % a pixel
  a   likewise 0.1 %, or 2 %, of |A| + |B| a pixel
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from sr_engine.errors import NotConvergedError
from sr_engine.model import DISC, Patch, Shape, unit_object
from sr_engine.noise import NoiseKind, correlation, is_white, moments, sigma_of
from sr_engine.psf import Psf

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROW, COL, RADIUS, AMPLITUDE, BACKGROUND = range(5)
SLOPES, SHADING = slice(5, 7), slice(7, 9)
N_PARAMETERS = 9

SHADING_SCALES = 0.005, 0.03  # std of the typical and of the strong, relative, per pixel
SLOPE_SCALES = 0.001, 0.02
_BACKGROUND_SCALE = 10.0
_OUTLIER_SIGMA = 4.5
_OUTLIER_NEIGHBOUR_SIGMA = 2.5
_MAX_ITERATIONS = 60
_MAX_ROUNDS = 8
_SETTLED = 1e-5  # last change of chi2, so of 0.003 sigma in any parameter
_WHITE_FLOOR = 0.02  # share of noise power taken as white, so that what was never sampled is finite


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixels of a region of interest: values (rows, cols), and which of them count."""

    patch: Patch
    values: Array
    mask: Mask


@dataclass(frozen=True, eq=False)
class DiscFit:
    """The fit of one frame. `parameters` in the order of this module's constants."""

    parameters: Array
    covariance: Array  # of all parameters; what noise and prior leave uncertain
    sigma: float  # noise std per channel, from the residuals unless it was given
    chi2_per_dof: float  # against the given noise, or against the frame's own (see `noise_level`)
    n_pixels: int
    n_masked: int
    explained: float  # chi2 that the object takes away, against background and slopes alone

    @property
    def centre_px(self) -> Array:
        return self.parameters[:2]

    @property
    def covariance_px2(self) -> Array:
        return self.covariance[:2, :2]

    @property
    def radius_px(self) -> float:
        return float(self.parameters[RADIUS])

    @property
    def amplitude(self) -> float:
        return float(self.parameters[AMPLITUDE])

    @property
    def snr(self) -> float:
        return abs(self.amplitude) / self.sigma


def signal_of(
    parameters: Array, patch: Patch, psf: Psf, shape: Shape, reference_px: tuple[float, float]
) -> tuple[Array, Array]:
    """Noise-free signal (n,) on the patch, row-major, and its derivatives (n, 9)."""
    row, col, radius, amplitude, background = parameters[:5]
    s, s_row, s_col, s_radius = unit_object(patch, psf, shape, (row, col), radius)
    x_row = (patch.rows - reference_px[0])[:, None] + np.zeros_like(s)
    x_col = (patch.cols - reference_px[1])[None, :] + np.zeros_like(s)
    (a_row, a_col), (b_row, b_col) = parameters[SLOPES], parameters[SHADING]
    shading = 1 + b_row * x_row + b_col * x_col
    unshaded = amplitude * s + background
    signal = unshaded * shading + a_row * x_row + a_col * x_col
    lit = amplitude * shading
    derivatives = (
        lit * s_row,
        lit * s_col,
        lit * s_radius,
        s * shading,
        shading,
        x_row,
        x_col,
        unshaded * x_row,
        unshaded * x_col,
    )
    return signal.ravel(), np.stack([d.ravel() for d in derivatives], axis=1)


def prior_precision(parameters: Array) -> Array:
    """(9,) inverse variances of the priors, at the present estimate of the shading.

    A mixture acts as a Gaussian whose precision is the expectation over its two components (an EM
    step), so that strong shading is not held back.
    """
    level = abs(parameters[AMPLITUDE]) + abs(parameters[BACKGROUND])
    precision = np.zeros(N_PARAMETERS)
    precision[BACKGROUND] = 1 / (_BACKGROUND_SCALE * level) ** 2
    precision[SLOPES] = _mixture_precision(parameters[SLOPES] / level, SLOPE_SCALES) / level**2
    precision[SHADING] = _mixture_precision(parameters[SHADING], SHADING_SCALES)
    return precision


def _mixture_precision(pair: Array, scales: tuple[float, float]) -> float:
    narrow, wide = 1 / scales[0] ** 2, 1 / scales[1] ** 2
    log_odds = np.log(wide / narrow) + 0.5 * float(pair @ pair) * (narrow - wide)
    share = 1 / (1 + np.exp(min(log_odds, 700.0)))
    return float(share * narrow + (1 - share) * wide)


@dataclass(frozen=True, eq=False)
class _Problem:
    pixels: Pixels
    psf: Psf
    shape: Shape
    noise: NoiseKind
    reference_px: tuple[float, float]
    radius_bounds_px: tuple[float, float]
    colour: Array | None  # lower Cholesky factor of the noise correlation of the masked pixels


def fit_disc(
    pixels: Pixels,
    start: tuple[float, float, float],
    psf: Psf,
    *,
    radius_bounds_px: tuple[float, float],
    shape: Shape = DISC,
    noise: NoiseKind = "rician",
    sigma: float | None = None,
    robust: bool = True,
) -> DiscFit:
    """Fit the object that starts at (row, col, radius).

    sigma: noise std per channel where it is known; otherwise it is taken from the residuals.
    robust: leave out pixels that disagree with any round object (a bubble, a neighbour).
    Raises NotConvergedError when the fit does not settle or leaves radius_bounds_px.
    """
    reference = (float(np.round(start[0])), float(np.round(start[1])))
    mask = pixels.mask.copy()
    problem = _problem(pixels, mask, psf, shape, noise, reference, radius_bounds_px)
    parameters = _linear_start(problem, start)
    level = sigma if sigma is not None else _first_sigma(problem, parameters)
    for _ in range(_MAX_ROUNDS):
        parameters = _levenberg_marquardt(problem, parameters, level)
        residual = _standardised(problem, parameters, level)
        new_mask = _without_outliers(pixels, residual, sigma is not None) if robust else mask
        new_level = (
            sigma if sigma is not None else _next_sigma(problem, parameters, level, new_mask)
        )
        settled = np.array_equal(new_mask, mask) and abs(new_level / level - 1) < 0.02
        mask, level = new_mask, new_level
        if settled:
            break
        problem = _problem(pixels, mask, psf, shape, noise, reference, radius_bounds_px)
    return _summary(problem, parameters, level)


def _problem(
    pixels: Pixels,
    mask: Mask,
    psf: Psf,
    shape: Shape,
    noise: NoiseKind,
    reference_px: tuple[float, float],
    bounds: tuple[float, float],
) -> _Problem:
    colour = None
    if not is_white(psf):
        colour = _colour(pixels.patch.period, psf, mask.shape, np.packbits(mask).tobytes())
    chosen = Pixels(pixels.patch, pixels.values, mask)
    return _Problem(chosen, psf, shape, noise, reference_px, bounds, colour)


@lru_cache(maxsize=32)
def _colour(period: tuple[int, int], psf: Psf, shape: tuple[int, int], packed_mask: bytes) -> Array:
    """Lower Cholesky factor of the noise correlation between the pixels of a mask."""
    bits = np.unpackbits(np.frombuffer(packed_mask, np.uint8), count=shape[0] * shape[1])
    row, col = np.nonzero(bits.reshape(shape))
    table = correlation(period, psf, max(shape))
    matrix = table[np.abs(row[:, None] - row), np.abs(col[:, None] - col)] * (1 - _WHITE_FLOOR)
    matrix[np.diag_indices_from(matrix)] += _WHITE_FLOOR
    return np.asarray(cholesky(matrix, lower=True))


def _linear_start(problem: _Problem, start: tuple[float, float, float]) -> Array:
    """All parameters, amplitude and background by least squares at the given centre and radius."""
    parameters = np.zeros(N_PARAMETERS)
    low, high = problem.radius_bounds_px
    parameters[:3] = start[0], start[1], np.clip(start[2], low, high)
    parameters[AMPLITUDE] = 1.0
    patch = problem.pixels.patch
    s, _, _, _ = unit_object(
        patch, problem.psf, problem.shape, (start[0], start[1]), parameters[RADIUS]
    )
    inside = problem.pixels.mask
    basis = np.stack([s[inside], np.ones(int(inside.sum()))], axis=1)
    solution, *_ = np.linalg.lstsq(basis, problem.pixels.values[inside], rcond=None)
    parameters[[AMPLITUDE, BACKGROUND]] = solution
    if parameters[AMPLITUDE] == 0:
        raise NotConvergedError("no contrast at the start position")
    return parameters


def _first_sigma(problem: _Problem, parameters: Array) -> float:
    signal, _ = signal_of(
        parameters, problem.pixels.patch, problem.psf, problem.shape, problem.reference_px
    )
    inside = problem.pixels.mask.ravel()
    residual = (problem.pixels.values.ravel() - np.abs(signal))[inside]
    floor = 1e-9 * float(np.ptp(problem.pixels.values[problem.pixels.mask]))
    return max(float(1.4826 * np.median(np.abs(residual))), floor)


def _standardised(problem: _Problem, parameters: Array, sigma: float) -> Array:
    """(n,) residuals of all pixels of the patch, each over its own std."""
    signal, _ = signal_of(
        parameters, problem.pixels.patch, problem.psf, problem.shape, problem.reference_px
    )
    expected = moments(signal, sigma, problem.noise)
    return np.asarray((problem.pixels.values.ravel() - expected.mean) / np.sqrt(expected.variance))


def _next_sigma(problem: _Problem, parameters: Array, sigma: float, mask: Mask) -> float:
    patch, values = problem.pixels.patch, problem.pixels.values
    signal, _ = signal_of(parameters, patch, problem.psf, problem.shape, problem.reference_px)
    inside = mask.ravel()
    new = sigma_of(values.ravel()[inside], signal[inside], sigma, problem.noise, N_PARAMETERS)
    return max(new, 1e-9 * abs(float(parameters[AMPLITUDE])))


def _without_outliers(pixels: Pixels, residual: Array, known_noise: bool) -> Mask:
    """The mask without pixels that no round object explains, and without their odd neighbours."""
    size = np.abs(residual).reshape(pixels.mask.shape)
    spread = 1.4826 * float(np.median(size[pixels.mask]))
    spread = max(spread, 1.0) if known_noise else max(spread, 1e-12)
    out = pixels.mask & (size > _OUTLIER_SIGMA * spread)
    if not out.any():
        return pixels.mask
    near = np.zeros_like(out)
    padded = np.pad(out, 1)
    rows, cols = out.shape
    for i in range(3):
        for j in range(3):
            near |= padded[i : i + rows, j : j + cols]
    keep = pixels.mask & ~out & ~(near & (size > _OUTLIER_NEIGHBOUR_SIGMA * spread))
    return keep if keep.sum() > 0.5 * pixels.mask.sum() else pixels.mask


@dataclass(frozen=True, eq=False)
class _Linearised:
    """chi2 around one set of parameters, with the pixel weights that it was taken with."""

    weights: Array
    residual: Array  # (n,) whitened
    jacobian: Array  # (n, 9) whitened
    bend: Array  # (9, 9) what the curvature of the Rician mean adds to half the Hessian

    @property
    def information(self) -> Array:
        return np.asarray(self.jacobian.T @ self.jacobian)


def _linearise(
    problem: _Problem, parameters: Array, sigma: float, weights: Array | None = None
) -> _Linearised:
    signal, derivatives = signal_of(
        parameters, problem.pixels.patch, problem.psf, problem.shape, problem.reference_px
    )
    inside = problem.pixels.mask.ravel()
    derivatives = derivatives[inside]
    expected = moments(signal[inside], sigma, problem.noise)
    weights = 1 / np.sqrt(expected.variance) if weights is None else weights
    residual = (problem.pixels.values.ravel()[inside] - expected.mean) * weights
    jacobian = derivatives * (expected.slope * weights)[:, None]
    force = residual
    if problem.colour is not None:
        both = np.column_stack([residual, jacobian])
        both = solve_triangular(problem.colour, both, lower=True, check_finite=False)
        residual, jacobian = both[:, 0], both[:, 1:]
        force = solve_triangular(
            problem.colour, residual, lower=True, trans="T", check_finite=False
        )
    bend = -(derivatives.T * (force * weights * expected.curvature)) @ derivatives
    return _Linearised(weights, residual, jacobian, bend)


def _levenberg_marquardt(problem: _Problem, parameters: Array, sigma: float) -> Array:
    """Minimise chi2 + prior with the weights of the start: new weights are the caller's round."""
    damping: float = 1e-3
    at = _linearise(problem, parameters, sigma)
    precision = prior_precision(parameters)
    low, high = problem.radius_bounds_px
    for _ in range(_MAX_ITERATIONS):
        gradient = at.jacobian.T @ at.residual - precision * parameters
        cost = float(at.residual @ at.residual + precision @ parameters**2)
        step = _damped_step(at, precision, gradient, damping)
        moved = parameters + step
        moved[RADIUS] = np.clip(moved[RADIUS], low, high)
        there = _linearise(problem, moved, sigma, at.weights)
        if there.residual @ there.residual + precision @ moved**2 <= cost * (1 + 1e-12):
            parameters, at = moved, there
            damping = max(damping / 10, 1e-9)
            if gradient @ step < _SETTLED * max(1.0, cost / at.residual.size):
                return parameters
        elif damping > 1e8:
            return parameters  # no direction improves: as far down as rounding allows
        else:
            damping *= 10
    raise NotConvergedError(f"the fit did not settle in {_MAX_ITERATIONS} iterations")


def _damped_step(at: _Linearised, precision: Array, gradient: Array, damping: float) -> Array:
    """Newton's step where the Hessian is positive, the Gauss-Newton step elsewhere, damped."""
    gauss_newton = at.information + np.diag(precision)
    damper = np.diag(damping * np.diag(gauss_newton))
    try:
        factor = cho_factor(gauss_newton + at.bend + damper, check_finite=False)
    except np.linalg.LinAlgError:
        factor = cho_factor(gauss_newton + damper, check_finite=False)
    return np.asarray(cho_solve(factor, gradient, check_finite=False))


def _summary(problem: _Problem, parameters: Array, sigma: float) -> DiscFit:
    low, high = problem.radius_bounds_px
    if not low < parameters[RADIUS] < high:
        raise NotConvergedError(
            f"the radius ran to the end of its range, {parameters[RADIUS]:.2f} px in "
            f"[{low:.2f}, {high:.2f}]"
        )
    at = _linearise(problem, parameters, sigma)
    residual = at.residual
    precision = prior_precision(parameters)
    inverse = np.linalg.inv(at.information + np.diag(precision))
    pull = inverse @ (precision * parameters)
    covariance = inverse @ at.information @ inverse + np.outer(pull, pull)
    n = residual.size
    return DiscFit(
        parameters=parameters,
        covariance=covariance,
        sigma=sigma,
        chi2_per_dof=float(residual @ residual) / max(n - N_PARAMETERS, 1),
        n_pixels=n,
        n_masked=int(problem.pixels.mask.size - n),
        explained=_explained(residual, at.jacobian, parameters),
    )


def _explained(residual: Array, jacobian: Array, parameters: Array) -> float:
    """Growth of chi2 if the object were not there, background and slopes adapting (linearised)."""
    null = [BACKGROUND, 5, 6]
    target = residual + jacobian[:, AMPLITUDE] * parameters[AMPLITUDE]
    solution, *_ = np.linalg.lstsq(jacobian[:, null], target, rcond=None)
    left = target - jacobian[:, null] @ solution
    return float(left @ left - residual @ residual)
