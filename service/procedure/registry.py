"""Which procedures there are: from the recorded name and arguments to a generator, and results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Procedure
from robot_bridge.protocol.phases import WorkPhase
from service.procedure.aim import ApproachArguments
from service.procedure.approach import Arrival, approach
from service.procedure.calibration import Calibration, CalibrationArguments, calibrate
from service.procedure.fiducials import geometry_from_json
from service.procedure.identity import ProofArguments
from service.procedure.observe import ValidationGate, move
from service.procedure.recording import Place, RecordingArguments, record_place
from service.procedure.scan_frame import calibration_good_since, frame_of, other_place_since
from service.procedure.steps import MoveTo, ProcedureSteps

# by these names in the record and the API; guide: the same procedure with two fiducials, four axes
CALIBRATION = "calibration"
APPROACH = "approach"
RECORDING = "recording"
GUIDE_CALIBRATION = "guide_calibration"
GUIDE_APPROACH = "guide_approach"
GUIDE_RECORDING = "guide_recording"
JOG = "jog"
CALIBRATIONS, APPROACHES = (CALIBRATION, GUIDE_CALIBRATION), (APPROACH, GUIDE_APPROACH)

Arguments = CalibrationArguments | ApproachArguments | RecordingArguments


@dataclass(frozen=True)
class JogEnd:
    """Where the axes stood when the move had ended."""

    readback_um: Mapping[str, int]

    def to_json(self) -> dict[str, Any]:
        return {"readback_um": dict(self.readback_um)}


def jog(setpoints_um: Mapping[str, int]) -> ProcedureSteps[JogEnd]:
    """Go to the setpoints; raises ProcedureFailedError if the bridge refuses."""
    moved = yield from move(MoveTo(dict(setpoints_um), "manual", phase=WorkPhase.MANUAL))
    return JogEnd(moved.readback_um)


def build_procedure(row: Procedure) -> ProcedureSteps[Any]:
    """Return a fresh generator of the recorded procedure; raises KeyError for an unknown name."""
    return _BUILDERS[row.name](row.arguments)


def calibration_arguments(arguments: CalibrationArguments) -> dict[str, Any]:
    return _recorded(arguments)


def approach_arguments(arguments: ApproachArguments, start: Calibration) -> dict[str, Any]:
    return {"arguments": _recorded(arguments), "start": start.to_json()}


def recording_arguments(arguments: RecordingArguments, start: Calibration) -> dict[str, Any]:
    return {"arguments": _recorded(arguments), "start": start.to_json()}


def _recorded(arguments: Arguments) -> dict[str, Any]:
    """As the record has them: the validation gate's numbers stand among the others."""
    values = asdict(arguments)
    gate: dict[str, Any] = values.pop("gate")
    return {**values, **gate}


def _told(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments again, from what `_recorded` made of them, in a program before as well."""
    values = dict(recorded)
    gate = ValidationGate(
        **{field.name: values.pop(field.name) for field in fields(ValidationGate)}
    )
    if "proof" in values:
        values["proof"] = ProofArguments(**values["proof"])
    if "travel_um" in values:
        values["travel_um"] = {
            axis: (low, high) for axis, (low, high) in values["travel_um"].items()
        }
    for name in ("axes", "target_mm", "systematic_mm"):
        if name in values:
            values[name] = tuple(values[name])
    return {**values, "gate": gate, "geometry": geometry_from_json(values.get("geometry"))}


def result_to_json(result: Calibration | Arrival | Place | JogEnd) -> dict[str, Any]:
    return result.to_json()


def latest_calibration(record: CaseRecord, *, guide: bool = False) -> Calibration | None:
    """What the last procedure that came to its end knew; a later calibration replaces it. None
    without one, and once slices of another frame of reference have come.

    None where there is none, or none that is good any more.

    guide: of both fiducials and four axes, else of one and two.
    """
    calibration = record.last_procedure(GUIDE_CALIBRATION if guide else CALIBRATION, "done")
    if calibration is None or calibration.result is None:
        return None
    if calibration.begun_seq <= calibration_good_since(record):
        return None
    newest = calibration
    for name in (GUIDE_APPROACH, GUIDE_RECORDING) if guide else (APPROACH, RECORDING):
        row = record.last_procedure(name, "done")
        if row is not None and row.result is not None and row.procedure_id > newest.procedure_id:
            newest = row
    known = newest.result or {}
    found = Calibration.from_json(known.get("calibration", known))
    return None if _is_of_another_place(record, found) else found


def _is_of_another_place(record: CaseRecord, calibration: Calibration) -> bool:
    """True if its frame of reference is not that of now: plane and estimate mean nothing there."""
    try:
        measurement = record.measurement(calibration.measurement_id)
        frame = frame_of(record, measurement)
    except CaseRecordError:
        return False
    if frame is None:
        return False
    here = replace(frame, study="")  # another study on the same table: the frame tells
    return bool(other_place_since(record, measurement.requested_seq, here))


def _build_calibration(value: Mapping[str, Any]) -> ProcedureSteps[Calibration]:
    known = _told(value)
    shifts_px = tuple((row, col) for row, col in known.get("shifts_px", ()))
    return calibrate(CalibrationArguments(**{**known, "shifts_px": shifts_px}))


def _build_approach(value: Mapping[str, Any]) -> ProcedureSteps[Arrival]:
    arguments = ApproachArguments(**_told(value["arguments"]))
    return approach(arguments, Calibration.from_json(value["start"]))


def _build_recording(value: Mapping[str, Any]) -> ProcedureSteps[Place]:
    arguments = RecordingArguments(**_told(value["arguments"]))
    return record_place(arguments, Calibration.from_json(value["start"]))


_BUILDERS: dict[str, Callable[[Mapping[str, Any]], ProcedureSteps[Any]]] = {
    CALIBRATION: _build_calibration,
    APPROACH: _build_approach,
    RECORDING: _build_recording,
    GUIDE_CALIBRATION: _build_calibration,
    GUIDE_APPROACH: _build_approach,
    GUIDE_RECORDING: _build_recording,
    JOG: lambda value: jog(value["setpoints_um"]),
}
