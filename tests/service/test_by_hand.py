"""Overrules that cannot lie: what needs no clock is checked for people too, and what rests on an
overrule is marked wherever it is shown.
"""

import pytest
from line_room import patient_mm, running_line_room

from service.cli.report import report_page
from service.room.refusal import ConflictError
from service.web.routes.record import _offered


@pytest.fixture
def room(tmp_path):
    with running_line_room(tmp_path) as running:
        running.calibrate()
        yield running


def refusal(room, slice_id, hold_id, why="the scanner's console said so"):
    with pytest.raises(ConflictError) as refused:
        room.call("assign_slice", slice_id=slice_id, hold_id=hold_id, why=why)
    return refused.value.code, str(refused.value)


def offered(room, slice_id):
    with room.record() as record:
        return _offered(record, record.slice(slice_id))


def waiting_for_a_slice(room):
    """An approach that has moved and waits: nothing comes from the scanner."""
    room.call("set_target", patient_mm=patient_mm(41.0, 58.0))
    before = room.state.hold.hold_id
    room.do(lambda: setattr(room, "scanning", False))
    room.call("start_approach")
    state = room.until(lambda s: s.acquisition_request is not None)
    assert state.hold.hold_id > before
    return state.hold.hold_id


def test_a_slice_that_came_before_the_hold_settled_is_refused_and_not_offered(room):
    early = room.receive()
    hold_id = waiting_for_a_slice(room)
    code, text = refusal(room, early, hold_id)
    assert code == "not_of_hold"
    assert f"before the robot settled at hold {hold_id}" in text
    assert offered(room, early) is None


OTHER = {
    "study": {"study_instance_uid": "1.2.2"},
    "frame of reference": {"frame_of_reference_uid": "1.2.8"},
    "grid": {"geometry": {"shape": [64, 64]}},
    "pixels": {"geometry": {"spacing_mm": [2.0, 2.0]}},
    "a different plane": {"geometry": {"row_direction": [0.0, 1.0, 0.0]}},
    "it lies at": {"geometry": {"position_mm": [0.0, 5.0, 0.0]}},
}


@pytest.mark.parametrize("words", OTHER)
def test_a_slice_of_something_else_is_refused_whoever_says_so(room, words):
    hold_id = waiting_for_a_slice(room)
    slice_id = room.receive(**OTHER[words])
    code, text = refusal(room, slice_id, hold_id)
    assert code == "not_of_hold"
    assert words in text
    assert offered(room, slice_id) is None


def test_what_was_set_aside_for_what_it_is_stays_aside(room):
    hold_id = waiting_for_a_slice(room)
    phase = room.do(lambda: room._add_slice(None, room.header, reason_code="phase"))
    assert "for what it is" in refusal(room, phase, hold_id)[1]
    assert offered(room, phase) is None


def test_a_slice_is_offered_for_the_hold_that_stands_and_a_reason_is_asked_for(room):
    hold_id = waiting_for_a_slice(room)
    slice_id = room.receive()
    assert offered(room, slice_id) == hold_id
    assert refusal(room, slice_id, hold_id, why="  ")[0] == "no_reason"
    older = hold_id - 1
    assert "has ended and has all its slices" in refusal(room, slice_id, older)[1]


def test_what_rests_on_an_overrule_is_marked_wherever_it_is_shown(room):
    hold_id = waiting_for_a_slice(room)
    slice_id = room.receive()
    room.call("assign_slice", slice_id=slice_id, hold_id=hold_id, why="seen on the console")
    room.do(lambda: setattr(room, "scanning", True))
    room.run_to_end()
    state = room.until(lambda s: s.ready)
    assert state.arrival.by_hand
    assert "by hand" in state.prompt
    room.call("puncture")
    with room.record() as record:
        event = record.last_event("slice_reassigned")
        assert (event.who, event.body["why"]) == ("tester", "seen on the console")
        assert record.last_event("puncture").body["by_hand"]
        assert "by hand" in report_page(record)


def test_without_an_overrule_nothing_is_marked(room):
    state = room.ready()
    assert not state.arrival.by_hand
    assert "hand" not in state.prompt
