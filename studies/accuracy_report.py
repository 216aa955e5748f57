"""The report of `studies.real_data` as Markdown."""

from typing import Any

import numpy as np

from studies.repeats import METHODS, OURS

COARSE = ("opencv HOUGH_GRADIENT", "opencv HOUGH_GRADIENT_ALT", "skimage hough_circle")

HEAD = """# Accuracy on real slices

Public phantom slices from several vendors, none of them ours: no MR slices of Vitamin-E fiducials
are public. Every figure below was measured by

    python -m studies.real_data --data FOLDER --out docs/accuracy.md

What is measured here is the fit of a disc to one slice, which finds the fiducial before there is a
template and where its centre itself is asked for. Steering goes by the template, the fiducial's own
image, whose displacements `python benchmarks/template.py` measures on drawn fiducials with truth.

All methods get the same pixels, the same start and the same radius. Ours is the maximum-likelihood
fit of `sr_engine.locate.refine`: disc with or without a wall, through the likeliest of a short list
of point spreads, one for each group. The others, at settings of our choosing, are described in
`studies/peers.py`.

What weakens these figures: the short list of point spreads and the limit for outliers in
`sr_engine.locate` were chosen among five variants by their scatter in about half of these very
groups, so ours is somewhat flattered; the other methods were not tuned in this way. The known
displacements act on magnitudes, not on the scanner's complex data. Many groups are a single pair.
"""

SUMMARY = """## Summary

Scatter: std per axis from slice to slice, px, median over the groups (see below). Residual: rms
distance of the vials from the consensus of the other scanners, mm, mean over the scans.

| method | groups answered | scatter, as taken | scatter, displaced | residual mm |
|---|---:|---:|---:|---:|"""

REPEATABILITY = """## Repeatability

Groups of slices of one thing under one geometry: echo trains, inversion series, acquisitions back
to back, dynamic series. The scatter is the rms difference of successive slices over √2, so that
slow drift is left out; of several objects the median.

*As taken*: the slices as they are. The phantom stays on the same pixel phase, so a method that
answers in whole or half pixels (OpenCV, scikit-image) repeats to 0 while it is wrong by up to half
a pixel; those are left out of "best other" here, and by their bare figures would win. *Displaced*:
every slice moved by a known random part of a pixel first, by a phase on its k-space,
that part then subtracted from the answer: what the robot does
with the fiducial. Here all count.

| group | kind | slices | objects | ours, as taken | best other | ours, displaced | best other |
|---|---|---:|---:|---:|---|---:|---|"""

GEOMETRY = """## Geometric accuracy

The 14 vials of one plate design, as three scanners see them. Each scan's vials (median over its
slices) are fitted by a similarity to the consensus of the *other* scanners, by the same method, and
to the drawing. The drawing is not the truth: plates are built to about half a millimetre.

| scan | method | vials | consensus mm | drawing mm |
|---|---|---:|---:|---:|"""


def write_report(results: dict[str, Any]) -> str:
    """The whole report."""
    rows = [row for row in results["repeats"] if row["objects"]]
    parts = [
        HEAD,
        summary(rows, results["plates"]),
        repeatability(rows),
        lost_groups(rows),
        geometry(results["plates"]),
        detection(results["vials"], results["none"]),
    ]
    return "\n".join(parts)


def summary(rows: list[dict[str, Any]], plates: list[dict[str, Any]]) -> str:
    lines = [SUMMARY]
    for name in METHODS:
        taken = [r["methods"][name]["as_taken_px"] for r in rows]
        moved = [r["methods"][name]["displaced_px"] for r in rows]
        answered = sum(v is not None for v in taken)
        residual = [p["consensus_mm"] for p in plates if p["method"] == name]
        lines.append(
            f"| {name} | {answered} of {len(rows)} | {median(taken)} | {median(moved)} | "
            f"{mean(residual)} |"
        )
    return "\n".join(lines) + "\n"


def median(values: list[float | None]) -> str:
    """Median, a group without an answer counting as worse than any."""
    filled = [np.inf if v is None else v for v in values]
    middle = float(np.median(filled)) if filled else np.inf
    return f"{middle:.4f}" if np.isfinite(middle) else "-"


def mean(values: list[float]) -> str:
    return f"{np.mean(values):.3f} ({len(values)} scans)" if values else "-"


def repeatability(rows: list[dict[str, Any]]) -> str:
    lines = [REPEATABILITY]
    for row in rows:
        cells = [row["group"], row["kind"], str(row["slices"]), str(row["objects"])]
        for key in ("as_taken_px", "displaced_px"):
            cells += [px(row["methods"][OURS][key]), best_other(row, key)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def px(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def peers_of(row: dict[str, Any], key: str) -> dict[str, float]:
    """Values of the others; as taken without those that answer on a grid."""
    return {
        name: figures[key]
        for name, figures in row["methods"].items()
        if name != OURS
        and figures[key] is not None
        and not (key == "as_taken_px" and name in COARSE)
    }


def best_other(row: dict[str, Any], key: str) -> str:
    values = peers_of(row, key)
    if not values:
        return "-"
    name = min(values, key=lambda n: values[n])
    return f"{values[name]:.4f} {name}"


def lost_groups(rows: list[dict[str, Any]]) -> str:
    """Where another method scatters less than ours, and what the figures say of the cause."""
    lines = ["### Where ours is not the best\n"]
    for key, title in (("as_taken_px", "As taken"), ("displaced_px", "Displaced")):
        lost = []
        for row in rows:
            ours, values = row["methods"][OURS][key], peers_of(row, key)
            better = {n: v for n, v in values.items() if ours is None or v < ours}
            if better:
                lost.append((row, ours, better))
        total = len(rows)
        lines.append(f"{title}: ours is the best in {total - len(lost)} of {total} groups.\n")
        lines += [f"- {reason(row, ours, better, key)}" for row, ours, better in lost]
        lines.append("")
    return "\n".join(lines)


def reason(row: dict[str, Any], ours: float | None, better: dict[str, float], key: str) -> str:
    names = ", ".join(f"{n} {v:.4f}" for n, v in sorted(better.items(), key=lambda i: i[1]))
    text = f"`{row['group']}`: ours {px(ours)}, smaller: {names}. "
    if ours is None:
        return text + "Ours failed in too many slices."
    pairs = row["slices"] - 1
    if pairs == 1:
        text += "One pair only: its difference is one draw from each method's scatter, "
        text += f"uncertain by {100 / np.sqrt(4 * row['objects']):.0f} %. "
    motion = row["motion_px"]
    beside = {n: m["beside_motion_px"] for n, m in row["methods"].items()}
    mine, others = beside[OURS], {n: beside[n] for n in better if beside[n] is not None}
    text += f"The object's own pixels moved by {motion:.4f} (correlation, no model of the outline)"
    if mine is None:
        return text + "."
    shown = ", ".join(f"{n} {v:.4f}" for n, v in sorted(others.items(), key=lambda i: i[1]))
    text += f"; with that motion subtracted, ours scatters by {mine:.4f}, "
    text += f"{shown or 'the others not at all'}. "
    if all(mine <= value for value in others.values()):
        text += "Ours is then the smallest: it follows a motion that the others see only in part."
    elif mine < 0.5 * ours:
        text += "Most of ours is that motion."
    else:
        text += "Motion does not explain it: here the fit itself is worse."
    return text


def geometry(plates: list[dict[str, Any]]) -> str:
    lines = [GEOMETRY]
    lines += [
        f"| {p['scan']} | {p['method']} | {p['vials']} | {p['consensus_mm']:.3f} | "
        f"{p['design_mm']:.3f} |"
        for p in sorted(plates, key=lambda p: (p["scan"], p["consensus_mm"]))
    ]
    return "\n".join(lines) + "\n\n" + geometry_verdict(plates)


def _why(ours: dict[str, Any], better: list[dict[str, Any]]) -> str:
    """What the residuals have in common, and what each method has for its own."""
    texts = []
    for other in better:
        text = (
            f"Smaller: {other['method']} {other['consensus_mm']:.3f}. Vial by vial the two "
            f"residuals are alike (correlation {other['like_ours']:.2f})"
        )
        if ours["again_mm"] is not None and other["again_mm"] is not None:
            text += (
                "; between this scan and the same scanner's other series of the same plate, where "
                f"plate and gradients are the same, ours differs by {ours['again_mm']:.3f} mm, "
                f"{other['method']} by {other['again_mm']:.3f} mm"
            )
            if ours["again_mm"] < other["again_mm"]:
                text += (
                    ". So most of the residual comes from the plate and the gradients, and the "
                    "other method's larger error of its own happens to reduce it here"
                )
        texts.append(text + ".")
    return " ".join(texts)


def geometry_verdict(plates: list[dict[str, Any]]) -> str:
    lines = []
    for scan in sorted({p["scan"] for p in plates}):
        own = {p["method"]: p for p in plates if p["scan"] == scan}
        if OURS not in own:
            lines.append(f"- `{scan}`: ours has too few vials.")
            continue
        ours = own.pop(OURS)
        better = [p for p in own.values() if p["consensus_mm"] < ours["consensus_mm"]]
        if better:
            lines.append(f"- `{scan}`: ours {ours['consensus_mm']:.3f} mm. {_why(ours, better)}")
    if not lines:
        return "Ours is not larger than any other's in any scan.\n"
    return "Where another's residual is smaller:\n\n" + "\n".join(lines) + "\n"


def detection(vials: list[dict[str, Any]], none: list[dict[str, Any]]) -> str:
    seen, of = sum(v["seen"] for v in vials), sum(v["of"] for v in vials)
    whole = [v for v in vials if v["seen"] == v["of"]]
    share = 100 * seen / max(of, 1)
    found = (
        "Round objects of the coronal plates (14 vials and the three posts), slice by slice, "
        f"without a start: {seen} of {of} ({share:.1f} %); all of them in {len(whole)} of "
        f"{len(vials)} slices. What counts is what detection finds in most slices of a series: "
        "17 objects in each, 14 of which lie on the plate's drawing.\n"
    )
    lines = ["## Detection\n", found]
    lines += [
        f"- `{v['slice']}`: {v['seen']} of {v['of']}; the others lack contrast, or an edge in "
        "enough directions"
        for v in vials
        if v["seen"] < v["of"]
    ]
    clean = [n for n in none if not n["found"]]
    nothing = (
        "Files without a round object (rectangles, noise, scrambled pixels, phase images): "
        f"{len(clean)} of {len(none)} yield none.\n"
    )
    lines += ["", nothing, *(f"- `{n['path']}`: {n['found']} found" for n in none if n["found"])]
    return "\n".join(lines) + "\n"
