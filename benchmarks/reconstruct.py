"""Reconstruction: the closed form against the paper's gradient descent, and how both grow.

In one run, on the same frames: time (median, warm), error against the scene that the frames
were made of, and the ratio; then the closed form's time against the number of pixels, of frames
and the factor. Growth is measured in processor time, which a busy machine spoils less.

    python benchmarks/reconstruct.py [--quick] [--json] [--out DIR]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from sr_engine.psf import Psf
from sr_engine.reconstruction import shiftset
from sr_engine.reconstruction.fourier import prepare_filters
from sr_engine.reconstruction.ibp import PAPER, Stopping, reconstruct_ibp
from sr_engine.reconstruction.reconstruct import reconstruct
from sr_engine.simulate import render_disc, rician

Array = NDArray[np.float64]

RADIUS_PX = 4.0
SNR = 20.0
SETS = {2: "quarter", 3: "third", 4: "eighth"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats and sizes")
    parser.add_argument("--json", action="store_true", help="JSON instead of tables")
    parser.add_argument("--out", type=Path, help="folder for the plot (PNG and SVG)")
    options = parser.parse_args()
    repeats = 15 if options.quick else 60
    results = {
        "head_to_head": head_to_head(repeats),
        "growth_pixels": growth_with_pixels(repeats, options.quick),
        "growth_frames": growth_with_frames(repeats, options.quick),
        "growth_factor": growth_with_factor(repeats),
    }
    results["exponents"] = exponents(results)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        results["files"] = [str(file) for file in draw(results, options.out)]
    if options.json:
        print(json.dumps(results, allow_nan=False))
    else:
        print_tables(results)


def frames_of(shape: tuple[int, int], shifts: Array, seed: int = 0) -> Array:
    """Magnitude frames of a disc, one for each shift."""
    rng = np.random.default_rng(seed)
    centres = np.array([shape[0] / 2 + 0.31, shape[1] / 2 - 0.18]) + shifts
    discs = [render_disc(shape, (float(r), float(c)), RADIUS_PX) for r, c in centres]
    return np.stack([rician(disc, 1 / SNR, rng) for disc in discs])


def elapsed_ms(run: Callable[[], object], clock: Callable[[], float]) -> float:
    start = clock()
    run()
    return (clock() - start) * 1e3


def head_to_head(repeats: int) -> dict[str, Any]:
    """4 x 128^2 to 256^2. IBP: whole frame, as the paper runs it."""
    shape = (128, 128)
    shifts = shiftset.named("quarter").as_array()
    frames = frames_of(shape, shifts)
    centre = (2 * (shape[0] / 2 + 0.31) + 0.5, 2 * (shape[1] / 2 - 0.18) + 0.5)
    scene = np.abs(render_disc((256, 256), centre, 2 * RADIUS_PX, psf=Psf(acquired=(0.5, 0.5))))
    runs: dict[str, Callable[[], Array]] = {
        "fourier": lambda: reconstruct(frames, shifts).image,
        "ibp_10": lambda: reconstruct_ibp(frames, shifts, stopping=Stopping(10, 0.0)).image,
        "ibp_100": lambda: reconstruct_ibp(frames, shifts, stopping=PAPER).image,
        "ibp_noise_stop": lambda: reconstruct_ibp(frames, shifts).image,
    }
    times: dict[str, list[float]] = {name: [] for name in runs}
    cpu_times: dict[str, list[float]] = {name: [] for name in runs}
    # In turns, so that a busy machine slows all of them alike.
    for _ in range(max(5, repeats // 4)):
        for name, run in runs.items():
            once = 1 if name.startswith("ibp") else 5
            times[name] += [elapsed_ms(run, time.perf_counter) for _ in range(once)]
            cpu_times[name].append(elapsed_ms(run, time.process_time))
    found: dict[str, Any] = {
        name: {
            "median_ms": float(np.median(times[name])),
            "median_cpu_ms": float(np.median(cpu_times[name])),
            "rms_error": float(np.sqrt(np.mean((run() - scene) ** 2))),
        }
        for name, run in runs.items()
    }
    found["paper_iterations"] = reconstruct_ibp(frames, shifts, stopping=PAPER).iterations
    found["ibp_100_over_fourier"] = found["ibp_100"]["median_ms"] / found["fourier"]["median_ms"]
    found["filters_cold_ms"] = cold_ms(shape, shifts)
    return found


def cold_ms(shape: tuple[int, int], shifts: Array) -> float:
    """What the filters of a new shift set cost, once."""
    times = []
    for attempt in range(5):
        moved = shifts + 1e-3 * (attempt + 1)
        start = time.perf_counter()
        prepare_filters(shape, moved)
        times.append(time.perf_counter() - start)
    return float(np.median(times) * 1e3)


def growth_with_pixels(repeats: int, quick: bool) -> list[dict[str, float]]:
    shifts = shiftset.named("quarter").as_array()
    sides = (64, 128, 256) if quick else (64, 128, 256, 512)
    runs = [closed_form((side, side), shifts, 2) for side in sides]
    times = best_cpu_ms(runs, repeats)
    return [{"side_px": s, "cpu_ms": ms} for s, ms in zip(sides, times, strict=True)]


def growth_with_frames(repeats: int, quick: bool) -> list[dict[str, float]]:
    more = np.random.default_rng(4).uniform(-1, 1, (60, 2))
    shifts = np.vstack([shiftset.named("quarter").as_array(), more])
    counts = (4, 8, 16, 32) if quick else (4, 8, 16, 32, 64)
    runs = [closed_form((128, 128), shifts[:count], 2) for count in counts]
    times = best_cpu_ms(runs, repeats)
    return [{"frames": n, "cpu_ms": ms} for n, ms in zip(counts, times, strict=True)]


def growth_with_factor(repeats: int) -> list[dict[str, float]]:
    sets = {factor: shiftset.named(name).as_array() for factor, name in SETS.items()}
    runs = [closed_form((128, 128), shifts, factor) for factor, shifts in sets.items()]
    times = best_cpu_ms(runs, repeats)
    return [
        {"factor": factor, "frames": len(shifts), "cpu_ms": ms}
        for (factor, shifts), ms in zip(sets.items(), times, strict=True)
    ]


def closed_form(shape: tuple[int, int], shifts: Array, factor: int) -> Callable[[], object]:
    """A reconstruction with its filters at hand."""
    frames, filters = frames_of(shape, shifts), prepare_filters(shape, shifts, factor)
    return lambda: filters.apply(frames)


def best_cpu_ms(runs: list[Callable[[], object]], repeats: int) -> list[float]:
    """Least processor time of each, taken in turns: what a busy machine adds is left out."""
    times = [[elapsed_ms(run, time.process_time) for run in runs] for _ in range(repeats)]
    return [float(best) for best in np.min(times, axis=0)]


def exponents(results: dict[str, Any]) -> dict[str, float]:
    """Slopes in doubly logarithmic scale: against n log n of the pixels, and against N."""
    sides = np.array([row["side_px"] for row in results["growth_pixels"]], dtype=float)
    work = sides**2 * np.log(sides**2)
    counts = np.array([row["frames"] for row in results["growth_frames"]], dtype=float)
    return {
        "time_over_n_log_n": _slope(work, results["growth_pixels"]),
        "time_over_frames": _slope(counts, results["growth_frames"]),
    }


def _slope(amount: Array, rows: list[dict[str, float]]) -> float:
    times = np.array([row["cpu_ms"] for row in rows])
    return float(np.polyfit(np.log(amount), np.log(times), 1)[0])


def print_tables(results: dict[str, Any]) -> None:
    console = Console()
    console.print(_head_table(results["head_to_head"]))
    for name, key in (("pixels", "side_px"), ("frames", "frames"), ("factor", "factor")):
        table = Table(title=f"Closed form against {name}, filters warm")
        for column in (key, "processor time, ms"):
            table.add_column(column, justify="right")
        for row in results[f"growth_{name}"]:
            table.add_row(str(row[key]), f"{row['cpu_ms']:.2f}")
        console.print(table)
    slopes = results["exponents"]
    console.print(
        f"time ~ (n log n)^{slopes['time_over_n_log_n']:.2f} in the pixels, "
        f"N^{slopes['time_over_frames']:.2f} in the frames"
    )


def _head_table(found: dict[str, Any]) -> Table:
    table = Table(title="4 frames of 128 x 128 to 256 x 256")
    for column in ("method", "median ms", "processor ms", "rms error", "× closed form"):
        table.add_column(column, justify="left" if column == "method" else "right")
    labels = {
        "fourier": "closed form, filters warm",
        "ibp_10": "IBP, 10 iterations",
        "ibp_100": f"IBP, the paper's rule ({found['paper_iterations']} iterations)",
        "ibp_noise_stop": "IBP, stopped at the noise",
    }
    for name, label in labels.items():
        entry = found[name]
        ratio = entry["median_ms"] / found["fourier"]["median_ms"]
        times = (f"{entry[key]:.2f}" for key in ("median_ms", "median_cpu_ms"))
        table.add_row(label, *times, f"{entry['rms_error']:.4f}", f"{ratio:.1f}")
    table.add_row("filters of a new shift set, once", f"{found['filters_cold_ms']:.1f}")
    return table


def draw(results: dict[str, Any], folder: Path) -> list[Path]:
    figure = Figure(figsize=(12, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    labels = {"fourier": "closed form", "ibp_10": "IBP 10", "ibp_100": "IBP 100"}
    times = [results["head_to_head"][name]["median_ms"] for name in labels]
    axes[0].bar(list(labels.values()), times, color=["#222222", "#ee8866", "#cc3311"])
    axes[0].bar_label(axes[0].containers[0], fmt="%.1f ms")
    axes[0].set(yscale="log", ylabel="median time, ms", title="4 × 128² to 256²")
    axes[0].set_ylim(top=3 * max(times))
    sides = np.array([row["side_px"] for row in results["growth_pixels"]], dtype=float)
    work = sides**2 * np.log(sides**2)
    _growth(axes[1], sides, results["growth_pixels"], work, "side of a frame, px", "n log n")
    counts = np.array([row["frames"] for row in results["growth_frames"]], dtype=float)
    _growth(axes[2], counts, results["growth_frames"], counts, "frames", "linear")
    files = [folder / f"reconstruct{suffix}" for suffix in (".png", ".svg")]
    for file in files:
        figure.savefig(file, dpi=120)
    return files


def _growth(
    axes: Any, where: Array, rows: list[dict[str, float]], work: Array, label: str, law: str
) -> None:
    times = np.array([row["cpu_ms"] for row in rows])
    axes.loglog(where, times, "o-", color="#222222", label="closed form")
    axes.loglog(where, times[-1] * work / work[-1], "--", color="0.5", label=law)
    axes.set(xlabel=label, ylabel="processor time, ms")
    axes.set_xticks(where, [f"{int(value)}" for value in where])
    axes.minorticks_off()
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)


if __name__ == "__main__":
    main()
