"""Maximum-likelihood fit of one round object in one frame, with its covariance.

The pixels have the Rician mean and variance that belong to the signal of `signal` (or Gaussian
ones, from a camera). Noise that passed a k-space filter is coloured and is whitened with the
correlation that the filter gives it. Levenberg-Marquardt with analytic derivatives, in rounds: each
takes the weights, the noise level and the mask of odd pixels from the fit before it.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dposv
from scipy.ndimage import binary_dilation, map_coordinates, maximum_filter

from sr_engine.errors import NoRoundObjectError, NotConvergedError
from sr_engine.model import DISC, Shape, unit_object
from sr_engine.noise import Moments, NoiseKind, colour_factor, is_white, moments, sigma_of
from sr_engine.psf import Psf
from sr_engine.signal import (
    AMPLITUDE,
    BACKGROUND,
    RADIUS,
    SURROUNDINGS,
    WALL,
    WALL_BOUNDS_PX,
    WALL_PX,
    Mask,
    ObjectModel,
    Pixels,
    prior_mean,
    prior_precision,
    signal_of,
)

Array = NDArray[np.float64]

OUTLIER_SIGMA = 4.5
_MIRRORED_SHARE = 0.4  # of an odd pixel, at its mirror image: then it is the outline
_THINNEST_RING_PX = 1.0  # a brighter rim is no ring
_NEIGHBOUR_SHARE = 0.55  # of that, for the neighbours of a pixel left out
_MAX_ITERATIONS = 120  # a filtered magnitude can hold the fit at a saddle for forty
_LONGEST_STEP_PX = 0.7  # of centre and radius
_MAX_ROUNDS = 6
_SAME_SIGMA = 0.1  # relative change of the noise level that leaves the weights as they are
_SAME_PRIOR = 0.5  # likewise of a prior's precision
_SETTLED = 1e-4  # expected change of chi2, so a step of 0.01 sigma in any parameter
_NEARLY_SETTLED = 1e-2  # good enough after all iterations: a step of 0.1 sigma
_LEAST_AMPLITUDE = 1e-3  # in sigma: below it nothing is left that has a centre or a radius


@dataclass(frozen=True, eq=False)
class DiscFit:
    """The fit of one frame. `parameters` in the order of `signal`'s constants."""

    parameters: Array
    covariance: Array  # of all parameters; what noise and prior leave uncertain
    sigma: float  # noise std per channel, from the residuals unless it was given
    chi2_per_dof: float
    n_pixels: int
    n_masked: int
    explained: float  # chi2 that the object takes away, against background and slopes alone
    residual: Array  # (rows, cols) pixels less what is expected of them; 0 where none counts
    systematic_px: Array = field(default_factory=lambda: np.zeros(2))  # see `lopsided`

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
    def background(self) -> float:
        return float(self.parameters[BACKGROUND])

    @property
    def wall_px(self) -> float:
        """Thickness of the wall; 0 for none."""
        return float(self.parameters[WALL_PX]) if self.parameters.size > WALL else 0.0

    @property
    def is_ring(self) -> bool:
        """About a void: its wall is resolved, and stands out twice as much as what it encloses."""
        is_wall = self.wall_px >= _THINNEST_RING_PX
        return is_wall and bool(abs(self.parameters[WALL]) > 2 * abs(self.amplitude))

    @property
    def outer_px(self) -> float:
        """Radius of the outer edge of a ring about a void; else the object's own."""
        return self.radius_px + (self.wall_px if self.is_ring else 0.0)

    @property
    def snr(self) -> float:
        """Largest step at the edge, of the object or of its wall, over the noise."""
        levels = [0.0, self.amplitude]
        if self.parameters.size > WALL:
            levels.append(float(self.parameters[WALL]))
        return float(np.ptp(levels)) / self.sigma

    def moved_to(self, centre_px: Array) -> "DiscFit":
        """The same object elsewhere: where to start in the next frame."""
        return replace(self, parameters=np.concatenate([centre_px, self.parameters[2:]]))


@dataclass(frozen=True, eq=False)
class _Problem:
    pixels: Pixels
    model: ObjectModel
    noise: NoiseKind
    radius_bounds_px: tuple[float, float]
    whiten: bool

    @cached_property
    def used(self) -> NDArray[np.intp]:
        """(n,) indices of the pixels that count, in the flattened patch."""
        return np.flatnonzero(self.pixels.mask)

    @cached_property
    def values(self) -> Array:
        """(n,) of these pixels."""
        return self.pixels.values.take(self.used)


@dataclass(frozen=True, eq=False)
class _Image:
    """The signal of one set of parameters, and its derivatives."""

    parameters: Array
    signal: Array  # (rows, cols)
    derivatives: Array  # (n_parameters, rows, cols)


@dataclass(frozen=True, eq=False)
class _Metric:
    """How residuals are weighed during one round: fixed, so that chi2 is one function."""

    expected: Moments  # (n,) of the pixels at the image that the round starts from
    weights: Array  # (n,) one over the std of each pixel
    colour: Array | None  # lower Cholesky factor of the correlation of the pixels' noise


@dataclass(frozen=True, eq=False)
class _Linearised:
    """chi2 around one set of parameters."""

    image: _Image
    expected: Moments  # (n,)
    residual: Array  # (n,) whitened
    jacobian: Array  # (n, 9) whitened
    information: Array  # (9, 9)
    bend: Array  # (9, 9) what the curvature of the Rician mean adds to the information


def fit_disc(
    pixels: Pixels,
    start: tuple[float, float, float] | DiscFit,
    psf: Psf,
    *,
    radius_bounds_px: tuple[float, float],
    shape: Shape = DISC,
    wall_px: float | None = None,
    noise: NoiseKind = "rician",
    sigma: float | None = None,
    robust: bool = True,
    outlier_sigma: float = OUTLIER_SIGMA,
    whiten: bool = True,
) -> DiscFit:
    """Fit the object that starts at (row, col, radius), or like another fit.

    wall_px: expected thickness of a wall (shell) about the object; None for none.
    sigma: noise std per channel where it is known; otherwise it is taken from the residuals.
    robust: leave out pixels that disagree with any round object (a bubble, a neighbour) by more
      than outlier_sigma.
    whiten: allow for the colour that a k-space filter gives the noise; not where the model's own
      imperfection, and not noise, is what remains.
    Raises NotConvergedError when the fit does not settle or leaves radius_bounds_px, and
    NoRoundObjectError when it slides to an object without contrast.
    """
    begin = start.parameters[:2] if isinstance(start, DiscFit) else np.array(start[:2])
    reference = (float(np.round(begin[0])), float(np.round(begin[1])))
    problem = _Problem(
        pixels, ObjectModel(psf, shape, reference, wall_px), noise, radius_bounds_px, whiten
    )
    if isinstance(start, DiscFit):
        parameters, level = start.parameters.copy(), start.sigma
    else:
        parameters, level = _linear_start(problem, start)
    level = level if sigma is None else sigma
    least_spread = 1e-12 if sigma is None else 1.0  # of standardised residuals
    for _ in range(_MAX_ROUNDS):
        image = _image(problem, parameters)
        metric = _metric(problem, image, level)
        before = prior_precision(parameters, problem.model)
        parameters, at = _levenberg_marquardt(problem, image, metric, before)
        mask = (
            _without_outliers(problem, pixels.mask, at, least_spread, outlier_sigma)
            if robust
            else pixels.mask
        )
        old = level
        if sigma is None:
            level = _next_sigma(problem, mask, at, level, float(abs(parameters[AMPLITUDE])))
        same = np.array_equal(mask, problem.pixels.mask) and abs(level / old - 1) < _SAME_SIGMA
        after = prior_precision(parameters, problem.model)
        if same and np.all(np.abs(before - after) <= _SAME_PRIOR * after):
            break
        problem = replace(problem, pixels=replace(pixels, mask=mask))
    return _summary(problem, parameters, at, level, metric.expected.sigma / level)


def _linear_start(problem: _Problem, start: tuple[float, float, float]) -> tuple[Array, float]:
    """Parameters with amplitude and background by least squares, and a noise level to begin at."""
    parameters = prior_mean(problem.model)
    parameters[:2] = start[:2]
    parameters[RADIUS] = np.clip(start[2], *problem.radius_bounds_px)
    model, mask = problem.model, problem.pixels.mask
    centre, radius = (start[0], start[1]), float(parameters[RADIUS])
    patch = problem.pixels.patch
    s, *_ = unit_object(patch, model.psf, model.shape, centre, radius)
    columns = [s[mask], np.ones(int(mask.sum()))]
    if model.wall_px is not None:
        outer, *_ = unit_object(patch, model.psf, model.shape, centre, radius + model.wall_px)
        columns.append((outer - s)[mask])
    basis = np.stack(columns, axis=1)
    values = problem.pixels.values[mask]
    solution, *_ = np.linalg.lstsq(basis, values, rcond=None)
    if solution[0] == 0:
        raise NotConvergedError("no contrast at the start position")
    parameters[[AMPLITUDE, BACKGROUND]] = solution[:2]
    if model.wall_px is not None:
        parameters[WALL] = solution[2]
    misfit = float(1.4826 * np.median(np.abs(values - np.abs(basis @ solution))))
    return parameters, max(misfit, 1e-9 * float(np.ptp(values)))


def _next_sigma(
    problem: _Problem, mask: Mask, at: _Linearised, sigma: float, amplitude: float
) -> float:
    values = problem.pixels.values[mask]
    signal = at.image.signal[mask]
    new = sigma_of(values, signal, sigma, problem.noise, problem.model.n_parameters)
    return max(new, 1e-9 * amplitude)


def _without_outliers(
    problem: _Problem,
    mask: Mask,
    at: _Linearised,
    least_spread: float,
    outlier_sigma: float,
) -> Mask:
    """The mask without pixels that no round object explains, and without their odd neighbours."""
    values, expected = problem.values, at.expected
    if mask is not problem.pixels.mask:  # those left out before may come back
        values = problem.pixels.values[mask]
        expected = moments(at.image.signal[mask], at.expected.sigma, problem.noise)
    signed = (values - expected.mean) / np.sqrt(expected.variance)
    limit = outlier_sigma * max(1.4826 * float(np.median(np.abs(signed))), least_spread)
    if not np.abs(signed).max() > limit:
        return mask
    left = np.zeros(mask.shape)
    left[mask] = signed
    size = np.abs(left)
    out = (size > limit) & ~_is_mirrored(problem, left, at.image.parameters[:2])
    near = binary_dilation(out, np.ones((3, 3)))
    keep = mask & ~out & ~(near & (size > _NEIGHBOUR_SHARE * limit))
    return keep if keep.sum() > 0.5 * mask.sum() else mask


def _is_mirrored(problem: _Problem, left: Array, centre: Array) -> Mask:
    """Where what is left is seen, with the same sign, on the other side of the centre as well.

    A bubble or a neighbour is on one side. An outline that is no circle is so on both, or nearly:
    to leave out one end of it would draw the centre towards the other.
    """
    patch = problem.pixels.patch
    rows, cols = np.meshgrid(
        2 * centre[0] - patch.rows - patch.rows[0],
        2 * centre[1] - patch.cols - patch.cols[0],
        indexing="ij",
    )
    mirrored = np.zeros(left.shape, dtype=bool)
    for sign in (1.0, -1.0):
        strongest = maximum_filter(sign * left, 3)
        seen = map_coordinates(strongest, [rows, cols], order=0, mode="constant")
        mirrored |= (sign * left > 0) & (seen > _MIRRORED_SHARE * sign * left)
    return mirrored


def _image(problem: _Problem, parameters: Array) -> _Image:
    return _Image(parameters, *signal_of(parameters, problem.pixels.patch, problem.model))


def _metric(problem: _Problem, image: _Image, sigma: float) -> _Metric:
    mask, psf = problem.pixels.mask, problem.model.psf
    expected = moments(image.signal.take(problem.used), sigma, problem.noise)
    colour = None
    if problem.whiten and not is_white(psf):
        colour = colour_factor(problem.pixels.patch.period, psf, mask, expected, sigma)
    return _Metric(expected, 1 / np.sqrt(expected.variance), colour)


def _evaluate(problem: _Problem, parameters: Array, metric: _Metric) -> _Linearised:
    image = _image(problem, parameters)
    expected = moments(image.signal.take(problem.used), metric.expected.sigma, problem.noise)
    return _linearise(problem, image, expected, metric)


def _linearise(problem: _Problem, image: _Image, expected: Moments, metric: _Metric) -> _Linearised:
    flat = image.derivatives.reshape(len(image.derivatives), -1)
    by_parameter = flat.take(problem.used, axis=1)
    residual = (problem.values - expected.mean) * metric.weights
    jacobian = (by_parameter * (expected.slope * metric.weights)).T
    force = residual
    if metric.colour is not None:
        both = np.column_stack([residual, jacobian])
        both = solve_triangular(metric.colour, both, lower=True, check_finite=False)
        residual, jacobian = both[:, 0], both[:, 1:]
        force = solve_triangular(metric.colour, residual, lower=True, trans="T", check_finite=False)
    bend = -(by_parameter * (force * metric.weights * expected.curvature)) @ by_parameter.T
    return _Linearised(image, expected, residual, jacobian, jacobian.T @ jacobian, bend)


def _bounds(problem: _Problem) -> tuple[Array, Array]:
    size = problem.model.n_parameters
    low, high = np.full(size, -np.inf), np.full(size, np.inf)
    low[RADIUS], high[RADIUS] = problem.radius_bounds_px
    low[WALL_PX:], high[WALL_PX:] = WALL_BOUNDS_PX
    return low, high


def _levenberg_marquardt(
    problem: _Problem, start: _Image, metric: _Metric, precision: Array
) -> tuple[Array, _Linearised]:
    """Minimise chi2 + prior in one metric, within the bounds of radius and wall."""
    damping: float = 1e-3
    parameters, at = start.parameters, _linearise(problem, start, metric.expected, metric)
    mean = prior_mean(problem.model)
    low, high = _bounds(problem)
    for _ in range(_MAX_ITERATIONS):
        gradient = at.jacobian.T @ at.residual - precision * (parameters - mean)
        cost = float(at.residual @ at.residual + precision @ (parameters - mean) ** 2)
        stuck = ((parameters <= low) & (gradient < 0)) | ((parameters >= high) & (gradient > 0))
        step = _damped_step(at, precision, gradient, damping, ~stuck)
        moved = np.clip(parameters + step, low, high)
        gain = float(gradient @ (moved - parameters))
        if gain < _SETTLED * max(1.0, cost / at.residual.size):
            return moved, at
        there = _evaluate(problem, moved, metric)
        trial = there.residual @ there.residual + precision @ (moved - mean) ** 2
        if trial <= cost * (1 + 1e-12):
            _refuse_vanished(moved, metric.expected.sigma)
            parameters, at = moved, there
            damping = max(damping / 30, 1e-9)
        elif damping > 1e8:
            return parameters, at  # no direction improves: as far down as rounding allows
        else:
            damping *= 10
    if gain < _NEARLY_SETTLED * max(1.0, cost / at.residual.size):
        return parameters, at
    raise NotConvergedError(f"the fit did not converge in {_MAX_ITERATIONS} iterations")


def _refuse_vanished(parameters: Array, sigma: float) -> None:
    """An object without amplitude: its centre and radius are no longer in the signal."""
    levels = np.abs(parameters[[AMPLITUDE, WALL] if parameters.size > WALL else [AMPLITUDE]])
    if not levels.max() > _LEAST_AMPLITUDE * sigma:
        row, col = parameters[:2]
        raise NoRoundObjectError(
            f"no round object at row {row:.1f}, col {col:.1f}: the best fit has no contrast"
        )


def _damped_step(
    at: _Linearised, precision: Array, gradient: Array, damping: float, free: NDArray[np.bool_]
) -> Array:
    """Newton's step where the Hessian is positive, the Gauss-Newton step elsewhere, damped."""
    damped = at.information.copy()
    damped.flat[:: free.size + 1] = (1 + damping) * (damped.diagonal() + precision)
    newton = damped + at.bend
    if not free.all():
        chosen = np.ix_(free, free)
        damped, newton, gradient = damped[chosen], newton[chosen], gradient[free]
    # LAPACK's own driver: one call that also tells whether the matrix is positive
    _, solution, failed = dposv(newton, gradient)
    step = np.zeros(free.size)
    step[free] = np.linalg.solve(damped, gradient) if failed else solution
    # beyond a pixel the linearised edge says nothing: a long step is only its direction
    return step * min(1.0, _LONGEST_STEP_PX / max(float(np.max(np.abs(step[:AMPLITUDE]))), 1e-12))


def _summary(
    problem: _Problem, parameters: Array, at: _Linearised, sigma: float, scale: float
) -> DiscFit:
    """The fit as the last round left it; scale: that round's noise level over the final one."""
    low, high = problem.radius_bounds_px
    if not low < parameters[RADIUS] < high:
        raise NotConvergedError(
            f"the radius reached the end of its range, {parameters[RADIUS]:.2f} px in "
            f"[{low:.2f}, {high:.2f}]"
        )
    at = replace(
        at,
        residual=at.residual * scale,
        jacobian=at.jacobian * scale,
        information=at.information * scale**2,
    )
    n = at.residual.size
    residual = np.zeros(problem.pixels.values.shape)
    seen = moments(at.image.signal.take(problem.used), at.expected.sigma, problem.noise)
    residual[problem.pixels.mask] = problem.values - seen.mean
    return DiscFit(
        parameters=parameters,
        covariance=_covariance(at, parameters, problem.model),
        sigma=sigma,
        chi2_per_dof=float(at.residual @ at.residual) / max(n - problem.model.n_parameters, 1),
        n_pixels=n,
        n_masked=int(np.count_nonzero(~problem.pixels.mask)),
        explained=_explained(at, parameters),
        residual=residual,
    )


def _covariance(at: _Linearised, parameters: Array, model: ObjectModel) -> Array:
    """Mean squared error of the estimate: what the noise does to it, and the pull of the prior.

    The pull is judged by the estimate itself, so this is right for an object without shading as
    for one with it, which the inverse of information plus prior is not.
    """
    precision = prior_precision(parameters, model)
    inverse = np.linalg.inv(at.information + np.diag(precision))
    pull = inverse @ (precision * (parameters - prior_mean(model)))
    return np.asarray(inverse @ at.information @ inverse + np.outer(pull, pull))


def _explained(at: _Linearised, parameters: Array) -> float:
    """Growth of chi2 if the object were not there, background and slopes adapting (linearised)."""
    target = at.residual + at.jacobian[:, AMPLITUDE] * parameters[AMPLITUDE]
    if parameters.size > WALL:
        target = target + at.jacobian[:, WALL] * parameters[WALL]
    surroundings = at.jacobian[:, SURROUNDINGS]
    projection = surroundings.T @ target
    within = at.information[np.ix_(SURROUNDINGS, SURROUNDINGS)]
    taken = float(projection @ np.linalg.lstsq(within, projection, rcond=None)[0])
    return float(target @ target - at.residual @ at.residual) - taken
