"""The whole numerical study: the paper's hundred positions, and a map over what it leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

from sr_engine.paper import PAPER_MEAN_ERROR_PX
from studies.cluster import Mapper, map_here
from studies.numerical import METHODS, SCENES, VARIANTS, StudyPoint, Trial, run_trials
from studies.statistics import FTest, Summary, bound_mean_error_px, f_test, summarise

MAP_SNR = (10.0, 20.0, 40.0, 80.0)
MAP_RADIUS_PX = (2.5, 4.0, 8.0)
CHUNK_TRIALS = 5

F_TESTS = (("base", "sr"), ("bicubic", "sr"), ("base", "bicubic"), ("sr", "ml1"), ("sr", "ml"))


@dataclass(frozen=True)
class MapPoint:
    """One cell of the map: its parameters, each method's errors, the bound with all frames."""

    point: StudyPoint
    summaries: dict[str, Summary]
    bound_px: float

    @property
    def gain(self) -> float | None:
        """Mean error of `sr` over that of `ml`; None where either gave no answers."""
        if "sr" not in self.summaries or "ml" not in self.summaries:
            return None
        return self.summaries["sr"].mean_error_px / self.summaries["ml"].mean_error_px

    def is_ordered(self, worse: str, better: str) -> bool:
        """Whether both gave answers and ``worse`` has the larger mean error."""
        if worse not in self.summaries or better not in self.summaries:
            return False
        return self.summaries[worse].mean_error_px > self.summaries[better].mean_error_px


@dataclass(frozen=True)
class NumericalStudy:
    """Everything that is printed, written or plotted."""

    point: StudyPoint
    trials: list[Trial]
    summaries: dict[str, Summary]
    f_tests: list[FTest]
    bound_px: dict[str, float]
    cells: list[MapPoint]

    def cells_five_times_better(self) -> int:
        return sum(cell.gain is not None and cell.gain >= 5.0 for cell in self.cells)

    def cells_base_worse_than_sr(self) -> int:
        return sum(cell.is_ordered("base", "sr") for cell in self.cells)


def chosen_parameters(point: StudyPoint) -> dict[str, str]:
    """What the paper does not give, and what was taken."""
    low, high = point.hough.radius_px
    return {
        "circle radius": f"{point.radius_px:g} px of the base frame",
        "blur": f"Gaussian, sigma {point.blur_sigma_px:g} px, before the scaling",
        "scaling": "5000 to 125 px, mean over 40 x 40 pixels",
        "noise": f"magnitude of two noisy channels (Rician), SNR {point.snr:g} before any filter",
        "place": "row phase drawn again in each trial; column one high-resolution pixel on",
        "circle finding": f"radii {low:g} to {high:g} px, sensitivity {point.sensitivity:g}, "
        "edge threshold by Otsu, within 3 px of a start known to 1 px",
        "shift set": (
            "four points, random in ±1 px, drawn again in each trial"
            if point.shift_set == "paper"
            else f"{point.shift_set}, the same each trial"
        ),
        "sr": "stops at the noise, or by the paper's rule; sr-100 is that rule alone",
        "ml": "told the point spread as a scanner's protocol tells it; ml-flat is told a wrong one",
        "unit": "error = distance in base pixels; the paper's unit is 'normalized pixels'",
    }


def run_study(
    point: StudyPoint,
    trials: int,
    map_trials: int,
    mapper: Mapper = map_here,
    progress: Callable[[int], None] = lambda done: None,
) -> NumericalStudy:
    """Run it all; ``progress`` is called with the number of trials just finished."""
    main = replace(point, methods=(*METHODS, *VARIANTS))
    points = [main, *(map_points(point) if map_trials else [])]
    chunks = [
        (where, list(range(first, min(first + CHUNK_TRIALS, count))))
        for where, count in zip(points, [trials, *[map_trials] * len(points[1:])], strict=True)
        for first in range(0, count, CHUNK_TRIALS)
    ]
    finished = mapper(_run_chunk, chunks, partial(progress, CHUNK_TRIALS))
    by_index: dict[int, list[Trial]] = {where.index: [] for where in points}
    for (where, _), done in zip(chunks, finished, strict=True):
        by_index[where.index].extend(done)
    here = by_index[main.index]
    return NumericalStudy(
        point=main,
        trials=here,
        summaries=_summaries(here, main.methods),
        f_tests=[test for pair in F_TESTS if (test := f_test(here, *pair)) is not None],
        bound_px={
            "ml1": bound_mean_error_px(main, 1),
            "ml": bound_mean_error_px(main, main.frame_count),
        },
        cells=[
            MapPoint(
                where,
                _summaries(by_index[where.index], where.methods),
                bound_mean_error_px(where, where.frame_count),
            )
            for where in points[1:]
        ],
    )


def trials_in_all(trials: int, map_trials: int) -> int:
    return trials + map_trials * len(SCENES) * len(MAP_SNR) * len(MAP_RADIUS_PX)


def map_points(point: StudyPoint) -> list[StudyPoint]:
    cells = product(SCENES, MAP_RADIUS_PX, MAP_SNR)
    return [
        replace(point, index=number, scene=scene, radius_px=radius, snr=snr, methods=METHODS)
        for number, (scene, radius, snr) in enumerate(cells, start=1)
    ]


def paper_mean_error_px(method: str) -> float | None:
    return PAPER_MEAN_ERROR_PX.get(method)


def _run_chunk(chunk: tuple[StudyPoint, list[int]]) -> list[Trial]:
    return run_trials(*chunk)


def _summaries(trials: list[Trial], methods: tuple[str, ...]) -> dict[str, Summary]:
    found = {method: summarise(trials, method) for method in methods}
    return {method: summary for method, summary in found.items() if summary is not None}
