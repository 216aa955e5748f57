"""The template's displacements: error and honesty, on shapes and processing that it does not model.

For every kind of `studies.fiducials` templates are learnt from nine frames at known places, and
27 more are localized by each, one by one. Or the same on files of frames with truth made elsewhere:

    python benchmarks/template.py [--kinds WORD ...] [--templates N] [--frames FOLDER] [--json]

Error: mean distance of successive frames' displacement from the truth, px. Bound: the same for
the known image (kinds that are not processed). NEES: mean normalised squared error of the places
less what all frames of a template have in common; honest is 2.
FOLDER: files NAME.npz with frames (M, rows, cols), centre_px (M, 2), and pixels_per_px.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import EngineError
from sr_engine.template.learn import learn_template
from studies.fiducials import KINDS, SHAPES, bound_px, frames_of

Array = NDArray[np.float64]

LEARNT_FROM, LOCALIZED = 9, 27
MEAN_STEP = np.sqrt(np.pi)  # mean length of the difference of two places, in std of one axis
# What a cubic-spline template (half a pixel a knot, least squares, white noise) has on these.
SPLINE_PX = {
    "ref_disc": 0.0241, "sphere_gre_z1": 0.0334, "tse_centric": 0.0344, "fat_tse_3T": 0.0275,
    "zf2": 0.0278, "tukey50": 0.0323, "elliptical": 0.0275, "bias3pc": 0.0324,
    "bubble_big": 0.0276, "denoise_tv": 0.0310, "dis2d_linear": 0.0371, "jump100": 0.0321,
    "median3": 0.0423, "phase_res75": 0.0285, "quant10": 0.0505, "ringing_body82": 0.0455,
    "smooth3x3": 0.0348, "sos16": 0.0291, "ring_5_2": 0.0226, "ring_5_2_tilt_z15": 0.0278,
    "ring_5_2_gre_brass_3T": 0.0220, "ring_4_2_tse_brass_15T": 0.0260,
    "ring_5_2_tse_febrass_15T": 0.0169,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="*", help="only kinds whose name has one of these words")
    parser.add_argument("--templates", type=int, default=8, help="a kind")
    parser.add_argument("--frames", type=Path, help="folder of frames with truth")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rows = []
    if options.frames is not None:
        for file in sorted(options.frames.glob("*.npz")):
            if not options.kinds or any(word in file.stem for word in options.kinds):
                rows.append(row_of_file(file))
                say(rows[-1], options.json)
    else:
        plain = {kind.name for kind in SHAPES}
        for name, kind in KINDS.items():
            if options.kinds and not any(word in name for word in options.kinds):
                continue
            bound = float(MEAN_STEP * bound_px(kind)) if name in plain else None
            rng = np.random.default_rng(options.seed)
            runs = []
            for _ in range(options.templates):
                made = frames_of(kind, LEARNT_FROM + LOCALIZED, rng)
                runs.append(run(made.frames, made.centres_px, made.finer))
            rows.append(row_of(name, runs, bound))
            say(rows[-1], options.json)
    ratios = [row["ratio"] for row in rows if row["ratio"] is not None]
    if options.json:
        print(json.dumps(rows, allow_nan=False))
    elif ratios:
        print(f"geometric mean of the ratios {np.exp(np.mean(np.log(ratios))):.3f}")


def run(frames: Array, centres_px: Array, finer: int) -> dict[str, Any]:
    """One template, and what is localized by it."""
    frames = frames.astype(float)
    count = LEARNT_FROM
    begin = time.process_time()
    try:
        template = learn_template(frames[:count], centres_px[:count] - centres_px[0])
    except EngineError as error:
        return {"refused": len(frames) - count, "why": str(error), "steps": [], "squares": []}
    learnt_s = time.process_time() - begin
    errors, covariances, refusals = [], [], []
    begin = time.process_time()
    for frame, true in zip(frames[count:], centres_px[count:], strict=True):
        try:
            fit = template.fit(frame)
        except EngineError as error:
            refusals.append(str(error))
            continue
        errors.append(fit.centre_px - true)
        covariances.append(fit.covariance_px2)
    fitted_s = time.process_time() - begin
    apart = np.array(errors) - np.mean(errors, axis=0)
    squares = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(covariances), apart)
    return {
        "refused": len(refusals), "why": refusals[0] if refusals else "",
        "steps": list(np.hypot(*np.diff(errors, axis=0).T) / finer),
        "squares": list(squares * len(errors) / (len(errors) - 1)),
        "learnt_ms": learnt_s * 1e3, "fit_ms": fitted_s / len(errors) * 1e3,
        "kind": template.metric.kind,
    }  # fmt: skip


def row_of_file(file: Path) -> dict[str, Any]:
    with np.load(file) as data:
        finer = int(data["pixels_per_px"]) if "pixels_per_px" in data else 1
        one = run(data["frames"], data["centre_px"], finer)
    return row_of(file.stem, [one], SPLINE_PX.get(file.stem))


def row_of(name: str, runs: list[dict[str, Any]], goal: float | None) -> dict[str, Any]:
    steps = np.concatenate([one["steps"] for one in runs])
    squares = np.concatenate([one["squares"] for one in runs])
    timed = [one for one in runs if one["steps"]]
    error = float(np.mean(steps)) if len(steps) else None
    per_run = [np.mean(one["squares"]) for one in timed]
    return {
        "name": name, "trials": len(squares), "error_px": error,
        "goal_px": goal, "ratio": None if goal is None or error is None else error / goal,
        "nees": float(np.mean(squares)) if len(squares) else None,
        "nees_se": float(np.std(per_run) / np.sqrt(len(per_run))) if len(per_run) > 1 else None,
        "refused": sum(one["refused"] for one in runs),
        "why": next((one["why"] for one in runs if one["why"]), ""),
        "learnt_ms": float(np.median([one["learnt_ms"] for one in timed])) if timed else None,
        "fit_ms": float(np.median([one["fit_ms"] for one in timed])) if timed else None,
        "rician": sum(one["kind"] == "rician" for one in timed),
    }  # fmt: skip


def say(row: dict[str, Any], quiet: bool) -> None:
    if quiet:
        return

    def text(key: str, spec: str) -> str:
        return "-" if row[key] is None else format(row[key], spec)

    print(
        f"{row['name']:30s} error {text('error_px', '.4f')}  of goal {text('ratio', '.3f'):>5s}  "
        f"NEES {text('nees', '.2f')} ± {text('nees_se', '.2f')}  refused {row['refused']}  "
        f"learnt {text('learnt_ms', '.0f')} ms, fit {text('fit_ms', '.1f')} ms  "
        f"{'magnitude ' + str(row['rician']) if row['rician'] else ''} {row['why'][:90]}",
        flush=True,
    )


if __name__ == "__main__":
    main()
