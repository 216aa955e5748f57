"""All groups of a navigation study, here or on a cluster, and what they say together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from simulator.config import FiducialKind
from studies.cluster import Mapper
from studies.navigation import GROUP, Group, GroupResult, Puncture, Setup, run_group

Array = NDArray[np.float64]
STRATEGY_NAMES = ("base", "bicubic", "sr", "hybrid", "adaptive")
_INSIDE_SIGMAS = math.sqrt(stats.chi2.ppf(0.95, 2))

# The paper's Table III: mean and SD of iterations and minutes, precision in mm.
PAPER_TABLE: dict[str, dict[str, tuple[float, float, float, float, float]]] = {
    "benchtop": {
        "base": (1.08, 0.29, 1.08, 0.29, 0.33),
        "bicubic": (1.17, 0.39, 1.08, 0.29, 0.23),
        "sr": (1.58, 0.67, 4.75, 2.34, 0.18),
    },
    "mri": {"base": (2.00, 1.41, 7.00, 5.66, 0.60), "sr": (1.50, 0.71, 26.50, 9.19, 0.40)},
}


@dataclass(frozen=True)
class StrategySummary:
    """One row of the table; errors against the true place of the first puncture."""

    strategy: str
    punctures: int
    failures: int
    median_true_error_mm: float
    p95_true_error_mm: float
    puncture_sd_mm: float
    mean_iterations: float
    sd_iterations: float
    median_frames: float
    mean_frames: float
    mean_minutes: float
    sd_minutes: float
    inside_95: float


@dataclass(frozen=True)
class VarianceTest:
    """Two-tailed F-test: are the punctures of two strategies equally precise?"""

    first: str
    second: str
    variance_ratio: float
    p_value: float


@dataclass(frozen=True)
class NavigationStudy:
    setup: Setup
    results: dict[str, tuple[GroupResult, ...]]

    def punctures(self, strategy: str) -> list[Puncture]:
        return [one for result in self.results[strategy] for one in result.punctures]

    def summaries(self) -> list[StrategySummary]:
        """Of the strategies with two punctures or more; fewer say nothing."""
        found = [_summarise(name, results) for name, results in self.results.items()]
        return [summary for summary in found if summary is not None]

    def tests(self) -> list[VarianceTest]:
        names = [summary.strategy for summary in self.summaries()]
        pairs = [(a, b) for n, a in enumerate(names) for b in names[n + 1 :]]
        return [_f_test(a, self.results[a], b, self.results[b]) for a, b in pairs]


def groups_of(
    setup: Setup,
    punctures: int,
    seed: int,
    snr: float,
    step_scatter: float,
    fiducial: FiducialKind = "sphere",
    *,
    encoders: bool = False,
) -> list[Group]:
    """The same rooms, random points and noise seeds for every strategy; the last may be short."""
    sizes = [GROUP] * (punctures // GROUP)
    if punctures % GROUP >= 2:
        sizes.append(punctures % GROUP)
    elif punctures % GROUP:
        sizes[-1] += 1
    return [
        Group(setup, strategy, seed * 10_000 + number, size, snr, step_scatter, fiducial, encoders)
        for strategy in STRATEGY_NAMES
        for number, size in enumerate(sizes)
    ]


def run_study(
    setup: Setup, groups: list[Group], mapper: Mapper, advance: Callable[[int], None]
) -> NavigationStudy:
    done = mapper(run_group, groups, lambda: advance(1))
    return NavigationStudy(
        setup,
        {name: tuple(r for r in done if r.group.strategy == name) for name in STRATEGY_NAMES},
    )


def _summarise(strategy: str, results: tuple[GroupResult, ...]) -> StrategySummary | None:
    punctures = [one for result in results for one in result.punctures]
    if len(punctures) < 2:
        return None
    errors = np.array([one.true_error_mm for one in punctures])
    iterations = np.array([one.iterations for one in punctures])
    frames = np.array([one.frames for one in punctures])
    minutes = np.array([one.minutes for one in punctures])
    squares, degrees = _scatter(results)
    return StrategySummary(
        strategy=strategy,
        punctures=len(punctures),
        failures=sum(len(result.failures) for result in results),
        median_true_error_mm=float(np.median(errors)),
        p95_true_error_mm=float(np.quantile(errors, 0.95)),
        puncture_sd_mm=math.sqrt(squares / max(degrees, 1)),
        mean_iterations=float(iterations.mean()),
        sd_iterations=float(iterations.std(ddof=1)),
        median_frames=float(np.median(frames)),
        mean_frames=float(frames.mean()),
        mean_minutes=float(minutes.mean()),
        sd_minutes=float(minutes.std(ddof=1)),
        inside_95=float(np.mean([one.miss_sigmas < _INSIDE_SIGMAS for one in punctures])),
    )


def _scatter(results: tuple[GroupResult, ...]) -> tuple[float, int]:
    """Summed squared distances to the mean of each group, mm², and their degrees of freedom.

    A group's first puncture, at the target itself, is one of its points.
    """
    squares, degrees = 0.0, 0
    for result in results:
        if result.punctures:
            places = np.array([(0.0, 0.0), *(one.position_mm for one in result.punctures)])
            squares += float(np.sum((places - places.mean(axis=0)) ** 2))
            degrees += len(places) - 1
    return squares, degrees


def _f_test(
    first: str, a: tuple[GroupResult, ...], second: str, b: tuple[GroupResult, ...]
) -> VarianceTest:
    (squares_a, n_a), (squares_b, n_b) = _scatter(a), _scatter(b)
    ratio = (squares_a / n_a) / (squares_b / n_b)
    # two coordinates a puncture
    tail = min(stats.f.cdf(ratio, 2 * n_a, 2 * n_b), stats.f.sf(ratio, 2 * n_a, 2 * n_b))
    return VarianceTest(first, second, ratio, float(min(1.0, 2 * tail)))
