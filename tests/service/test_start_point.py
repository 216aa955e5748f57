"""From where an approach starts: nothing that happened unseen is taken for nothing."""

import numpy as np
import pytest
from offline_arguments import approach_arguments, beside, calibration_arguments

from case_record.record import CaseRecord
from service.procedure.estimate import MotionNoise
from service.procedure.initial_estimate import POSITION_DECLARED, positions_to_declare, start_point
from service.procedure.registry import APPROACH, CALIBRATION
from service.procedure.registry import approach_arguments as approach_json
from service.procedure.registry import calibration_arguments as calibration_json
from service.procedure.steps import MoveTo
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging
from studies.recorded_room import RecordedRoom

NOISE = MotionNoise(0.014, 0.015)


@pytest.fixture
def room(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        yield RecordedRoom(record, MrImaging(VirtualRoom()), StageParameters(), 5)


@pytest.fixture
def calibration(room):
    return room.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))


def worst_mm(start):
    return float(np.sqrt(np.linalg.eigvalsh(start.estimate.covariance_mm2)[-1]))


def test_where_nothing_happened_the_start_is_what_was_known(room, calibration):
    assert start_point(room.record, calibration, room.setpoints_um, NOISE) is calibration


def test_after_a_move_the_place_is_as_good_as_unknown(room, calibration):
    start = start_point(room.record, calibration, {"xt": 1500, "yt": 0}, NOISE)
    assert worst_mm(start) > 4.9
    assert start.estimate.setpoints_um == {"xt": 1500, "yt": 0}


def test_h7_a_robot_that_counts_from_zero_again_is_looked_at_before_it_moves(room, calibration):
    """The count says that it stands at the origin of the calibration; it stands 5 mm from there."""
    for axis in ("xt", "yt"):
        room.stages[axis].displace(5000.0)
    body = {"positions_um": dict(room.setpoints_um)}
    room.clock_s += 60.0
    event = room.record.append_event(POSITION_DECLARED, body, source="service", who="operator")
    assert event
    start = start_point(room.record, calibration, room.setpoints_um, NOISE)
    assert worst_mm(start) > 4.9
    moves = len(room.record.moves())
    target = beside(calibration, 1.0, 1.0)
    arguments = approach_arguments(target, confirm_moves=False)
    room.run_recorded(APPROACH, approach_json(arguments, start))
    steps = [step.kind for step in room.record.steps(2)]
    assert steps.index("Measure") < steps.index("MoveTo")
    assert len(room.record.moves()) > moves
    assert np.linalg.norm(room.true_plane_mm - target) < 0.06


def test_a_measurement_of_an_approach_that_came_to_no_end_does_not_void_every_later_plan(
    room, calibration
):
    """The robot stands where the calibration left it, but something was measured since."""
    target = beside(calibration, 2.0, -1.0)
    arguments = approach_arguments(target, confirm_moves=False, max_iterations=1, tolerance_mm=1e-4)
    with pytest.raises(Exception, match="not reached in 1 moves"):
        room.run_recorded(APPROACH, approach_json(arguments, calibration))
    at = dict(room.setpoints_um)
    room.setpoints_um = dict(calibration.estimate.setpoints_um)
    for axis in at:
        room.stages[axis].displace(float(room.setpoints_um[axis] - at[axis]))
    start = start_point(room.record, calibration, room.setpoints_um, NOISE)
    assert worst_mm(start) > 4.9
    arguments = approach_arguments(target, confirm_moves=False)
    arrival = room.run_recorded(APPROACH, approach_json(arguments, start))
    assert arrival.probability >= 0.95


ZERO = {"xt": 0, "yt": 0}


def test_controllers_that_count_from_zero_are_taken_to_stand_where_they_were_recorded(
    room, calibration
):
    room.execute(MoveTo({"xt": 4000, "yt": -2500}, "test"), "one")
    assert positions_to_declare(room.record, ZERO) == {"xt": 4000, "yt": -2500}
    # each axis for itself: a count that is not lost is believed, and says nothing of another one
    assert positions_to_declare(room.record, {"xt": 4005, "yt": 0}) == {"xt": 4005, "yt": -2500}


def test_of_a_move_that_came_to_no_end_half_is_believed(room, calibration):
    room.execute(MoveTo({"xt": 4000, "yt": -2500}, "test"), "one")
    room.record.send_move(
        "two", setpoints_um={"xt": 8000, "yt": -2500}, measurement_id=None, purpose="test"
    )
    assert positions_to_declare(room.record, ZERO) == {"xt": 6000, "yt": -2500}
    room.record.send_move("three", setpoints_um=ZERO, measurement_id=None, purpose="test")
    assert positions_to_declare(room.record, ZERO) == ZERO


def test_a_case_without_holds_takes_the_count(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        assert positions_to_declare(record, ZERO) == ZERO
