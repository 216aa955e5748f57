"""`autospine report CASE`: one page of a case, in one file: images, tables, plots."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.patches import Ellipse

from case_record.record import CaseRecord
from case_record.rows import Measurement
from room_config.exit_codes import BAD_INPUT
from service.cli.report_case import assigned_by_hand, case_table, punctures, settings
from service.cli.report_html import (
    STYLE,
    html_table,
    image_tag,
    new_figure,
    number_text,
    time_text,
)
from service.procedure.estimate import axis_sigma
from service.procedure.plane import ImagePlane
from service.procedure.registry import APPROACHES, CALIBRATIONS
from service.procedure.targets import all_targets
from service.room.history import arrival_by_hand, known_targets, targets_over_time
from service.room.images import ImageMissingError, slice_pixels

app = typer.Typer(add_completion=False)
_CROP_PX = 16
_CHI2_95 = 5.991
_SCALE_MM = 5.0


class ReportError(ValueError):
    """The report cannot be written; one line."""

    exit_code = BAD_INPUT


@app.command()
def report(
    case: Annotated[Path, typer.Argument(help="The case's folder.")],
    out: Annotated[
        Path | None, typer.Option(help="The page to write; by default CASE-report.html here.")
    ] = None,
) -> None:
    """Write one page of a case: images, tables, plots."""
    target = out or Path(f"{case.resolve().name}-report.html")
    with CaseRecord(case, read_only=True) as record:
        page = report_page(record)
    fresh = target.with_name(target.name + ".part")
    try:
        fresh.write_text(page, encoding="utf-8")
        os.replace(fresh, target)
    except OSError as error:
        raise ReportError(f"{target}: cannot be written ({error.strerror})") from error
    print(f"{target}: written")


def report_page(record: CaseRecord) -> str:
    """The whole page as HTML; it loads nothing."""
    case = record.case()
    if case is None:
        raise ReportError(f"{record.case_dir}: no case here")
    whole = record.verify()
    described = record.last_event("case_described")
    name = (described.body.get("label") if described else "") or case.name
    title = f"{name}: {time_text(case.created_s)}"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        '<p class="warning">Research software, not a medical device.</p>',
        (
            f"<p>Case {html.escape(case.case_uid)}, {whole.events} events; the record verifies; "
            f"its head is <code>{whole.head}</code>.</p>"
        ),
        *case_table(record),
        *punctures(record),
        *_targets(record),
        *settings(record),
        *_approaches(record),
        *_needles(record),
        *_calibrations(record),
        *_plots(record),
        *_images(record),
        *_measurements(record),
        *assigned_by_hand(record),
        *_set_aside(record),
        *_event_list(record),
    ]
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    return f"<!DOCTYPE html><html lang=en><head>{head}</head><body>{''.join(body)}</body></html>\n"


def _targets(record: CaseRecord) -> Iterable[str]:
    rows = [
        (
            target.number,
            target.label,
            " ".join(f"{value:.3f}" for value in target.patient_mm),
            "tissue" if target.in_water else "fiducial",
            time_text(target.set_s),
            target.who,
            ", ".join(str(number) for number in target.approaches),
        )
        for target in known_targets(record)
    ]
    yield "<h2>Targets</h2>"
    yield html_table(("no.", "label", "patient mm (LPS)", "of", "set", "by", "approaches"), rows)


def _needles(record: CaseRecord) -> Iterable[str]:
    """With two fiducials: where the needle's line runs at the end of each approach."""
    rows = []
    for row in record.procedures():
        result = row.result or {}
        if row.state != "done" or "tip_mm" not in result:
            continue
        covariance = np.array(result["tip_covariance_mm2"])
        rows.append(
            (
                row.procedure_id,
                *(" ".join(f"{x:.3f}" for x in result[name]) for name in ("joint_mm", "tip_mm")),
                number_text(result["tip_below_joint_mm"], 1, 1),
                " ".join(f"{1000 * x:+.0f}" for x in result["tip_error_mm"]),
                " ".join(f"{1000 * x:.0f}" for x in np.sqrt(np.diag(covariance))),
                number_text(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]), 1, 2),
            )
        )
    if rows:
        yield "<h2>Where the needle points</h2>"
        heads = (
            "approach",
            "lower ball joint, patient mm",
            "tip, patient mm",
            "depth mm",
            "tip distance µm (row, col)",
            "σ µm (row, col)",
            "correlation",
        )
        yield html_table(heads, rows)


def _approaches(record: CaseRecord) -> Iterable[str]:
    rows = []
    for row in record.procedures():
        if row.name not in APPROACHES:
            continue
        result = dict(row.result or {})
        minutes = ((row.ended_s or row.started_s) - row.started_s) / 60
        rows.append(
            (
                row.procedure_id,
                row.name.replace("_", " "),
                row.arguments.get("target", ""),
                row.state,
                *(number_text(result.get(name), 1000) for name in ("error_mm", "sigma_mm")),
                number_text(result.get("probability"), 1, 3),
                result.get("iterations", ""),
                result.get("frames", ""),
                f"{minutes:.1f}",
                "by hand" if arrival_by_hand(record, row.procedure_id) else "",
                result.get("reason", ""),
            )
        )
    yield "<h2>Approaches</h2>"
    heads = (
        "no.",
        "",
        "target",
        "state",
        "distance µm",
        "σ µm",
        "P",
        "moves",
        "slices",
        "min",
        "slices used",
        "reason",
    )
    yield html_table(heads, rows)


def _calibrations(record: CaseRecord) -> Iterable[str]:
    yield "<h2>Calibrations</h2>"
    rows = []
    for row in record.procedures():
        if row.name not in CALIBRATIONS:
            continue
        found = dict(row.result or {})
        columns = found.get("jacobian", {}).get("columns")
        shown = (
            "" if columns is None else "; ".join(" ".join(f"{x:+.4f}" for x in r) for r in columns)
        )
        axes = ", ".join(found.get("jacobian", {}).get("axes", ()))
        rows.append((row.procedure_id, row.state, axes, shown, found.get("reason", "")))
    heads = ("no.", "state", "axes", "image Jacobian mm/mm (rows; per axis up, down)", "reason")
    yield html_table(heads, rows)


def _plots(record: CaseRecord) -> Iterable[str]:
    """Error to the target of its time, with uncertainty, over the measurements."""
    targets = targets_over_time(record)
    numbers, errors, sigmas = [], [], []
    for row in record.measurements("done"):
        body = targets.body_of(row)
        if body.error_mm is not None and body.sigma_mm is not None:
            numbers.append(row.measurement_id)
            errors.append(body.error_mm)
            sigmas.append(body.sigma_mm)
    if not numbers:
        return
    figure, axes = new_figure(8, 3)
    axes.errorbar(numbers, errors, yerr=sigmas, fmt=".", capsize=2)
    axes.set(xlabel="measurement", ylabel="distance to target, mm", yscale="log")
    axes.xaxis.get_major_locator().set_params(integer=True)
    for which in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        which("{x:.2g}")
    axes.grid(visible=True, which="both", alpha=0.3)
    yield "<h2>Distance to the target</h2>"
    yield image_tag(figure, "distance to the target, measurement by measurement")


def _images(record: CaseRecord) -> Iterable[str]:
    """The last slice of every approach around fiducial and target."""
    shown = []
    targets = {target.number: target for target in all_targets(record)}
    for row in record.procedures():
        if row.name in APPROACHES and row.state == "done" and row.result:
            measurement = record.measurement(int(row.result["measurement_id"]))
            target = targets.get(row.arguments.get("target", 0))
            point = None if target is None else target.patient_mm
            tag = _close_up(record, measurement, point, f"approach {row.procedure_id}")
            if tag:
                shown.append(tag)
    if shown:
        yield "<h2>Fiducial position at the end of each approach</h2>"
        yield from shown


def _close_up(
    record: CaseRecord, measurement: Measurement, target_mm: Sequence[float] | None, title: str
) -> str:
    """The fiducial with its 95 % ellipse, the target, and a scale."""
    found = measurement.result or {}
    try:
        pixels = slice_pixels(record, int(found["slice_id"]))
    except (ImageMissingError, KeyError):
        return ""
    row, col = found["centre_px"]
    figure, axes = new_figure(3, 3)
    axes.imshow(pixels, cmap="gray")
    axes.set_xlim(col - _CROP_PX, col + _CROP_PX)
    axes.set_ylim(row + _CROP_PX, row - _CROP_PX)
    axes.set_title(f"{title}, measurement {measurement.measurement_id}", fontsize=9)
    axes.axis("off")
    axes.add_patch(Ellipse((col, row), *[2 * found["radius_px"]] * 2, fill=False, color="#4af"))
    variances, vectors = np.linalg.eigh(np.array(found["covariance_px2"]))
    height, width = 2 * np.sqrt(_CHI2_95 * variances)
    angle = float(np.degrees(np.arctan2(vectors[0, 1], vectors[1, 1])))
    axes.add_patch(Ellipse((col, row), width, height, angle=angle, fill=False, color="#fa4"))
    plane = ImagePlane.from_json(found["plane"])
    if target_mm is not None:
        offset_mm = plane.from_patient(list(target_mm)) - np.array(found["plane_mm"])
        down, across = offset_mm / np.array(plane.spacing_mm)
        axes.plot(col + across, row + down, "+", color="#fd4", markersize=14)
    left, bottom = col - 0.9 * _CROP_PX, row + 0.9 * _CROP_PX
    axes.plot([left, left + _SCALE_MM / plane.spacing_mm[1]], [bottom, bottom], color="w")
    axes.text(left, bottom - 1, f"{_SCALE_MM:g} mm", color="w", fontsize=8)
    return image_tag(figure, title)


def _measurements(record: CaseRecord) -> Iterable[str]:
    rows = []
    for row in record.measurements():
        found = row.result or {}
        sigma = None
        if found:
            sigma = axis_sigma(found["covariance_mm2"])
        place = " ".join(f"{x:.3f}" for x in found.get("patient_mm", ()))
        rows.append(
            (
                row.measurement_id,
                row.method,
                row.state,
                found.get("n_frames", ""),
                place,
                number_text(sigma, 1000),
                number_text(found.get("snr")),
                number_text(found.get("chi2_per_dof"), 1, 2),
                row.reason,
            )
        )
    yield "<h2>Measurements</h2>"
    heads = (
        "no.",
        "method",
        "state",
        "slices",
        "patient mm (LPS)",
        "σ µm",
        "SNR",
        "χ²/dof",
        "reason",
    )
    yield html_table(heads, rows)


def _set_aside(record: CaseRecord) -> Iterable[str]:
    rows = [
        (row.slice_id, time_text(row.received_s), row.reason_code, row.reason)
        for row in record.slices(state="quarantined")
    ]
    if rows:
        yield "<h2>Slices set aside</h2>"
        yield html_table(("slice", "received", "code", "reason"), rows)


def _event_list(record: CaseRecord) -> Iterable[str]:
    rows = [
        (event.event_id, time_text(event.wall_s), event.source, event.who, event.kind)
        for event in record.newest_events(500)
    ]
    yield "<h2>Events (latest 500)</h2>"
    yield html_table(("no.", "time", "source", "who", "what"), sorted(rows))
