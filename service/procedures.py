"""Which procedures there are: from the recorded name and arguments to a generator, and results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Procedure
from service.approach import ApproachArguments, Arrival, approach
from service.calibration import Calibration, CalibrationArguments, calibrate
from service.guide_approach import GuideApproachArguments, GuideArrival, approach_guide
from service.guide_calibration import GuideCalibrationArguments, calibrate_guide
from service.guide_geometry import GuideGeometry
from service.jog import JogEnd, jog
from service.recording import Place, RecordingArguments, record_place
from service.steps import ProcedureSteps

CALIBRATION = "calibration"
APPROACH = "approach"
RECORDING = "recording"
GUIDE_CALIBRATION = "guide_calibration"
GUIDE_APPROACH = "guide_approach"
JOG = "jog"
CALIBRATIONS, APPROACHES = (CALIBRATION, GUIDE_CALIBRATION), (APPROACH, GUIDE_APPROACH)


def build_procedure(row: Procedure) -> ProcedureSteps[Any]:
    """Return a fresh generator of the recorded procedure; raises KeyError for an unknown name."""
    return _BUILDERS[row.name](row.arguments)


def calibration_arguments(arguments: CalibrationArguments) -> dict[str, Any]:
    return asdict(arguments)


def approach_arguments(arguments: ApproachArguments, start: Calibration) -> dict[str, Any]:
    return {"arguments": asdict(arguments), "start": start.to_json()}


def recording_arguments(arguments: RecordingArguments, start: Calibration) -> dict[str, Any]:
    return {"arguments": asdict(arguments), "start": start.to_json()}


def guide_calibration_arguments(arguments: GuideCalibrationArguments) -> dict[str, Any]:
    return asdict(arguments)


def guide_approach_arguments(
    arguments: GuideApproachArguments, start: Calibration
) -> dict[str, Any]:
    return {"arguments": asdict(arguments), "start": start.to_json()}


def result_to_json(
    result: Calibration | Arrival | GuideArrival | Place | JogEnd,
) -> dict[str, Any]:
    return result.to_json()


def latest_calibration(record: CaseRecord, *, guide: bool = False) -> Calibration | None:
    """What the last procedure that came to its end knew; a later calibration replaces it.

    guide: of both fiducials and four axes, else of one and two.
    """
    calibration = record.last_procedure(GUIDE_CALIBRATION if guide else CALIBRATION, "done")
    if calibration is None or calibration.result is None:
        return None
    newest = calibration
    for name in (GUIDE_APPROACH,) if guide else (APPROACH, RECORDING):
        row = record.last_procedure(name, "done")
        if row is not None and row.result is not None and row.procedure_id > newest.procedure_id:
            newest = row
    known = newest.result or {}
    return Calibration.from_json(known.get("calibration", known))


def _build_calibration(value: Mapping[str, Any]) -> ProcedureSteps[Calibration]:
    first, second = value["axes"]
    shifts_px = tuple((row, col) for row, col in value["shifts_px"])
    return calibrate(
        CalibrationArguments(**{**value, "axes": (first, second), "shifts_px": shifts_px})
    )


def _build_approach(value: Mapping[str, Any]) -> ProcedureSteps[Arrival]:
    fields = dict(value["arguments"])
    row, col = fields["target_mm"]
    travel_um = {axis: (low, high) for axis, (low, high) in fields["travel_um"].items()}
    arguments = ApproachArguments(**{**fields, "target_mm": (row, col), "travel_um": travel_um})
    return approach(arguments, Calibration.from_json(value["start"]))


def _build_recording(value: Mapping[str, Any]) -> ProcedureSteps[Place]:
    arguments = RecordingArguments(**value["arguments"])
    return record_place(arguments, Calibration.from_json(value["start"]))


def _guide_geometry(value: Mapping[str, Any]) -> GuideGeometry:
    upper_mm, lower_mm = value["slice_positions_mm"]
    return GuideGeometry(**{**value, "slice_positions_mm": (upper_mm, lower_mm)})


def _build_guide_calibration(value: Mapping[str, Any]) -> ProcedureSteps[Calibration]:
    xt, yt, xb, yb = value["axes"]
    geometry = _guide_geometry(value["geometry"])
    return calibrate_guide(
        GuideCalibrationArguments(**{**value, "axes": (xt, yt, xb, yb), "geometry": geometry})
    )


def _build_guide_approach(value: Mapping[str, Any]) -> ProcedureSteps[GuideArrival]:
    fields = dict(value["arguments"])
    fields["geometry"] = _guide_geometry(fields["geometry"])
    fields["target_mm"] = tuple(fields["target_mm"])
    fields["travel_um"] = {axis: (low, high) for axis, (low, high) in fields["travel_um"].items()}
    return approach_guide(GuideApproachArguments(**fields), Calibration.from_json(value["start"]))


_BUILDERS: dict[str, Callable[[Mapping[str, Any]], ProcedureSteps[Any]]] = {
    CALIBRATION: _build_calibration,
    APPROACH: _build_approach,
    RECORDING: _build_recording,
    GUIDE_CALIBRATION: _build_guide_calibration,
    GUIDE_APPROACH: _build_guide_approach,
    JOG: lambda value: jog(value["setpoints_um"]),
}
