"""Targets by orders to the whole room: recorded, several, chosen again, changed at a bad moment."""

from collections.abc import Callable

import numpy as np
import pytest
from attended_room import AttendedRoom, calibrated, stop_all, wait_for

from service.client import RefusedByServiceError, RoomClient
from service.room.state import QuestionState, RoomState
from simulator.config import parse_virtual_room
from simulator.scene import true_fiducial_mm
from simulator.truth_client import TruthAddress, ask_where

PATIENCE_S = 200.0


@pytest.fixture
def state(client: RoomClient) -> RoomState:
    return calibrated(client)


def place(state: RoomState) -> tuple[float, float, float]:
    assert state.measurement is not None
    assert state.measurement.patient_mm is not None
    return state.measurement.patient_mm


def beside(state: RoomState, x_mm: float, z_mm: float) -> tuple[float, float, float]:
    x, y, z = place(state)
    return x + x_mm, y, z + z_mm


def waiting_for_confirmation(client: RoomClient, state: RoomState) -> QuestionState:
    """An approach that has a plan and asks for confirmation."""
    client.set_target(beside(state, 2.0, -1.5), label="first")
    client.start_approach()
    asked = wait_for(client.state, lambda s: s.question is not None, PATIENCE_S).question
    assert asked is not None
    assert asked.plan is not None
    return asked


def to_the_end(client: RoomClient) -> RoomState:
    """Say yes to whatever is asked: what the tests before have left may need a proof move."""
    asked: QuestionState | None = None
    while True:
        state = wait_for(
            client.state,
            lambda s, last=asked: s.procedure is None or s.question not in (None, last),
            PATIENCE_S,
        )
        if state.procedure is None:
            return state
        asked = state.question
        assert asked is not None
        plan_id = None if asked.plan is None else asked.plan.get("plan_id")
        client.answer(asked.question_id, asked.choices[0], plan_id=plan_id)


def test_where_the_fiducial_is_becomes_the_target_as_well_as_the_tolerance_asks(
    room: AttendedRoom, client: RoomClient, state: RoomState
) -> None:
    number = client.record_target(label="first puncture")
    after = to_the_end(client)
    assert after.last_outcome == "recording done"
    newest = client.targets()[-1]
    assert (newest.label, newest.who, newest.in_water, newest.current) == (
        *("first puncture", "tester"),
        *(False, True),
    )
    assert after.target_patient_mm == newest.patient_mm
    event = [e for e in client.events() if e.kind == "target_set"][-1]
    assert event.body["procedure_id"] == number
    assert event.body["sigma_mm"] < after.tolerance_mm / 3
    truth = ask_where(TruthAddress("127.0.0.1", room.truth_port))
    virtual = parse_virtual_room(room.virtual_table)
    miss = true_fiducial_mm(virtual, truth.positions_mm) - np.array(newest.patient_mm)
    assert np.linalg.norm(miss[[0, 2]]) < 5 * event.body["sigma_mm"]


def test_a_case_has_several_targets_and_an_earlier_one_can_be_chosen_again(
    client: RoomClient, state: RoomState
) -> None:
    for number, label in enumerate(("left", "right")):
        client.set_target(beside(state, 1.0 + number, 0.0), label=label)
    left, right = client.targets()[-2:]
    assert (left.label, right.label) == ("left", "right")
    assert (left.current, right.current) == (False, True)
    client.choose_target(left.number)
    again = client.targets()[-1]
    assert (again.label, again.patient_mm, again.current) == ("left", left.patient_mm, True)
    assert client.state().target_patient_mm == left.patient_mm
    client.start_approach()
    wait_for(client.state, lambda s: s.question is not None, PATIENCE_S)
    stop_all(client)
    assert len(client.targets()[-1].approaches) == 1
    with pytest.raises(RefusedByServiceError, match=r"no target 1\b") as refused:
        client.choose_target(1)  # the first event of a case is no target
    assert (refused.value.status, refused.value.code) == (409, "no_target")


CHANGES: dict[str, Callable[[RoomClient, RoomState], None]] = {
    "target was changed": lambda client, state: client.set_target(beside(state, -2.0, 1.0)),
    "target was withdrawn": lambda client, state: client.withdraw_target(),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_change_of_target_voids_the_plan_that_waits_and_a_late_confirmation_is_told_so(
    client: RoomClient, state: RoomState, what: str
) -> None:
    asked = waiting_for_confirmation(client, state)
    assert asked.plan is not None
    before = client.state().robot.positions_um
    CHANGES[what](client, state)
    with pytest.raises(RefusedByServiceError, match=f"{what} by tester") as refused:
        client.answer(asked.question_id, "confirm", plan_id=asked.plan["plan_id"])
    assert refused.value.status == 409
    assert refused.value.code in ("plan_void", "stale_question")
    after = wait_for(client.state, lambda s: s.procedure is None, PATIENCE_S)
    assert after.question is None
    assert after.last_outcome.startswith(f"approach aborted: the {what} by tester while a move")
    assert after.robot.positions_um == before
    assert after.robot.armed
    void = [event for event in client.events() if event.kind == "plan_void"][-1]
    assert (void.who, void.body["plan_id"]) == ("tester", asked.plan["plan_id"])


def test_after_a_withdrawn_target_nothing_is_approached(
    client: RoomClient, state: RoomState
) -> None:
    client.set_target(beside(state, 1.0, 1.0))
    client.withdraw_target()
    assert client.state().target_patient_mm is None
    for order in (client.start_approach, client.withdraw_target):
        with pytest.raises(RefusedByServiceError) as refused:
            order()
        assert (refused.value.status, refused.value.code) == (409, "no_target")
    assert not any(target.current for target in client.targets())


def test_while_a_calibration_runs_the_target_stays(client: RoomClient, state: RoomState) -> None:
    client.set_target(beside(state, 1.0, 1.0))
    wanted = client.state().target_patient_mm
    client.start_calibration()
    with pytest.raises(RefusedByServiceError) as refused:
        client.set_target(beside(state, 3.0, 1.0))
    assert refused.value.code in ("busy", "moving")
    stop_all(client)
    assert client.state().target_patient_mm == wanted


def test_four_axes_are_refused_in_a_room_that_has_two(client: RoomClient, state: RoomState) -> None:
    for order in (client.start_calibration, client.start_approach):
        with pytest.raises(RefusedByServiceError, match=r"\[service\.guide\]") as refused:
            order(guide=True)
        assert (refused.value.status, refused.value.code) == (409, "no_guide")
