"""Which procedures there are: from the recorded name and arguments to a generator, and results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Procedure
from service.approach import ApproachArguments, Arrival, approach
from service.calibration import Calibration, CalibrationArguments, calibrate
from service.guide import (
    GuideArguments,
    GuideArrival,
    GuideCalibration,
    GuideGeometry,
    approach_guide,
    calibrate_guide,
)
from service.jog import JogEnd, jog
from service.steps import ProcedureSteps

CALIBRATION = "calibration"
APPROACH = "approach"
GUIDE_CALIBRATION = "guide_calibration"
GUIDE_APPROACH = "guide_approach"
JOG = "jog"


def build_procedure(row: Procedure) -> ProcedureSteps[Any]:
    """Return a fresh generator of the recorded procedure; raises KeyError for an unknown name."""
    return _BUILDERS[row.name](row.arguments)


def calibration_arguments(arguments: CalibrationArguments) -> dict[str, Any]:
    return asdict(arguments)


def approach_arguments(arguments: ApproachArguments, start: Calibration) -> dict[str, Any]:
    return {"arguments": asdict(arguments), "start": start.to_json()}


def guide_calibration_arguments(arguments: GuideArguments) -> dict[str, Any]:
    return asdict(arguments)


def guide_approach_arguments(arguments: GuideArguments, start: GuideCalibration) -> dict[str, Any]:
    return {"arguments": asdict(arguments), "start": start.to_json()}


def result_to_json(
    result: Calibration | Arrival | GuideCalibration | GuideArrival | JogEnd,
) -> dict[str, Any]:
    return result.to_json()


def latest_calibration(record: CaseRecord) -> Calibration | None:
    """What the last procedure that came to its end knew; a later calibration replaces it."""
    calibration = record.last_procedure(CALIBRATION, "done")
    arrival = record.last_procedure(APPROACH, "done")
    if calibration is None or calibration.result is None:
        return None
    newer = arrival is not None and arrival.procedure_id > calibration.procedure_id
    if newer and arrival is not None and arrival.result is not None:
        return Calibration.from_json(arrival.result["calibration"])
    return Calibration.from_json(calibration.result)


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


def _guide_arguments(value: Mapping[str, Any]) -> GuideArguments:
    xt, yt, xb, yb = value["axes"]
    upper_mm, lower_mm = value["geometry"]["slice_positions_mm"]
    geometry = {**value["geometry"], "slice_positions_mm": (upper_mm, lower_mm)}
    target_mm = value["target_mm"]
    return GuideArguments(
        **{
            **value,
            "axes": (xt, yt, xb, yb),
            "geometry": GuideGeometry(**geometry),
            "travel_um": {axis: (low, high) for axis, (low, high) in value["travel_um"].items()},
            "target_mm": None if target_mm is None else tuple(target_mm),
        }
    )


def _build_guide_approach(value: Mapping[str, Any]) -> ProcedureSteps[GuideArrival]:
    start = GuideCalibration.from_json(value["start"])
    return approach_guide(_guide_arguments(value["arguments"]), start)


_BUILDERS: dict[str, Callable[[Mapping[str, Any]], ProcedureSteps[Any]]] = {
    CALIBRATION: _build_calibration,
    APPROACH: _build_approach,
    GUIDE_CALIBRATION: lambda value: calibrate_guide(_guide_arguments(value)),
    GUIDE_APPROACH: _build_guide_approach,
    JOG: lambda value: jog(value["setpoints_um"]),
}
