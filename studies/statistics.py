"""What a set of trials says: errors a method, F-tests between methods, the bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import integrate, special, stats

from studies.numerical import StudyPoint, Trial, scene_frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """Errors of one method in frame pixels; the mean is that of the Euclidean distance."""

    method: str
    trials: int
    failures: int
    mean_error_px: float
    median_error_px: float
    max_error_px: float
    sd_row_px: float
    sd_col_px: float
    bias_row_px: float
    bias_col_px: float


@dataclass(frozen=True)
class FTest:
    """Two-tailed F-test of equal variance, on the errors along both axes, each less its mean."""

    first: str
    second: str
    variance_ratio: float
    p_value: float


def errors_px(trials: list[Trial], method: str) -> Array:
    """(n, 2), row and column errors of the trials in which the method gave an answer."""
    found = [trial.error_px(method) for trial in trials if method in trial.estimates_px]
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def summarise(trials: list[Trial], method: str) -> Summary | None:
    """None when fewer than two trials gave an answer: then there is nothing to summarise."""
    errors = errors_px(trials, method)
    if len(errors) < 2:
        return None
    distance = np.hypot(errors[:, 0], errors[:, 1])
    sd, bias = errors.std(axis=0, ddof=1), errors.mean(axis=0)
    return Summary(
        method=method,
        trials=len(trials),
        failures=len(trials) - len(errors),
        mean_error_px=float(distance.mean()),
        median_error_px=float(np.median(distance)),
        max_error_px=float(distance.max()),
        sd_row_px=float(sd[0]),
        sd_col_px=float(sd[1]),
        bias_row_px=float(bias[0]),
        bias_col_px=float(bias[1]),
    )


def f_test(trials: list[Trial], first: str, second: str) -> FTest | None:
    """None when either method has fewer than two answers."""
    errors = [errors_px(trials, method) for method in (first, second)]
    if min(len(e) for e in errors) < 2:
        return None
    dof = [2 * (len(e) - 1) for e in errors]
    variances = [
        float(np.sum((e - e.mean(axis=0)) ** 2)) / d for e, d in zip(errors, dof, strict=True)
    ]
    ratio = variances[0] / variances[1]
    tail = min(stats.f.cdf(ratio, *dof), stats.f.sf(ratio, *dof))
    return FTest(first, second, ratio, float(min(1.0, 2 * tail)))


def bound_mean_error_px(point: StudyPoint, frames: int) -> float:
    """Cramér-Rao bound of the mean distance, magnitude data, over nine places between pixels.

    Unknown: centre, radius, amplitude, background. A k-space filter takes no information away,
    so the bound of a filtered scene is that of the scan before the filter.
    """
    if point.scene == "hamming":
        point = replace(point, scene="flat")
    variance = np.mean([_variance(point, row, col) for row in _PHASES for col in _PHASES])
    return math.sqrt(math.pi / 2 * float(variance) / frames)


_PHASES = (-1 / 3, 0.0, 1 / 3)


def _variance(point: StudyPoint, row_phase: float, col_phase: float) -> float:
    """Mean variance of row and column of one frame."""
    centre, sigma, step = np.array([60.0 + row_phase, 60.0 + col_phase]), 1 / point.snr, 0.1
    signal = scene_frame(point, centre)
    derivatives = [signal, np.ones_like(signal)]
    for axis in range(2):
        ahead = np.eye(2)[axis] * step
        change = scene_frame(point, centre + ahead) - scene_frame(point, centre - ahead)
        derivatives.append(change / (2 * step))
    wider, narrower = (
        scene_frame(replace(point, radius_px=point.radius_px + d), centre) for d in (step, -step)
    )
    derivatives.append((wider - narrower) / (2 * step))
    jacobian = np.stack([d.ravel() for d in derivatives], axis=1)
    weight = rician_information(np.abs(signal).ravel() / sigma) / sigma**2
    covariance = np.linalg.inv(jacobian.T @ (jacobian * weight[:, None]))
    return float(covariance[2, 2] + covariance[3, 3]) / 2


def rician_information(ratio: Array) -> Array:
    """Fisher information about the signal in one magnitude pixel, over that of a Gaussian one.

    ``ratio`` is signal over noise per channel: 0 carries nothing, 5 and more nearly all.
    """
    grid, values = _rician_table()
    return np.interp(ratio, grid, values, right=1.0)


@lru_cache(maxsize=1)
def _rician_table() -> tuple[Array, Array]:
    grid = np.linspace(0.0, 12.0, 241)
    return grid, np.array([_rician_information(float(a)) for a in grid])


def _rician_information(a: float) -> float:
    """E[(x I1(xa)/I0(xa))^2] - a^2 for the Rician of parameter ``a`` and unit noise."""
    x = np.linspace(max(0.0, a - 9.0), a + 9.0, 2001)
    density = x * np.exp(-0.5 * (x - a) ** 2) * special.i0e(x * a)
    score = x * special.i1e(x * a) / special.i0e(x * a) - a
    return float(integrate.simpson(score**2 * density, x=x))
