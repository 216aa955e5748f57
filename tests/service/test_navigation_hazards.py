"""Faults put into the room, each with the hazard's number: what must not happen does not happen.

H3, H4, H5, H7, H8, H9, H12 and H13 belong to the bridge and the page; H6 is also killed for real in
the whole-room tests.
"""

import json
import shutil
import sqlite3

import numpy as np
import pytest
from offline_arguments import approach_arguments, beside, calibration_arguments

from case_record.record import CaseRecord
from case_record.seal_triggers import prepare
from service.procedure.approach import approach
from service.procedure.calibration import calibrate
from service.procedure.observe import ABORT, RESCAN, ProcedureFailedError
from service.procedure.plan import PLAN_VOID, why_void
from service.procedure.registry import (
    APPROACH,
    CALIBRATION,
    build_procedure,
)
from service.procedure.registry import approach_arguments as approach_json
from service.procedure.registry import calibration_arguments as calibration_json
from service.procedure.runner import ReplayMismatchError, run_procedure
from service.procedure.steps import AskOperator, Measure, Moved, MoveTo
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from sr_engine.reconstruction.shiftset import named
from studies.offline_room import MrImaging, OfflineRoom
from studies.recorded_room import RecordedRoom

QUARTER = named("quarter").shifts_px


class SwappedSlices(MrImaging):
    """A scanner whose look number `wrong` shows where the fiducial was a look before."""

    def __init__(self, room, wrong):
        super().__init__(room)
        object.__setattr__(self, "looks", [])
        object.__setattr__(self, "wrong", wrong)

    def look(self, stage_mm, rng, slice_position_mm=None):
        self.looks.append(dict(stage_mm))
        late = len(self.looks) == self.wrong
        return super().look(self.looks[-2] if late else stage_mm, rng, slice_position_mm)


@pytest.mark.parametrize("wrong", [6, 7, 8])
def test_h1_a_slice_of_another_commanded_shift_is_refused_not_averaged_in(wrong):
    room = OfflineRoom(SwappedSlices(VirtualRoom(), wrong), StageParameters(), 3)
    with pytest.raises(ProcedureFailedError) as failure:
        room.run(calibrate(calibration_arguments(shifts_px=QUARTER)))
    assert "disagree with their shifts" in str(failure.value)


def test_h1_with_the_right_slices_the_same_room_is_content():
    room = OfflineRoom(SwappedSlices(VirtualRoom(), 99), StageParameters(), 3)
    room.run(calibrate(calibration_arguments(shifts_px=QUARTER)))
    assert room.frames == 8


def test_h1_a_slice_from_before_the_move_contradicts_the_prediction(calibrated):
    room, calibration = calibrated
    room.imaging = SwappedSlices(VirtualRoom(), 2)
    room.imaging.look(room.stage_mm, np.random.default_rng(0))
    moves = len(room.moves)
    with pytest.raises(ProcedureFailedError) as failure:
        room.run(approach(approach_arguments(beside(calibration, 1.5, -1.0)), calibration))
    assert failure.value.code == "prediction_missed"
    assert len(room.moves) == moves + 1


def test_h2_a_plan_is_void_once_the_robot_stands_elsewhere(calibrated):
    room, calibration = calibrated
    asked: list[AskOperator] = []

    def push_then_confirm(question):
        asked.append(question)
        room.execute(MoveTo({**room.setpoints_um, "xt": room.setpoints_um["xt"] + 700}, "jog"))
        return question.choices[0]

    room._answer = push_then_confirm
    moves = len(room.moves)
    with pytest.raises(ProcedureFailedError) as failure:
        room.run(approach(approach_arguments(beside(calibration, 2.0, 2.0)), calibration))
    assert failure.value.code == PLAN_VOID
    assert "axis xt" in str(failure.value)
    assert len(asked) == 1
    assert len(room.moves) == moves + 1  # the jog, not the plan


def test_h2_a_plan_is_void_once_there_is_a_newer_measurement(calibrated):
    room, calibration = calibrated

    def measure_then_confirm(question):
        hold_id = max(room._slices)
        room.execute(Measure(_one_hold(hold_id), "ml"))
        return question.choices[0]

    room._answer = measure_then_confirm
    moves = len(room.moves)
    with pytest.raises(ProcedureFailedError, match="there is a newer one"):
        room.run(approach(approach_arguments(beside(calibration, 2.0, 2.0)), calibration))
    assert len(room.moves) == moves


def _one_hold(hold_id):
    from service.procedure.steps import HoldShift

    return (HoldShift(hold_id, (0.0, 0.0)),)


def test_h2_why_a_plan_is_void_is_said_with_numbers():
    here = {"xt": 1000, "yt": -5}
    assert why_void(here, 7, {"xt": 1015, "yt": -5}, 7) == ""
    assert "1.000 mm; it is now at 1.021 mm" in why_void(here, 7, {"xt": 1021, "yt": -5}, 7)
    assert "an unknown position" in why_void(here, 7, {"xt": 1000}, 7)
    assert "rests on measurement 7" in why_void(here, 7, here, 8)


@pytest.fixture
def recorded(tmp_path):
    with CaseRecord(tmp_path / "case", create=True) as record:
        yield RecordedRoom(record, MrImaging(VirtualRoom()), StageParameters(), 6)


class Killed(BaseException):
    """The service's process ends here, whatever it was doing."""


def run_until(room, number, steps):
    """As the service: run what is running; killed when `steps` more steps were carried out."""
    count = 0

    def execute(step, command_id):
        nonlocal count
        count += 1
        if count > steps:
            raise Killed
        return room.execute(step, command_id)

    running = room.record.running_procedure()
    return run_procedure(room.record, number, build_procedure(running), execute, room.case.case_uid)


def test_h6_killed_before_every_single_step_it_goes_on_where_it_stood(recorded):
    calibration = recorded.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
    target = beside(calibration, 2.0, -3.0)
    arguments = approach_json(approach_arguments(target), calibration)
    number = recorded.record.begin_procedure(APPROACH, arguments)
    moves, kills = len(recorded.moves), 0
    while True:
        try:
            arrival = run_until(recorded, number, steps=1)
            break
        except Killed:
            kills += 1
            assert kills < 100
    steps = recorded.record.steps(number)
    assert kills == len(steps) - 1
    assert len(recorded.moves) - moves == arrival.iterations  # no move was made twice
    assert np.linalg.norm(recorded.true_plane_mm - target) < 0.06


def test_h6_killed_after_the_motion_but_before_its_record_the_same_command_is_asked_again(recorded):
    calibration = recorded.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
    arguments = approach_json(approach_arguments(beside(calibration, 2.0, -3.0)), calibration)
    number = recorded.record.begin_procedure(APPROACH, arguments)
    asked: list[str] = []

    def execute(step, command_id):
        if isinstance(step, MoveTo):
            asked.append(command_id)
            if len(asked) == 1:
                raise Killed
        return recorded.execute(step, command_id)

    for _ in range(2):
        running = recorded.record.running_procedure()
        try:
            run_procedure(
                recorded.record, number, build_procedure(running), execute, recorded.case.case_uid
            )
        except Killed:
            continue
    assert asked[0] == asked[1]
    assert len(set(asked)) == len(asked) - 1


def test_a_program_that_would_take_other_steps_does_not_go_on(recorded):
    number = recorded.record.begin_procedure(CALIBRATION, calibration_json(calibration_arguments()))
    with pytest.raises(Killed):
        run_until(recorded, number, steps=4)
    changed = calibrate(calibration_arguments(move_um=9000))
    with pytest.raises(ReplayMismatchError, match="start the procedure again"):
        run_procedure(recorded.record, number, changed, recorded.execute, recorded.case.case_uid)
    assert len(recorded.moves) == 2


def test_a_step_recorded_before_a_field_was_known_is_still_the_same_step(recorded):
    number = recorded.record.begin_procedure(CALIBRATION, calibration_json(calibration_arguments()))
    with pytest.raises(Killed):
        run_until(recorded, number, steps=3)
    db = sqlite3.connect(recorded.record.case_dir / "case.sqlite")
    prepare(db)
    for step_number, body in db.execute("SELECT number, body FROM step").fetchall():
        older = json.loads(body)
        for name in ("from_um", "fresh", "slice_position_mm", "shift_sigma_mm", "phase"):
            older.pop(name, None)
        db.execute("UPDATE step SET body = ? WHERE number = ?", (json.dumps(older), step_number))
    db.commit()
    db.close()
    calibration = run_until(recorded, number, steps=100)
    assert calibration.jacobian.axes == ("xt", "yt")


def test_h14_with_a_full_disk_nothing_moves_that_is_not_recorded(recorded):
    calibration = recorded.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
    pages = recorded.record._db.execute("PRAGMA page_count").fetchone()[0]
    before = len(recorded.moves)
    recorded.record._db.execute(f"PRAGMA max_page_count = {pages + 1}")
    with pytest.raises(sqlite3.OperationalError, match="full"):
        _approach_again_and_again(recorded, calibration)
    asked = [move for move in recorded.record.moves() if move.purpose == "approach"]
    assert len(recorded.moves) - before <= len(asked)
    recorded.record._db.execute("PRAGMA max_page_count = 1000000")
    assert recorded.record.verify_events() >= 0


def _approach_again_and_again(room, calibration):
    for away in range(50):
        arguments = approach_arguments(beside(calibration, 1.0 + 0.1 * away, 1.0))
        calibration = room.run_recorded(APPROACH, approach_json(arguments, calibration)).calibration


@pytest.mark.parametrize("damage", ["cut", "emptied", "noise", "gone"])
def test_h14_a_damaged_slice_is_never_used_and_the_robot_stands(recorded, damage):
    calibration = recorded.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
    asked: list[AskOperator] = []

    def abort(question):
        asked.append(question)
        return ABORT if ABORT in question.choices else question.choices[0]

    recorded._answer = abort
    receive = recorded._receive

    def receive_damaged(hold_id, slice_position_mm):
        receive(hold_id, slice_position_mm)
        path = recorded.record.case_dir / recorded.record.last_slice().path
        content = path.read_bytes()
        if damage == "cut":
            path.write_bytes(content[: len(content) // 2])
        elif damage == "emptied":
            path.write_bytes(b"")
        elif damage == "noise":
            path.write_bytes(np.random.default_rng(0).bytes(len(content)))
        else:
            path.unlink()

    recorded._receive = receive_damaged
    moves = len(recorded.moves)
    with pytest.raises(ProcedureFailedError, match="no usable measurement"):
        recorded.run_recorded(
            APPROACH, approach_json(approach_arguments(beside(calibration, 1.0, 1.0)), calibration)
        )
    assert len(recorded.moves) == moves + 1
    assert asked[-1].choices == (RESCAN, ABORT)
    assert recorded.record.last_measurement().state == "failed"


def test_h14_a_bad_slice_and_then_a_good_one_after_a_rescan(recorded):
    calibration = recorded.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
    recorded._answer = lambda question: question.choices[0]  # confirm, rescan
    receive, left = recorded._receive, [1]

    def receive_once_cut(hold_id, slice_position_mm):
        receive(hold_id, slice_position_mm)
        if left[0]:
            left[0] -= 1
            path = recorded.record.case_dir / recorded.record.last_slice().path
            path.write_bytes(path.read_bytes()[:2000])

    recorded._receive = receive_once_cut
    target = beside(calibration, 1.0, 1.0)
    recorded.run_recorded(APPROACH, approach_json(approach_arguments(target), calibration))
    assert np.linalg.norm(recorded.true_plane_mm - target) < 0.06
    holds = recorded.record.holds()
    assert any(len(recorded.record.slices(hold_id=hold.hold_id)) == 1 for hold in holds)


def test_a_refused_move_ends_the_procedure_with_the_bridges_words(calibrated):
    _, calibration = calibrated
    procedure = approach(
        approach_arguments(beside(calibration, 1.0, 1.0), confirm_moves=False), calibration
    )
    assert isinstance(next(procedure), MoveTo)
    with pytest.raises(ProcedureFailedError, match="insertion lock is set"):
        procedure.send(Moved("REFUSED", "locked", "the insertion lock is set", 1, {}))


def test_a_copied_case_is_a_case(recorded, tmp_path):
    """What a case needs lies in its folder."""
    recorded.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
    recorded.record._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    shutil.copytree(recorded.record.case_dir, tmp_path / "copy")
    with CaseRecord(tmp_path / "copy") as copy:
        assert len(copy.measurements("done")) == len(recorded.record.measurements("done"))
