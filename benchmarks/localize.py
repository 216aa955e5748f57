"""Localization: accuracy and time of ours and of others, in one run, on the same frames.

Discs with known centres at random pixel phases, magnitude images with Rician noise, one frame or
four at known shifts; every method gets the same frames, start and radius. The others take the
mean of their four centres less the shifts. Then our time against the frames and the matrix.

    python benchmarks/localize.py [--quick] [--json] [--out DIR]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from sr_engine.bound import bound_px
from sr_engine.errors import EngineError
from sr_engine.localize import localize
from sr_engine.psf import Psf
from sr_engine.simulate import render_disc, rician
from studies.peers import PEERS, PeerFailedError, run_peer

Array = NDArray[np.float64]

SHAPE = (128, 128)
QUARTERS = np.array([(0.25, 0.25), (0.25, -0.25), (-0.25, 0.25), (-0.25, -0.25)])
ONE = np.zeros((1, 2))
OURS = "ml (ours)"
MEAN_OF_RAYLEIGH = np.sqrt(np.pi / 2)  # mean distance in units of the std of one axis


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer trials and cases")
    parser.add_argument("--json", action="store_true", help="JSON instead of tables")
    parser.add_argument("--out", type=Path, help="folder for the plot (PNG and SVG)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    trials = 40 if options.quick else 400
    cases = [(4.0, 20.0, ONE), (4.0, 20.0, QUARTERS)]
    if not options.quick:
        cases += [(2.5, 20.0, ONE), (2.5, 20.0, QUARTERS), (4.0, 40.0, ONE), (8.0, 20.0, ONE)]
    results: dict[str, Any] = {
        "cases": [compare(radius, snr, q, trials, options.seed) for radius, snr, q in cases],
        "growth": growth(10 if options.quick else 40),
    }
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        results["files"] = [str(file) for file in draw(results, options.out)]
    if options.json:
        print(json.dumps(results, allow_nan=False))
    else:
        print_tables(results)


def trial_frames(
    radius: float, snr: float, shifts: Array, rng: np.random.Generator, shape: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """Frames (N, rows, cols), true centre and a start within 2 px of it."""
    truth = np.array(shape) / 2 + rng.uniform(-0.5, 0.5, 2)
    frames = [
        rician(render_disc(shape, (float(r), float(c)), radius, psf=Psf()), 1 / snr, rng)
        for r, c in truth + shifts
    ]
    return np.stack(frames), truth, truth + rng.uniform(-1.4, 1.4, 2)


def compare(radius: float, snr: float, shifts: Array, trials: int, seed: int) -> dict[str, Any]:
    """Error and time of every method over the same trials."""
    rng = np.random.default_rng(seed)
    names = [OURS, *PEERS]
    errors: dict[str, list[float]] = {name: [] for name in names}
    times: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(trials):
        frames, truth, start = trial_frames(radius, snr, shifts, rng, SHAPE)
        for name in names:
            begin = time.perf_counter()
            try:
                centre = one_centre(name, frames, shifts, start, radius)
            except (EngineError, PeerFailedError):
                continue
            times[name].append((time.perf_counter() - begin) * 1e3)
            errors[name].append(float(np.hypot(*(centre - truth))))
    bound = bound_px(radius, snr, n_frames=len(shifts)) * MEAN_OF_RAYLEIGH
    rows = [row_of(name, errors[name], times[name], trials) for name in names]
    ours = rows[0]
    for row in rows:
        for key in ("mean_error", "median_ms"):
            unit = "_px" if key == "mean_error" else ""
            value, base = row[key + unit], ours[key + unit]
            row[key.split("_")[1].replace("ms", "time") + "_ratio"] = (
                None if value is None else value / base
            )
    return {
        "radius_px": radius, "snr": snr, "n_frames": len(shifts), "trials": trials,
        "bound_mean_error_px": float(bound), "methods": rows,
    }  # fmt: skip


def one_centre(name: str, frames: Array, shifts: Array, start: Array, radius: float) -> Array:
    if name == OURS:
        radii = (0.6 * radius, 1.6 * radius)
        return localize(frames, shifts, start_px=start, radius_px=radii).centre_px
    centres = [
        run_peer(PEERS[name], frame, (float(start[0] + d[0]), float(start[1] + d[1])), radius) - d
        for frame, d in zip(frames, shifts, strict=True)
    ]
    return np.mean(centres, axis=0)


def row_of(name: str, errors: list[float], times: list[float], trials: int) -> dict[str, Any]:
    found = bool(errors)
    return {
        "method": name,
        "mean_error_px": float(np.mean(errors)) if found else None,
        "median_error_px": float(np.median(errors)) if found else None,
        "p95_error_px": float(np.percentile(errors, 95)) if found else None,
        "failures": trials - len(errors),
        "median_ms": float(np.median(times)) if found else None,
    }


def growth(repeats: int) -> list[dict[str, Any]]:
    """Processor time of ours against the number of frames and the size of the matrix."""
    rng = np.random.default_rng(3)
    rows = []
    for n_frames, size in ((1, 128), (2, 128), (4, 128), (8, 128), (4, 64), (4, 256), (4, 512)):
        shifts = rng.uniform(-0.5, 0.5, (n_frames, 2))
        frames, _, start = trial_frames(4.0, 20.0, shifts, rng, (size, size))
        samples = []
        for _ in range(repeats):
            begin = time.process_time()
            localize(frames, shifts, start_px=start, radius_px=(2.4, 6.4))
            samples.append((time.process_time() - begin) * 1e3)
        rows.append({"n_frames": n_frames, "matrix": size, "median_ms": float(np.median(samples))})
    return rows


def print_tables(results: dict[str, Any]) -> None:
    console = Console()
    for case in results["cases"]:
        table = Table(
            title=f"R {case['radius_px']:g} px, SNR {case['snr']:g}, {case['n_frames']} frame(s), "
            f"{case['trials']} trials; bound {case['bound_mean_error_px']:.4f} px"
        )
        for heading in ("method", "mean error px", "median", "x ours", "failed", "ms", "x ours"):
            table.add_column(heading, justify="left" if heading == "method" else "right")
        for row in case["methods"]:
            table.add_row(row["method"], *(text_of(row, key, spec) for key, spec in COLUMNS))
        console.print(table)
    table = Table(title="Time of ours, processor time")
    for heading in ("frames", "matrix", "ms"):
        table.add_column(heading, justify="right")
    for row in results["growth"]:
        table.add_row(str(row["n_frames"]), f"{row['matrix']}²", f"{row['median_ms']:.1f}")
    console.print(table)


COLUMNS = (
    ("mean_error_px", ".4f"),
    ("median_error_px", ".4f"),
    ("error_ratio", ".1f"),
    ("failures", "d"),
    ("median_ms", ".2f"),
    ("time_ratio", ".2f"),
)


def text_of(row: dict[str, Any], key: str, spec: str) -> str:
    return "-" if row[key] is None else format(row[key], spec)


def draw(results: dict[str, Any], folder: Path) -> list[Path]:
    """Error against time, a panel a case; nearer to the lower left is better."""
    cases = results["cases"]
    figure = Figure(figsize=(5.2 * len(cases), 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    for panel, case in zip(figure.subplots(1, len(cases), squeeze=False)[0], cases, strict=True):
        for row in case["methods"]:
            if row["mean_error_px"] is None:
                continue
            marker = "*" if row["method"] == OURS else "o"
            panel.plot(row["median_ms"], row["mean_error_px"], marker, label=row["method"])
        panel.axhline(case["bound_mean_error_px"], color="grey", linestyle=":", label="bound")
        panel.set(xscale="log", yscale="log", xlabel="median time, ms", ylabel="mean error, px")
        panel.set_title(
            f"R {case['radius_px']:g} px, SNR {case['snr']:g}, {case['n_frames']} frame(s)"
        )
    figure.axes[0].legend(fontsize=7)
    files = [folder / "localize.png", folder / "localize.svg"]
    for file in files:
        figure.savefig(file, dpi=120)
    return files


if __name__ == "__main__":
    main()
