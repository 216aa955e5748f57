"""The paper's figure with ours beside it, and error against SNR and radius; PNG and SVG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from studies.numerical import METHODS, SCENES
from studies.numerical_report import labels
from studies.numerical_study import MAP_RADIUS_PX, MAP_SNR, NumericalStudy
from studies.statistics import errors_px

COLOURS = {
    "base": "#4477aa",
    "bicubic": "#228833",
    "sr": "#cc3311",
    "ml1": "#aa3377",
    "ml": "#222222",
}
SCENE_TITLES = {
    "drawn": "drawn circle (the paper's)",
    "flat": "k-space, flat",
    "hamming": "k-space, Hamming",
}


def draw_all(study: NumericalStudy, folder: Path) -> list[Path]:
    files = _save(draw_scatter(study), folder / "numerical_scatter")
    if study.cells:
        files += _save(draw_map(study), folder / "numerical_map")
    return files


def _save(figure: Figure, stem: Path) -> list[Path]:
    files = [stem.with_suffix(suffix) for suffix in (".png", ".svg")]
    for file in files:
        figure.savefig(file, dpi=120)
    return files


def draw_scatter(study: NumericalStudy) -> Figure:
    """Above: found against true column, as in the paper. Below: the errors themselves."""
    figure = Figure(figsize=(15, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(METHODS), squeeze=False)
    shown = [m for m in METHODS if m in study.summaries]
    limit = 1.35 * max(float(np.abs(errors_px(study.trials, m)).max()) for m in shown)
    for column, method in enumerate(METHODS):
        above, below = axes[0, column], axes[1, column]
        above.set_title(labels(study)[method], fontsize=11)
        if method in shown:
            _found_against_true(above, study, method)
            _error_cloud(below, study, method, limit)
    axes[0, 0].set_ylabel("found column, px")
    axes[1, 0].set_ylabel("row error, px")
    return figure


def _found_against_true(axes: Axes, study: NumericalStudy, method: str) -> None:
    answered = [t for t in study.trials if method in t.estimates_px]
    true = np.array([t.truth_px[1] for t in answered])
    found = np.array([t.estimates_px[method][1] for t in answered])
    ends = np.array([true.min(), true.max()])
    axes.plot(ends, ends, color="0.6", linewidth=1, zorder=1)
    axes.scatter(true, found, s=10, color=COLOURS[method], zorder=2)
    # The same section in every panel, whatever went astray.
    section = (ends[0] - 0.4, ends[1] + 0.4)
    axes.set(xlim=section, ylim=section, xlabel="true column, px")
    axes.set_aspect("equal")
    axes.grid(alpha=0.25)


def _error_cloud(axes: Axes, study: NumericalStudy, method: str, limit: float) -> None:
    errors = errors_px(study.trials, method)
    axes.scatter(errors[:, 1], errors[:, 0], s=10, color=COLOURS[method])
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), xlabel="column error, px")
    axes.set_aspect("equal")
    axes.axhline(0, color="0.7", linewidth=0.8, zorder=0)
    axes.axvline(0, color="0.7", linewidth=0.8, zorder=0)
    mean = study.summaries[method].mean_error_px
    box = {"facecolor": "white", "edgecolor": "0.8", "alpha": 0.9}
    axes.text(
        0.04, 0.95, f"mean {mean:.4f} px", transform=axes.transAxes, va="top", fontsize=10, bbox=box
    )
    axes.grid(alpha=0.25)


def draw_map(study: NumericalStudy) -> Figure:
    """Mean error against SNR (above) and radius (below), one column of panels a scene."""
    figure = Figure(figsize=(13, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(SCENES), sharey=True, squeeze=False)
    for column, scene in enumerate(SCENES):
        _curves(axes[0, column], study, scene, against="snr")
        _curves(axes[1, column], study, scene, against="radius_px")
        axes[0, column].set_title(SCENE_TITLES[scene], fontsize=11)
    for row in range(2):
        axes[row, 0].set_ylabel("mean error, px")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def _curves(axes: Axes, study: NumericalStudy, scene: str, against: str) -> None:
    fixed, value = ("radius_px", 4.0) if against == "snr" else ("snr", 20.0)
    named = labels(study)
    ticks = MAP_SNR if against == "snr" else MAP_RADIUS_PX
    cells = [c for c in study.cells if c.point.scene == scene and getattr(c.point, fixed) == value]
    for method in METHODS:
        has = [c for c in cells if method in c.summaries]
        where = [getattr(c.point, against) for c in has]
        means = [c.summaries[method].mean_error_px for c in has]
        axes.plot(where, means, "o-", color=COLOURS[method], label=named[method], markersize=4)
    where = [getattr(c.point, against) for c in cells]
    bounds = [c.bound_px for c in cells]
    axes.plot(where, bounds, "--", color="0.45", label=f"bound, {study.point.frame_count} frames")
    axes.set(xscale="log", yscale="log")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel(
        f"SNR (R = {value:g} px)" if against == "snr" else f"radius, px (SNR {value:g})"
    )
    axes.grid(alpha=0.25)
