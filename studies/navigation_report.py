"""The navigation studies as tables, JSON, CSV and figures: the paper's Table III beside ours."""

from __future__ import annotations

import csv
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from studies.navigation import ASSUMPTIONS
from studies.navigation_study import PAPER_TABLE, NavigationStudy, StrategySummary

LABELS = {
    "base": "base image",
    "bicubic": "bicubic x2",
    "sr": "SR x2, four images",
    "hybrid": "base, then SR",
    "adaptive": "adaptive",
}
COLOURS = {
    "base": "#4477aa",
    "bicubic": "#228833",
    "sr": "#cc3311",
    "hybrid": "#997700",
    "adaptive": "#222222",
}
_COLUMNS = (
    "row_mm",
    "col_mm",
    "true_error_mm",
    "estimated_error_mm",
    "sigma_mm",
    "miss_sigmas",
    "iterations",
    "frames",
    "minutes",
)


def as_json(study: NavigationStudy, settings: dict[str, Any], files: list[Path]) -> dict[str, Any]:
    return {
        "setup": study.setup,
        "settings": settings,
        "assumptions": ASSUMPTIONS,
        "strategies": [
            {**asdict(summary), "paper": _paper_row(study.setup, summary.strategy)}
            for summary in study.summaries()
        ],
        "f_tests": [asdict(test) for test in study.tests()],
        "files": [str(file) for file in files],
    }


def _paper_row(setup: str, strategy: str) -> dict[str, float] | None:
    row = PAPER_TABLE[setup].get(strategy)
    if row is None:
        return None
    names = ("mean_iterations", "sd_iterations", "mean_minutes", "sd_minutes", "puncture_sd_mm")
    return dict(zip(names, row, strict=True))


def print_tables(study: NavigationStudy, console: Console) -> None:
    ours = _table(f"{study.setup}, the virtual room: mean (SD)")
    for heading in ("median mm", "95 % mm", "frames", "in 95 %", "n"):
        ours.add_column(heading, justify="right")
    for row in study.summaries():
        ours.add_row(
            row.strategy,
            f"{row.mean_iterations:.2f} ({row.sd_iterations:.2f})",
            f"{row.mean_minutes:.2f} ({row.sd_minutes:.2f})",
            f"{row.puncture_sd_mm:.3f}",
            f"{row.median_true_error_mm:.3f}",
            f"{row.p95_true_error_mm:.3f}",
            f"{row.median_frames:g}",
            f"{100 * row.inside_95:.0f} %",
            str(row.punctures) + (f", {row.failures} failed" if row.failures else ""),
        )
    console.print(ours)
    _print_paper(study, console)
    console.print("Not given in the paper, assumed here:")
    for name, text in ASSUMPTIONS.items():
        console.print(f"  {name}: {text}", highlight=False)


def print_measured(study: NavigationStudy, console: Console) -> None:
    """Of a real room: what was measured on the sheets beside the paper's."""
    ours = _table(f"{study.setup}, this room: mean (SD)")
    for heading in ("σ said mm", "frames", "n"):
        ours.add_column(heading, justify="right")
    for row in study.summaries():
        said = float(np.median([one.sigma_mm for one in study.punctures(row.strategy)]))
        ours.add_row(
            row.strategy,
            f"{row.mean_iterations:.2f} ({row.sd_iterations:.2f})",
            f"{row.mean_minutes:.2f} ({row.sd_minutes:.2f})",
            f"{row.puncture_sd_mm:.3f}",
            f"{said:.3f}",
            f"{row.median_frames:g}",
            str(row.punctures + 1),
        )
    console.print(ours)
    _print_paper(study, console)


def _print_paper(study: NavigationStudy, console: Console) -> None:
    paper = _table(f"{study.setup}, the paper's Table III: mean (SD)")
    for name, row_of_paper in PAPER_TABLE[study.setup].items():
        iterations, sd_iterations, minutes, sd_minutes, precision = row_of_paper
        paper.add_row(
            name,
            f"{iterations:.2f} ({sd_iterations:.2f})",
            f"{minutes:.2f} ({sd_minutes:.2f})",
            f"{precision:.2f}",
        )
    console.print(paper)
    _print_tests(study, console)


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for heading in ("iterations", "min", "SD mm"):
        table.add_column(heading, justify="right")
    return table


def _print_tests(study: NavigationStudy, console: Console) -> None:
    table = Table(title="Two-tailed F-tests of the precision")
    for column in ("", "variance ratio", "p"):
        table.add_column(column, justify="left" if not column else "right")
    for test in study.tests():
        p_value = "< 0.0001" if test.p_value < 1e-4 else f"{test.p_value:.4f}"
        table.add_row(
            f"{LABELS[test.first]} : {LABELS[test.second]}", f"{test.variance_ratio:.2f}", p_value
        )
    console.print(table)


def write_csv(study: NavigationStudy, folder: Path) -> list[Path]:
    """One row a puncture."""
    file = folder / f"{study.setup}_punctures.csv"
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(("strategy", "seed", *_COLUMNS))
        for strategy, results in study.results.items():
            for result in results:
                for one in result.punctures:
                    row_mm, col_mm = one.position_mm
                    values = {**vars(one), "row_mm": row_mm, "col_mm": col_mm}
                    values["true_error_mm"] = one.true_error_mm
                    writer.writerow((strategy, result.group.seed, *(values[c] for c in _COLUMNS)))
    return [file]


def draw_punctures(study: NavigationStudy, folder: Path) -> list[Path]:
    """Every puncture around its group's first, with a circle of the precision, as in the paper."""
    summaries = study.summaries()
    figure = Figure(figsize=(3.2 * len(summaries), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    limit = 1.05 * max(
        float(np.abs([p.position_mm for p in study.punctures(s.strategy)]).max()) for s in summaries
    )
    for axes, summary in zip(
        figure.subplots(1, len(summaries), squeeze=False)[0], summaries, strict=True
    ):
        _cloud(axes, study, summary, limit)
    files = [folder / f"{study.setup}_punctures{suffix}" for suffix in (".png", ".svg")]
    for file in files:
        figure.savefig(file, dpi=120)
    return files


def _cloud(axes: Axes, study: NavigationStudy, summary: StrategySummary, limit: float) -> None:
    places = np.array([one.position_mm for one in study.punctures(summary.strategy)])
    colour = COLOURS[summary.strategy]
    axes.plot(places[:, 1], places[:, 0], ".", color=colour, alpha=0.6)
    angle = np.linspace(0, 2 * np.pi, 100)
    radius = summary.puncture_sd_mm
    axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=colour)
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="column, mm")
    axes.set_title(f"{LABELS[summary.strategy]}: {radius:.3f} mm", fontsize=10)
    axes.set_ylabel("row, mm")
