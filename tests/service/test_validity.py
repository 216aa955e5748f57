"""What is shown is true now: what changes after a measurement, and where that is shown or used."""

import time

import numpy as np
import pytest
from line_room import IMAGING, patient_mm, running_line_room

from case_record.record import CaseRecord, CaseRecordError
from service.dicom_out.content import finding_of_arrival
from service.dicom_out.make import outputs_to_send
from service.dicom_out.report import comment_of
from service.room.context import now_of
from service.room.refusal import ConflictError
from service.room.validity import Now, lost_since_ready, readiness, why_not_now
from service.slicer.messages import STATUS_HEAD
from service.slicer.pose import pose_of
from service.slicer.scene import scene_of, standing


@pytest.fixture
def room(tmp_path):
    with running_line_room(tmp_path) as running:
        yield running


def lose_link(room):
    room.do(room.line.unplug)
    room.until(lambda s: not s.robot.linked)


def lose_link_for_a_while(room):
    lose_link(room)
    room.do(lambda: room.line.run(2.0))
    room.do(room.line.plug_in)
    room.until(lambda s: s.robot.linked)


def restart_bridge(room):
    boot_id = room.state.robot.boot_id
    room.do(room.line.crash_bridge)
    room.until(lambda s: s.robot.linked and s.robot.boot_id != boot_id)


def power_cycle(room):
    room.do(lambda: room.line.motors._certain.clear())
    room.until(lambda s: not s.robot.position_certain)


def fault(room):
    room.do(lambda: setattr(room.line.motors, "fault", "moved_by_itself"))
    room.until(lambda s: s.robot.stopped)


def push(room):
    def pushed():
        for places in (room.line.stage.from_um, room.line.stage.to_um):
            places["xt"] += 300

    before = room.state.robot.positions_um
    room.do(pushed)
    room.until(lambda s: s.robot.positions_um != before)


def declare(room):
    positions_um = dict(room.state.robot.positions_um)
    room.do(lambda: room.link.client.declare_position(positions_um, "somebody"))


def unlock(room):
    room.do(lambda: room.link.client.set_insertion_lock(False, "somebody"))


def park(room):
    room.do(lambda: setattr(room.line.stage, "parked", True))


def jog(room):
    """By somebody else at the bridge, past the lock: nothing of it goes through the service."""

    def move():
        room.link.client.set_insertion_lock(False, "somebody")
        room.link.client.move("elsewhere/1", {**room.link.status.positions_um, "xt": 0}, None)

    room.do(move)


def set_other_target(room):
    room.call("set_target", patient_mm=patient_mm(45.0, 61.0))


# what happens after the measurement: what is done, and the code of why READY and error are gone
CHANGES = {
    "move": (jog, "moved"),
    "stop": (lambda room: room.stop(), "stopped"),
    "emergency": (lambda room: room.stop(emergency=True), "stopped"),
    "stop and re-arm": (lambda room: (room.stop(), room.arm()), "stopped"),
    "park": (park, "parked"),
    "declare": (declare, "declared"),
    "bridge restart": (restart_bridge, "bridge_restarted"),
    "bridge restart and re-arm": (
        lambda room: (restart_bridge(room), room.arm()),
        "bridge_restarted",
    ),
    "controller power-cycle": (power_cycle, "position"),
    "fault": (fault, "stopped"),
    "pushed axis": (push, "elsewhere"),
    "link loss": (lose_link, "no_link"),
    "link loss for a while": (lose_link_for_a_while, "stopped"),
    "lock missing": (unlock, "lock_missing"),
    "other study": (lambda room: room.receive(study_instance_uid="1.2.2"), "other_place"),
    "other frame of reference": (
        lambda room: room.receive(frame_of_reference_uid="1.2.8"),
        "other_place",
    ),
    "other bandwidth": (
        lambda room: room.receive(room.state.hold.hold_id, pixel_bandwidth_hz=250.0),
        "other_protocol",
    ),
    "other encoding direction": (
        lambda room: room.receive(room.state.hold.hold_id, phase_encoding_direction="COL"),
        "other_protocol",
    ),
    "target changed": (set_other_target, "target_changed"),
    "target withdrawn": (lambda room: room.call("withdraw_target"), "target_withdrawn"),
}
# what follows from a change may be seen before it: a stop, the link lost, drives parked
_SEEN_FIRST = {"stopped", "no_link", "parked"}
# these take away READY, but not what the measurement says
_ONLY_READY = {"lock missing", "target changed", "target withdrawn"}


@pytest.mark.parametrize("change", CHANGES)
def test_what_changes_after_a_measurement_takes_it_back_wherever_it_is_shown(room, change):
    happens, code = CHANGES[change]
    measured = room.ready().measurement
    happens(room)
    state = room.until(lambda s: s.ready_lost is not None)
    # the page and the API
    assert not state.ready
    assert state.arrival is None
    assert state.ready_lost.code in {code, *_SEEN_FIRST}
    assert "READY:" not in state.prompt
    assert measured.lost is None
    if change in _ONLY_READY:
        assert state.measurement.lost is None
    else:
        assert state.measurement.lost.code in {code, *_SEEN_FIRST}
        assert state.error is None
        assert state.error_reason == state.measurement.lost.text
    # the alarms
    assert "ready_lost" in {alarm.code for alarm in state.alarms}
    # the puncture
    with pytest.raises(ConflictError) as refused:
        room.call("puncture")
    assert refused.value.code == "not_ready"
    # the record, which is what DICOM outputs and reports know
    with room.record() as record:
        assert lost_since_ready(record, 2) is not None
        assert not record.events_of_kind("puncture")
        # what is written for good says what was, and of what instant
        said = comment_of(finding_of_arrival(record, 2))
        assert "stood at its target when READY was said" in said
        assert {one.subject for one in outputs_to_send(record)} == {"approach"}
    # whoever follows by OpenIGTLink
    scene = scene_of(state)
    assert STATUS_HEAD.unpack_from(scene["AutoSPINe"].content)[2].rstrip(b"\0") != b"READY"
    seen = standing(state)
    assert (seen.arrival, seen.reconstruction) == (None, None)
    assert (seen.measurement is not None) == (change in _ONLY_READY)


def not_found(room):
    def measure():
        record = room.loop._record
        last = record.last_measurement("done")
        room.fiducial_visible = False
        record.request_measurement(last.method, list(last.hold_ids), dict(last.request))

    room.do(measure)
    room.until(lambda s: s.measurement.state == "failed")


def jog_here(room):
    room.arm()
    room.call("jog", axis="xt", distance_um=-700)
    room.until(lambda s: s.procedure is None and not s.robot.moving)
    room.later()


def shown_pose(room):
    """As peers are shown it; also that it is where the fiducial truly is."""
    pose = room.do(lambda: pose_of(room.state, room.loop._record, room.config, room.loop.now))
    if pose is not None:
        far_mm = np.linalg.norm(pose.origin_mm - patient_mm(*room.true_plane_mm()))
        assert far_mm < max(0.05, 5 * pose.sigma_mm)
    return pose


_CARRIED = {name: CHANGES[name][0] for name in CHANGES if name not in _ONLY_READY}
_NEEDS_A_HOLD = {"other bandwidth", "other encoding direction"}
# by others than the room, who does not record them
_AT_THE_BRIDGE = {"move", "park", "declare", "fault", "pushed axis"}
_CARRIED["fiducial not found"] = not_found
_CARRIED["fiducial not found, then a bridge restart"] = lambda room: (
    not_found(room),
    room.stop(),
    restart_bridge(room),
)
_CARRIED["stop in mid-motion"] = lambda room: (
    room.do(lambda: setattr(room.line.stage, "speed_um_s", 500.0)),
    room.call("jog", axis="yt", distance_um=3000),
    room.until(lambda s: s.robot.moving),
    room.stop(),
)


@pytest.mark.parametrize("change", _CARRIED)
def test_a_pose_is_shown_while_it_is_known_and_not_longer(room, change):
    """Carried by the room's own moves it goes on being one; whatever else happens ends it, and a
    move after that does not bring it back.
    """
    room.calibrate()
    assert shown_pose(room).measured
    if change not in _NEEDS_A_HOLD:
        jog_here(room)
        assert not shown_pose(room).measured
    _CARRIED[change](room)
    room.later()
    assert shown_pose(room) is None
    if change in _AT_THE_BRIDGE or not room.state.robot.linked:
        return
    room.until(lambda s: not s.robot.moving and s.procedure is None)
    jog_here(room)
    assert shown_pose(room) is None


@pytest.mark.parametrize("change", ["stop", "target changed", "other study", "park"])
def test_a_ready_that_was_lost_does_not_come_back_by_itself(room, change):
    target = room.ready().target_patient_mm
    CHANGES[change][0](room)
    room.until(lambda s: s.ready_lost is not None)
    room.call("set_target", patient_mm=target)
    if not change.startswith("other"):
        room.arm()
    assert not room.later().ready
    room.call("needle_out")
    assert room.later().ready_lost is None


@pytest.mark.parametrize("step_s", [600, -600, 3600, -3600])
@pytest.mark.parametrize("when", ["ready", "before"])
def test_a_clock_that_is_set_changes_nothing_of_what_came_first(room, monkeypatch, step_s, when):
    real = time.time
    room.calibrate()
    if when == "ready":
        room.ready()
    monkeypatch.setattr(time, "time", lambda: real() + step_s)
    if when == "before":
        room.ready()
    state = room.later() if step_s > 0 else room.until(lambda s: s.at_s < real() + step_s / 2)
    assert state.ready
    assert state.robot.insertion_locked
    room.call("puncture")
    room.call("needle_out")
    state = room.until(lambda s: not s.robot.insertion_locked)
    assert not state.ready
    room.call("jog", axis="xt", distance_um=500)
    state = room.until(lambda s: s.procedure is None and not s.robot.moving)
    assert state.error is None
    assert state.error_reason == "measured before the last move"


@pytest.mark.parametrize("step_s", [600, -600, 3600, -3600])
def test_the_clock_is_set_and_the_next_arrival_locks_all_the_same(room, monkeypatch, step_s):
    real = time.time
    room.ready()
    room.call("needle_out")
    monkeypatch.setattr(time, "time", lambda: real() + step_s)
    room.ready(-1.0, 0.5)
    with pytest.raises(ConflictError) as refused:
        room.call("jog", axis="xt", distance_um=1000)
    assert refused.value.code == "insertion_locked"


def test_a_case_that_has_ended_leaves_nothing_behind_even_if_it_is_opened_again(tmp_path):
    with running_line_room(tmp_path, many_cases=True) as room:
        folder = room.call("begin_case", label="anna", operator="", note="")
        room.ready()
        with pytest.raises(ConflictError, match="withdrawn"):
            room.call("finish_case")
        room.call("puncture")
        room.call("needle_out")
        assert room.later().error is not None
        room.call("finish_case", park=True)
        assert room.line.stage.parked
        state = room.later()
        assert not state.ready
        for shown in (
            "case_folder",
            "measurement",
            "error",
            "target_patient_mm",
            "slice",
            "arrival",
        ):
            assert getattr(state, shown) is None
        seen = standing(state)
        assert (seen.measurement, seen.arrival, seen.reconstruction) == (None, None, None)
        with pytest.raises(ConflictError) as refused:
            room.call("puncture")
        assert refused.value.code == "no_case"
        room.call("reopen_case", folder=folder)
        state = room.until(lambda s: s.case_folder == folder and s.measurement)
        assert (state.error, state.measurement.lost.code) == (None, "case_ended")
        assert not state.calibrated
        assert standing(state).measurement is None


@pytest.mark.parametrize("step_s", [3600, -3600, -5])
def test_a_clock_that_is_set_while_slices_are_awaited_is_an_alarm_and_the_hold_begins_anew(
    room, monkeypatch, step_s
):
    real = time.time
    room.calibrate()
    room.call("compare_clocks", offset_s=0.0, uncertainty_s=0.02)
    room.do(lambda: setattr(room, "scanning", False))
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    room.call("start_approach")
    before = room.until(lambda s: s.acquisition_request).acquisition_request.hold_id
    monkeypatch.setattr(time, "time", lambda: real() + step_s)
    state = room.until(lambda s: s.acquisition_request and s.acquisition_request.hold_id != before)
    (alarm,) = [one for one in state.alarms if one.code == "clock_set"]
    assert f"{step_s:+.1f} s" in alarm.text
    assert state.clock is None  # the comparison was with the clock as it was before
    assert state.hold.settled_at_s == pytest.approx(real() + step_s, abs=3)
    room.do(lambda: setattr(room, "scanning", True))
    room.run_to_end()
    assert room.until(lambda s: s.ready)
    room.call("compare_clocks", offset_s=0.0, uncertainty_s=0.02)
    assert "clock_set" not in {one.code for one in room.later().alarms}


def test_a_clock_that_was_set_between_two_cases_is_known_to_the_next_one(tmp_path, monkeypatch):
    real = time.time
    with running_line_room(tmp_path, many_cases=True) as room:
        room.call("begin_case", label="anna", operator="", note="")
        room.call("compare_clocks", offset_s=0.0, uncertainty_s=0.02)
        room.call("finish_case")
        monkeypatch.setattr(time, "time", lambda: real() - 700)
        room.until(lambda s: s.at_s < real() - 600)
        room.call("begin_case", label="berta", operator="", note="")
        state = room.until(lambda s: s.alarms)
        assert "clock_set" in {one.code for one in state.alarms}
        assert state.clock is None


def test_between_a_move_and_the_next_measurement_there_is_no_error(room):
    room.calibrate()
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    assert room.until(lambda s: s.target_patient_mm).error is not None
    room.call("jog", axis="xt", distance_um=-2000)
    state = room.until(lambda s: s.procedure is None and s.robot.positions_um["xt"] == -2000)
    assert (state.error, state.error_reason) == (None, "measured before the last move")
    assert state.measurement.patient_mm is not None  # drawn dashed: where it was


def of_the_last(room, **changes):
    """Why the last measurement does not hold, as things are in the room but for some changes."""

    def ask():
        now = now_of(room.config, room.link)
        record = room.loop._record
        last = record.last_measurement("done")
        later = Now(**{**vars(now), **changes})
        return why_not_now(record, last, later), readiness(record, later)

    return room.do(ask)


def test_ready_and_measurement_have_an_age_and_expire(room):
    age_s = room.ready().measurement.age_s
    assert 0 <= age_s < 60
    assert room.state.arrival.age_s >= 0
    valid_s = room.config.service.ready_valid_s
    assert room.later().ready_valid_s == valid_s
    now_s = time.monotonic()
    lost, found = of_the_last(room, monotonic_s=now_s + valid_s - 60)
    assert lost is None
    assert found.ready
    lost, found = of_the_last(room, monotonic_s=now_s + valid_s)
    assert lost.code == found.lost.code == "expired"
    assert not found.ready
    # a computer that was started again counts from zero: no clock says how old it is
    assert of_the_last(room, monotonic_s=now_s - 1e6)[0].code == "computer_restarted"
    assert of_the_last(room, computer="another start")[0].code == "computer_restarted"


def test_a_measurement_that_does_not_say_what_it_rests_on_does_not_hold(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        record.start_case("older", 0)
        number = record.request_measurement("ml", [], {})
        record.finish_measurement(number, {})
        now = Now(None, 300.0)
        assert why_not_now(record, record.measurement(number), now).code == "unknown"


def test_an_old_record_is_ordered_as_its_clock_had_it(tmp_path):
    """A record of the program before, made by the migrations that it knew."""
    import sqlite3

    from case_record.sql import MIGRATIONS

    db = sqlite3.connect(tmp_path / "case.sqlite")
    db.executescript(MIGRATIONS[0])
    db.execute("PRAGMA user_version = 1")
    db.execute("INSERT INTO event VALUES (1, 10.0, 1.0, 's', '-', 'needle_out', '{}', '0', 'a')")
    db.execute("INSERT INTO procedure VALUES (1, 'approach', '{}', 'done', '{}', 5.0, 11.0)")
    db.execute("INSERT INTO event VALUES (2, 12.0, 2.0, 's', '-', 'needle_out', '{}', 'a', 'b')")
    db.commit()
    db.close()
    with CaseRecord(tmp_path) as record:
        out = record.events_of_kind("needle_out")
        arrival = record.last_procedure("approach", "done")
        assert out[0].seq < arrival.ended_seq < out[1].seq
        number = record.append_event("later", {}, source="test")
        assert record.events(number - 1)[0].seq > out[1].seq


def test_after_a_stop_nothing_that_was_asked_before_moves_anything(room):
    room.calibrate()
    asked_s = time.monotonic()
    room.stop()
    for name, arguments in (
        ("jog", {"axis": "xt", "distance_um": 3000}),
        ("start_calibration", {}),
        ("reset", {}),
        ("needle_out", {}),
    ):
        with pytest.raises(ConflictError) as refused:
            room.loop.call(name, {"by": "tester", **arguments}, asked_s)
        assert refused.value.code == "void_after_stop"
    begun = len(room.line.stage.begun)
    room.arm()
    room.later()
    assert len(room.line.stage.begun) == begun


def test_an_order_that_has_waited_is_not_carried_out_late(room):
    room.arm()
    with pytest.raises(ConflictError) as refused:
        room.loop.call("jog", {"by": "t", "axis": "xt", "distance_um": 1000}, time.monotonic() - 10)
    assert refused.value.code == "stale_order"
    assert not room.line.stage.begun


def test_a_stop_that_waits_for_its_answer_voids_what_comes_meanwhile(room):
    room.arm()
    number = room.do(lambda: room.loop.stop("tester"))
    with pytest.raises(ConflictError) as refused:
        room.call("jog", axis="xt", distance_um=1000)
    assert refused.value.code == "void_after_stop"
    room.loop.stop_answered(number)
    room.until(lambda s: s.robot.stopped)
    with pytest.raises(ConflictError) as refused:
        room.call("jog", axis="xt", distance_um=1000)
    assert refused.value.code == "not_armed"
    assert room.arm().robot.armed


@pytest.mark.parametrize("answer", ["go_on", "abort"])
def test_a_motion_that_was_interrupted_is_not_made_again(room, answer):
    """It stands somewhere on its way: that is looked at, and a new order given."""
    room.arm()
    room.do(lambda: setattr(room.line.stage, "speed_um_s", 500.0))
    room.call("jog", axis="xt", distance_um=3000)
    room.until(lambda s: s.robot.moving)
    lose_link_for_a_while(room)
    room.arm()
    state = room.until(lambda s: s.question is not None)
    begun = len(room.line.stage.begun)
    assert state.question.choices == ["go_on", "abort"]
    assert "xt" in state.question.question
    room.later()
    assert len(room.line.stage.begun) == begun
    room.call("answer", question_id=state.question.question_id, choice=answer)
    assert room.run_to_end().robot.positions_um["xt"] != 3000
    assert len(room.line.stage.begun) == begun


def lose_power(room):
    """The controllers, while nobody wants anything of them: they know no position any more."""
    room.do(room.line.motors._certain.clear)
    room.until(lambda s: not s.robot.position_certain)


@pytest.mark.parametrize("interrupted", [lose_link_for_a_while, lose_power])
def test_after_an_interruption_between_moves_only_a_new_order_moves_the_robot(room, interrupted):
    room.arm()
    room.do(lambda: setattr(room, "scanning", False))
    room.call("start_calibration")
    room.until(lambda s: s.acquisition_request is not None)
    interrupted(room)
    room.arm()
    begun, asked = len(room.line.stage.begun), []
    room.do(lambda: setattr(room, "scanning", True))

    def answer(state):
        asked.append(state.question.choices)
        if "go_on" in state.question.choices:
            assert len(room.line.stage.begun) == begun  # nothing moved before it was asked
        return state.question.choices[0]

    assert room.run_to_end(answer).calibrated
    assert ["go_on", "abort"] in asked


def test_a_target_is_void_once_the_table_may_have_moved_until_it_is_picked_anew(room):
    room.ready()
    room.call("puncture")
    room.call("needle_out")
    room.receive(frame_of_reference_uid="1.2.8")
    state = room.until(lambda s: s.target_lost is not None)
    assert state.target_patient_mm is None
    assert "target_void" in {alarm.code for alarm in state.alarms}
    assert not state.calibrated  # the estimate and its plane mean nothing on a moved table
    number = _number_of_the_target(room)
    for order in (lambda: None, lambda: room.call("choose_target", number=number)):
        order()
        room.arm()
        with pytest.raises(ConflictError) as refused:
            room.call("start_approach")
        assert refused.value.code in ("target_void", "not_calibrated")
    # the operator accepts the new frame of reference, and does as told: calibrates again
    room.do(lambda: room.header.update(frame_of_reference_uid="1.2.8"))
    state = room.calibrate()
    with pytest.raises(ConflictError) as refused:
        room.call("start_approach")
    assert refused.value.code == "target_void"
    assert "pick it again" in state.prompt
    # picked anew on the new slices it is one again
    assert room.ready().ready


def _number_of_the_target(room):
    with room.record() as record:
        return record.last_event("target_set").event_id


def test_another_study_voids_the_target_and_not_the_calibration(room):
    room.ready()
    room.call("needle_out")
    room.do(lambda: room.header.update(study_instance_uid="1.2.2"))
    room.receive(room.until(lambda s: s.hold).hold.hold_id)
    state = room.until(lambda s: s.target_lost is not None)
    assert state.calibrated
    with pytest.raises(ConflictError) as refused:
        room.call("start_approach")
    assert refused.value.code == "target_void"


def another_patient_in_the_case(room):
    """Where the room has this case only: whatever arrives is recorded in it."""
    header = {**room.header, "study_instance_uid": "9.9"}
    room.do(lambda: room._add_slice(None, header, reason_code="other_patient"))


def held(room, **body):
    room.do(lambda: room.loop._record.append_event("slice_held", body, source="listener"))


@pytest.mark.parametrize(
    "comes",
    [
        another_patient_in_the_case,
        lambda room: held(room, code="other_patient"),
        lambda room: held(room, code="other_study"),
        lambda room: held(room, code="other_case", same_patient=True),
    ],
    ids=["patient aside", "patient held", "study held", "earlier case of this patient"],
)
def test_slices_that_are_not_the_cases_own_take_back_ready(room, comes):
    """Somebody else may lie on the table, or the patient lies on it anew: that is looked at."""
    target = room.ready().target_patient_mm
    comes(room)
    state = room.until(lambda s: s.ready_lost)
    assert state.ready_lost.code == "other_place"
    assert state.error is None
    with pytest.raises(ConflictError):
        room.call("puncture")
    # not this case's: neither target nor calibration rests on them
    assert room.until(lambda s: s.ready_lost).target_patient_mm == target
    room.call("needle_out")
    room.ready(-1.0, 0.5)


def test_what_is_pushed_late_of_another_patients_earlier_case_takes_back_nothing(room):
    room.ready()
    held(room, code="other_case", same_patient=False)
    assert room.later().ready


def test_slices_of_another_frame_between_the_look_and_its_measurement_count_too(room):
    room.calibrate()
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    record, header = room.loop._record, {**room.header, "frame_of_reference_uid": "1.2.8"}
    request = record.request_measurement

    def table_moves_first(*asked):
        room._add_slice(None, header, reason_code="other_frame_of_reference")
        return request(*asked)

    room.do(lambda: setattr(record, "request_measurement", table_moves_first))
    room.call("start_approach")
    state = room.run_to_end()
    assert "approach done" in state.last_outcome
    state = room.later()
    assert not state.ready
    assert state.measurement.lost.code == "other_place"
    with room.record() as record:  # READY was never said: nothing says that it was
        assert not list(outputs_to_send(record))
        with pytest.raises(CaseRecordError, match="did not reach READY"):
            finding_of_arrival(record, record.last_procedure("approach", "done").procedure_id)


@pytest.mark.parametrize(
    "changed", [{"pixel_bandwidth_hz": 250.0}, {"phase_encoding_direction": "COL"}]
)
def test_a_target_set_where_oil_appeared_is_not_approached_by_another_protocol(room, changed):
    """How far oil appears from water is not known without the readout's polarity."""
    room.ready()
    room.call("needle_out")
    room.do(lambda: room.header.update(changed))
    room.receive(room.until(lambda s: s.hold).hold.hold_id)
    room.later()
    with pytest.raises(ConflictError) as refused:
        room.call("start_approach")
    assert refused.value.code == "target_unusable"
    assert "set it again" in str(refused.value)


def test_with_the_polarity_known_the_target_follows_the_protocol(tmp_path):
    more = f"{IMAGING}readout_polarity = 1\n"
    with running_line_room(tmp_path, more) as room:
        room.ready()
        room.call("needle_out")
        before = room.do(lambda: room.line.stage.positions_um())
        room.do(lambda: room.header.update(pixel_bandwidth_hz=250.0))
        room.receive(room.until(lambda s: s.hold).hold.hold_id)
        room.later()
        room.call("start_approach")
        room.run_to_end()
        room.until(lambda s: s.ready)
        after = room.do(lambda: room.line.stage.positions_um())
    # 3.4 ppm at 123.2 MHz are 419 Hz: 0.84 px by the first bandwidth, 1.68 px by the second. The
    # model shows the fiducial where it is; a real one would appear there shifted by as much.
    assert before["yt"] - after["yt"] == pytest.approx(-838, abs=40)
    assert before["xt"] - after["xt"] == pytest.approx(0, abs=40)


def test_slices_of_another_protocol_end_the_approach_that_was_begun_without_them(room):
    room.calibrate()
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    room.do(lambda: room.header.update(pixel_bandwidth_hz=250.0))
    room.call("start_approach")
    state = room.run_to_end()
    assert "a different pixel bandwidth (250 instead of 500)" in state.last_outcome
    assert not state.ready


@pytest.mark.parametrize(
    ("place_mm", "in_water", "code"),
    [
        ((40.0, 75.0), False, "out_of_reach"),
        ((4000.0, 60.0), False, "bad_target"),
        ((40.0, 60.0), True, "no_polarity"),
    ],
)
def test_a_target_is_judged_when_it_is_set(room, place_mm, in_water, code):
    room.calibrate()
    with pytest.raises(ConflictError) as refused:
        room.call("set_target", patient_mm=patient_mm(*place_mm), in_water=in_water)
    assert refused.value.code == code
    assert room.later().target_patient_mm is None


@pytest.mark.parametrize("emergency", [False, True])
def test_after_a_stop_the_room_comes_to_ready_again(room, emergency):
    """Parking shifts the stages a little: what was measured after it counts, nothing before."""
    room.ready()
    room.stop(emergency=emergency)
    room.until(lambda s: s.ready_lost is not None)
    room.arm()
    room.call("needle_out")
    assert room.ready(-1.0, 1.0).ready


def test_a_failed_procedure_is_an_alarm_that_says_what_to_do(room):
    room.calibrate()
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    room.do(lambda: setattr(room, "fiducial_visible", False))
    room.call("start_approach")
    state = room.run_to_end(lambda s: "abort" if "abort" in s.question.choices else "confirm")
    assert state.last_failure == "nothing_round"
    alarm = next(one for one in state.alarms if one.code == "procedure_failed")
    assert alarm.severity == "alarm"
    assert "nothing round" in alarm.text
    assert alarm.what_to_do
    room.do(lambda: setattr(room, "fiducial_visible", True))
    state = room.ready()
    assert "procedure_failed" not in {one.code for one in state.alarms}


def test_what_to_do_next_has_a_name_and_what_a_calibration_drives_is_said_before(room):
    state = room.until(lambda s: s.robot.linked and s.next_action)
    assert state.next_action == "reset"
    room.arm()
    state = room.until(lambda s: s.next_action == "calibration")
    drives = {one.axis: one.stops_mm for one in state.calibration_drives}
    assert drives == {"xt": (0.0, 0.0, 6.0, 0.0), "yt": (0.0, 0.0, 6.0, 0.0)}
    room.calibrate()
    assert room.until(lambda s: s.next_action == "target")
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    assert room.until(lambda s: s.next_action == "approach")
    room.call("start_approach")
    assert room.until(lambda s: s.ready).next_action == "puncture"
    room.call("puncture")
    assert room.until(lambda s: s.punctured).next_action == "needle-out"


@pytest.mark.parametrize("off_um", [-9000, 9000])
def test_a_count_that_is_far_off_leaves_a_calibration_that_the_bridge_takes_and_that_was_told(
    room, off_um
):
    """What is left of the travel ends where the count does, and where the axis truly would."""
    room.calibrate()

    def correct():
        client = room.link.client
        motion = client.status.last_motion
        client.correct_position({"xt": off_um}, {"xt": 500}, based_on_motion=motion)

    room.do(correct)
    state = room.until(lambda s: s.calibration_drives[0].stops_mm[1] != 0.0)
    told_mm = next(one.stops_mm for one in state.calibration_drives if one.axis == "xt")
    room.call("start_calibration")
    assert room.run_to_end().last_outcome == "calibration done"
    with room.record() as record:
        last = record.last_procedure("calibration", state="done")
        moves = [one for one in record.steps(last.procedure_id) if one.kind == "MoveTo"]
    driven_mm = [step.body["setpoints_um"]["xt"] / 1000 for step in moves]
    assert driven_mm == [told_mm[1], told_mm[2], told_mm[2], told_mm[3]]
