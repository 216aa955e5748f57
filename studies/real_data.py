"""Repeatability and geometric accuracy on real phantom slices, ours beside other methods.

    python -m studies.real_data --data FOLDER [--out docs/accuracy.md] [--quick]

FOLDER holds the public slices and their `manifest.csv`. Writes the report as Markdown; every
figure in it is measured by this command.
"""

import argparse
import csv
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dicom_slice.pixels import magnitude_pixels
from dicom_slice.reasons import UnusableError
from room_config.exit_codes import BAD_INPUT
from sr_engine.detect import detect
from sr_engine.errors import EngineError
from studies.accuracy_report import write_report
from studies.plates import (
    consensus,
    in_one_order,
    likeness,
    match_to_design,
    residual_mm,
    residuals_mm,
    taken,
)
from studies.repeats import (
    METHODS,
    VIAL_RADII_MM,
    Group,
    Tracks,
    find_objects,
    load_groups,
    registered_steps_px,
    scatter,
    scatter_beside_motion,
    track,
)

Array = NDArray[np.float64]

DISPLACED_SLICES = 8  # of a group, at random sub-pixel displacements
MUST_YIELD_NONE = (
    "snr_philips_cor",
    "snr_ge_sag",
    "noise_only",
    "dicom2nifti/hdr",
    "prisma_phase",
)
ALL_RADII_PX = (3.0, 0.48)  # least, and most as a share of the frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with manifest.csv")
    parser.add_argument("--out", type=Path, default=Path("docs/accuracy.md"))
    parser.add_argument("--json", type=Path, help="also write the figures as JSON here")
    parser.add_argument("--quick", action="store_true", help="four slices a group")
    options = parser.parse_args()
    if not (options.data / "manifest.csv").is_file():
        print(f"no manifest.csv in {options.data}", file=sys.stderr)
        raise SystemExit(BAD_INPUT)
    warnings.simplefilter("ignore", RuntimeWarning)  # medians over methods that all failed
    results = measure(options.data, 4 if options.quick else None)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(write_report(results))
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1))
    print(f"wrote {options.out}")


def measure(data: Path, most_slices: int | None = None) -> dict[str, Any]:
    """All figures of the report."""
    repeats, plates = [], []
    for group in load_groups(data):
        if most_slices is not None:
            group = shortened(group, most_slices)
        objects = find_objects(group)
        if not objects:
            repeats.append({"group": group.name, "kind": group.kind, "objects": 0})
            continue
        as_taken = track(group, objects)
        repeats.append(repeat_row(group, as_taken))
        if group.has_vials:
            plates.append(as_taken)
        print(f"{group.name}: {len(objects)} objects, {len(group.frames)} slices", file=sys.stderr)
    return {
        "repeats": repeats,
        "plates": plate_rows(plates, read_design(data)),
        "vials": vial_rows(plates),
        "none": none_rows(data),
    }


def shortened(group: Group, most: int) -> Group:
    return Group(group.name, group.kind, group.spacing_mm, group.paths[:most], group.frames[:most])


def repeat_row(group: Group, as_taken: Tracks) -> dict[str, Any]:
    """Scatter of every method in one group, as taken and at random sub-pixel displacements."""
    few = shortened(group, DISPLACED_SLICES)
    moves = np.random.default_rng(1).uniform(-0.5, 0.5, (len(few.frames), 2))
    moved = track(few, list(as_taken.objects), moves)
    methods = {}
    steps = registered_steps_px(as_taken)
    for name in METHODS:
        taken_there, at_phases = (scatter(t.centres_px[name]) for t in (as_taken, moved))
        methods[name] = {
            "as_taken_px": finite(taken_there.neighbours_px),
            "relative_px": finite(taken_there.relative_px),
            "displaced_px": finite(at_phases.neighbours_px),
            "beside_motion_px": finite(scatter_beside_motion(as_taken, name, steps)),
            "failures": taken_there.failures,
            "attempts": taken_there.attempts,
        }
    return {
        "group": group.name, "kind": group.kind, "objects": len(as_taken.objects),
        "slices": len(group.frames), "spacing_mm": group.spacing_mm[0], "methods": methods,
        "motion_px": float(np.median(np.sqrt(np.mean(steps**2, axis=(1, 2)) / 2))),
    }  # fmt: skip


def finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def read_design(data: Path) -> Array:
    """Nominal vial positions (14, 2) in mm."""
    with (data / "nist_plate_design_mm.csv").open(newline="") as file:
        return np.array([(float(r["x_mm"]), float(r["y_mm"])) for r in csv.DictReader(file)])


def plate_rows(plates: list[Tracks], design_mm: Array) -> list[dict[str, Any]]:
    """Residual (mm) of each scan's vials against what the other scanners agree on."""
    rows = []
    for plate in ("plate4", "plate5"):
        scans = [t for t in plates if plate in t.group.name]
        if len({scanner_of(t) for t in scans}) < 2:
            continue
        places = [positions_mm(t, METHODS[0]) for t in scans]
        orders = in_one_order(places, [match_to_design(p, design_mm) for p in places])
        vials = {
            name: [taken(positions_mm(t, name), o) for t, o in zip(scans, orders, strict=True)]
            for name in METHODS
        }
        for k, scan in enumerate(scans):
            rows += scan_rows(scans, vials, k, design_mm, {"plate": plate, "scan": scan.group.name})
    return rows


def scan_rows(
    scans: list[Tracks],
    vials_mm: dict[str, list[Array]],
    k: int,
    design_mm: Array,
    names: dict[str, str],
) -> list[dict[str, Any]]:
    """One scan by every method: beside the other scanners, the drawing, its own scanner again."""
    rows, ours_mm = [], None
    for name, places in vials_mm.items():
        own = places[k]
        beside = [
            (scanner_of(scan) == scanner_of(scans[k]), place)
            for j, (scan, place) in enumerate(zip(scans, places, strict=True))
            if j != k and usable(place)
        ]
        others = [place for same, place in beside if not same]
        again = [place for same, place in beside if same]
        if not usable(own) or not others:
            continue
        agreed = consensus(others)
        left_mm = residuals_mm(own, agreed)
        if name == METHODS[0]:
            ours_mm = left_mm
        rows.append({
            **names, "method": name,
            "vials": int(np.isfinite(own[:, 0]).sum()),
            "consensus_mm": residual_mm(own, agreed),
            "design_mm": residual_mm(own, design_mm),
            "again_mm": residual_mm(own, again[0]) if again else None,
            "like_ours": None if ours_mm is None else likeness(left_mm, ours_mm),
        })  # fmt: skip
    return rows


def usable(vials_mm: Array) -> bool:
    return bool(np.isfinite(vials_mm).all(axis=1).sum() >= 10)


def scanner_of(scan: Tracks) -> str:
    return next(part for part in scan.group.name.split("_") if part.startswith("site"))


def positions_mm(scan: Tracks, method: str) -> Array:
    """Median over the slices of each object's centre, in mm."""
    return np.nanmedian(scan.centres_px[method], axis=1) * scan.group.spacing_mm


def vial_rows(plates: list[Tracks]) -> list[dict[str, Any]]:
    """How many of the 14 vials detection finds in every slice of the plates."""
    rows = []
    for scan in plates:
        spacing = scan.group.spacing_mm[0]
        radii = (VIAL_RADII_MM[0] / spacing, VIAL_RADII_MM[1] / spacing)
        for path, frame in zip(scan.group.paths, scan.group.frames, strict=True):
            found = [c.centre_px for c in detect(frame, radii)]
            known = [c.centre_px for c in scan.objects]
            seen = sum(any(np.hypot(*np.subtract(k, f)) < 2.5 for f in found) for k in known)
            rows.append({"slice": f"{scan.group.name}/{path.name}", "of": len(known), "seen": seen})
    return rows


def none_rows(data: Path) -> list[dict[str, Any]]:
    """What detection finds where there is nothing round to find."""
    with (data / "manifest.csv").open(newline="") as file:
        rows = [
            r
            for r in csv.DictReader(file)
            if any(part in r["path"] for part in MUST_YIELD_NONE)
            and r["subject"] in ("phantom", "pixels_scrambled")
        ]
    results = []
    for row in rows:
        try:
            frame = magnitude_pixels(data / row["path"])
            radii = (ALL_RADII_PX[0], ALL_RADII_PX[1] * min(frame.shape))
            found, note = len(detect(frame, radii)), ""
        except (UnusableError, EngineError) as error:
            found, note = 0, str(error)
        results.append({"path": row["path"], "found": found, "note": note})
    return results


if __name__ == "__main__":
    main()
