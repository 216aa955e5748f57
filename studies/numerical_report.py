"""The numerical study as tables on a terminal, as JSON and as CSV."""

from __future__ import annotations

import csv
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from studies.numerical import METHODS, SCENES, VARIANTS
from studies.numerical_study import (
    MAP_RADIUS_PX,
    MAP_SNR,
    MapPoint,
    NumericalStudy,
    chosen_parameters,
    paper_mean_error_px,
)


def labels(study: NumericalStudy) -> dict[str, str]:
    """What a method is called in tables and figures."""
    frames = f"{study.point.frame_count} frames"
    return {
        "base": "base frame, Hough",
        "bicubic": "bicubic ×2, Hough",
        "sr": f"SR ×2 ({frames}), Hough",
        "ml1": "ours, 1 frame",
        "ml": f"ours, {frames}",
        "sr-100": "SR ×2, 100 iterations",
        "ml-flat": f"ours, {frames}, wrong PSF",
    }


def as_json(study: NumericalStudy, files: list[Path]) -> dict[str, Any]:
    """Plain values only, the numbers with their units in the names."""
    return {
        "settings": asdict(study.point),
        "not_in_the_paper": chosen_parameters(study.point),
        "methods": [_method(study, m) for m in METHODS if m in study.summaries],
        "variants": [_method(study, m) for m in VARIANTS if m in study.summaries],
        "f_tests": [asdict(test) for test in study.f_tests],
        "map": [_cell(cell) for cell in study.cells],
        "map_cells_five_times_better": study.cells_five_times_better(),
        "map_cells_base_worse_than_sr": study.cells_base_worse_than_sr(),
        "files": [str(file) for file in files],
    }


def _method(study: NumericalStudy, method: str) -> dict[str, Any]:
    entry = asdict(study.summaries[method])
    if (paper := paper_mean_error_px(method)) is not None:
        entry["paper_mean_error_px"] = paper
    if method in study.bound_px:
        entry["bound_mean_error_px"] = study.bound_px[method]
    return entry


def _cell(cell: MapPoint) -> dict[str, Any]:
    gain = {} if cell.gain is None else {"sr_over_ml": cell.gain}
    return {
        "scene": cell.point.scene,
        "radius_px": cell.point.radius_px,
        "snr": cell.point.snr,
        "bound_mean_error_px": cell.bound_px,
        "mean_error_px": {m: s.mean_error_px for m, s in cell.summaries.items()},
        "failures": {m: s.failures for m, s in cell.summaries.items()},
        **gain,
    }


def print_tables(study: NumericalStudy, console: Console) -> None:
    console.print(_errors_table(study))
    console.print(_f_table(study))
    if study.cells:
        console.print(_map_table(study))
        console.print(
            f"Of {len(study.cells)} cells, ours is 5 times better than SR or more in "
            f"{study.cells_five_times_better()}; the base frame is worse than SR in "
            f"{study.cells_base_worse_than_sr()}.",
            highlight=False,
        )
    console.print("Not given in the paper, assumed here:")
    for what, value in chosen_parameters(study.point).items():
        console.print(f"  {what}: {value}", highlight=False)


def _errors_table(study: NumericalStudy) -> Table:
    table = Table(title=f"Centre of the circle, {len(study.trials)} positions: error in pixels")
    for column in ("method", "mean", "paper", "bound", "sd row", "sd col", "largest", "no answer"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for method in (*METHODS, *VARIANTS):
        if method not in study.summaries:
            table.add_row(labels(study)[method], *["-"] * 6, str(len(study.trials)))
            continue
        found = study.summaries[method]
        paper, bound = paper_mean_error_px(method), study.bound_px.get(method)
        table.add_row(
            labels(study)[method],
            f"{found.mean_error_px:.4f}",
            f"{paper:.3f}" if paper else "",
            f"{bound:.4f}" if bound else "",
            f"{found.sd_row_px:.4f}",
            f"{found.sd_col_px:.4f}",
            f"{found.max_error_px:.3f}",
            str(found.failures),
            end_section=method == METHODS[-1],
        )
    return table


def _f_table(study: NumericalStudy) -> Table:
    table = Table(title="Two-tailed F-tests of equal variance")
    table.add_column("methods")
    for column in ("variance ratio", "p", "ratio of mean errors"):
        table.add_column(column, justify="right")
    for test in study.f_tests:
        means = [study.summaries[m].mean_error_px for m in (test.first, test.second)]
        p = "< 0.0001" if test.p_value < 1e-4 else f"{test.p_value:.4f}"
        table.add_row(
            f"{test.first} / {test.second}",
            f"{test.variance_ratio:.2f}",
            p,
            f"{means[0] / means[1]:.2f}",
        )
    return table


def _map_table(study: NumericalStudy) -> Table:
    count = study.cells[0].summaries
    trials = max((s.trials for s in count.values()), default=0)
    table = Table(
        title=f"Mean error of SR → ours with {study.point.frame_count} frames (times better), "
        f"{trials} trials a cell"
    )
    table.add_column("scene")
    table.add_column("R, px", justify="right")
    for snr in MAP_SNR:
        table.add_column(f"SNR {snr:g}", justify="right")
    cells = {(c.point.scene, c.point.radius_px, c.point.snr): c for c in study.cells}
    for scene in SCENES:
        for radius in MAP_RADIUS_PX:
            row = [_map_entry(cells[scene, radius, snr]) for snr in MAP_SNR]
            last = radius == MAP_RADIUS_PX[-1]
            table.add_row(scene, f"{radius:g}", *row, end_section=last)
    return table


def _map_entry(cell: MapPoint) -> str:
    if cell.gain is None:
        missing = [m for m in ("sr", "ml") if m not in cell.summaries]
        return f"no {', '.join(missing)}"
    sr, ml = (cell.summaries[m].mean_error_px for m in ("sr", "ml"))
    return f"{sr:.3f} → {ml:.4f} ({cell.gain:.1f})"


def write_csv(study: NumericalStudy, folder: Path) -> list[Path]:
    """Every trial of every method, and the map."""
    trials, cells = folder / "numerical_trials.csv", folder / "numerical_map.csv"
    with trials.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["trial", "method", "true_row_px", "true_col_px", "row_px", "col_px", "failure"]
        )
        for trial in study.trials:
            for method in study.point.methods:
                place = trial.estimates_px.get(method, ("", ""))
                failure = trial.failures.get(method, "")
                writer.writerow([trial.number, method, *trial.truth_px, *place, failure])
    if not study.cells:
        return [trials]
    with cells.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["scene", "radius_px", "snr", "method", "mean_error_px", "failures", "bound_px"]
        )
        for cell in study.cells:
            for method, summary in cell.summaries.items():
                where = (cell.point.scene, cell.point.radius_px, cell.point.snr)
                values = (summary.mean_error_px, summary.failures, cell.bound_px)
                writer.writerow([*where, method, *values])
    return [trials, cells]
