"""Arguments of procedures as they stand in the record: cases of earlier versions stay readable."""

import json
from dataclasses import fields

import numpy as np
import pytest
from offline_arguments import approach_arguments, calibration_arguments
from test_guide import PLANE
from test_guide import approach_arguments as guide_approach
from test_guide import calibration_arguments as guide_calibration

from case_record.rows import Procedure
from robot_bridge.protocol.phases import WorkPhase
from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import ImageJacobian
from service.procedure.registry import (
    APPROACH,
    CALIBRATION,
    GUIDE_APPROACH,
    GUIDE_CALIBRATION,
    JOG,
    build_procedure,
)
from service.procedure.registry import approach_arguments as recorded_approach
from service.procedure.registry import calibration_arguments as recorded_calibration
from service.procedure.steps import Acquire, MoveTo


def start(axes):
    """As badly known as can be: an approach from here looks before it moves."""
    n = len(axes)
    estimate = FiducialEstimate(dict.fromkeys(axes, 0), np.zeros(n), np.eye(n))
    return Calibration(ImageJacobian.unknown(axes), estimate, PLANE, 1)


GATE = {"position_gate_mm": 3.0, "gate_sigma": 5.0, "repeatability_mm": 0.014, "scale_error": 0.015}
RECORDED = {
    CALIBRATION: recorded_calibration(calibration_arguments()),
    APPROACH: recorded_approach(approach_arguments((1.0, 2.0)), start(("xt", "yt"))),
    GUIDE_CALIBRATION: recorded_calibration(guide_calibration()),
    GUIDE_APPROACH: recorded_approach(guide_approach(np.zeros(4)), start(("xt", "yt", "xb", "yb"))),
}
CALIBRATED = {"axes", "origin_um", "move_um", "shifts_px", "method", "last", "same_mount"} | {
    "localization",
    "geometry",
}
APPROACHED = {"target_mm", "travel_um", "tolerance_mm", "confidence", "max_iterations"} | {
    *("confirm_moves", "most_frames", "proven", "strategy", "stop_rule", "seed"),
    *("systematic_mm", "common_cancels", "geometry", "lower_plane_mm"),
}
OTHERS = {
    CALIBRATION: CALIBRATED,
    APPROACH: APPROACHED,
    GUIDE_CALIBRATION: CALIBRATED,
    GUIDE_APPROACH: APPROACHED,
}
# what a program before did not write
ADDED = {
    CALIBRATION: {"geometry"},
    APPROACH: {"geometry", "lower_plane_mm", "common_cancels"},
    GUIDE_CALIBRATION: {"shifts_px", "method"},
    GUIDE_APPROACH: {"strategy", "stop_rule", "seed"},
}


def first_step(name, recorded):
    values = {field.name: None for field in fields(Procedure)}
    arguments = json.loads(json.dumps(recorded))
    return next(build_procedure(Procedure(**{**values, "name": name, "arguments": arguments})))


@pytest.mark.parametrize("name", RECORDED)
def test_the_numbers_of_the_gate_stand_among_the_other_arguments(name):
    recorded = RECORDED[name].get("arguments", RECORDED[name])
    assert set(recorded) == set(GATE) | OTHERS[name]
    assert {key: recorded[key] for key in GATE} == GATE


@pytest.mark.parametrize("name", RECORDED)
def test_a_recorded_procedure_can_be_begun_again(name):
    first = first_step(name, RECORDED[name])
    assert isinstance(first, MoveTo if "axes" in RECORDED[name] else Acquire)


@pytest.mark.parametrize("name", RECORDED)
def test_what_a_program_before_recorded_begins_with_the_same_step(name):
    recorded = json.loads(json.dumps(RECORDED[name]))
    told = recorded.get("arguments", recorded)
    for added in ADDED[name]:
        del told[added]
    assert first_step(name, recorded) == first_step(name, RECORDED[name])


def test_the_phase_of_a_move_is_said_by_the_order_and_not_by_its_purpose():
    jogged = first_step(JOG, {"setpoints_um": {"xt": 100}})
    assert jogged.phase is WorkPhase.MANUAL
    assert first_step(CALIBRATION, RECORDED[CALIBRATION]).phase is WorkPhase.CALIBRATION
    assert MoveTo({"xt": 100}, "calibrated approach").phase is WorkPhase.MOVE_TO_TARGET
