"""Four axes by orders to the whole room, every move confirmed by the test."""

from collections.abc import Iterator

import numpy as np
import pytest
from attended_room import AttendedRoom, calibrated, running_room, stop_all, wait_for

from service.client import RefusedByServiceError, RoomClient
from service.room.state import RoomState
from simulator.config import parse_virtual_room
from simulator.scene import true_guide
from simulator.truth_client import TruthAddress, ask_where

PATIENCE_S = 250.0
IN_PLANE = [0, 2]


@pytest.fixture(scope="module")
def guide_room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttendedRoom]:
    with running_room(tmp_path_factory.mktemp("guide"), guide=True) as running:
        yield running


@pytest.fixture
def operator(guide_room: AttendedRoom) -> Iterator[RoomClient]:
    with RoomClient(guide_room.url, by="tester") as talking:
        calibrated(talking)
        yield talking


def idle(client: RoomClient) -> RoomState:
    return wait_for(client.state, lambda s: s.procedure is None, PATIENCE_S)


def true_tip_mm(room: AttendedRoom, depth_mm: float) -> np.ndarray:
    stages = ask_where(TruthAddress("127.0.0.1", room.truth_port))
    return true_guide(parse_virtual_room(room.virtual_table), stages.positions_mm).at(-depth_mm)


def refusal(order) -> tuple[str, str]:
    with pytest.raises(RefusedByServiceError) as refused:
        order()
    assert refused.value.status == 409
    return refused.value.code, str(refused.value)


def test_a_needle_needs_an_entry_point_and_a_target_within_reach(operator: RoomClient) -> None:
    state = operator.state()
    assert state.guide
    if state.entry_patient_mm is None:
        operator.set_target((5.0, -82.0, -18.0))
        assert refusal(operator.start_approach)[0] == "no_entry"
        assert operator.state().prompt == "Set an entry point."
    operator.set_entry((5.0, -22.0, -18.0))
    code, text = refusal(lambda: operator.set_target((5.0, -182.0, -18.0)))
    assert code == "out_of_reach"
    assert "180.0 mm below the lower ball joint; the needle reaches 120 mm" in text
    assert "less than 30° from" in refusal(lambda: operator.set_target((40.0, -30.0, -18.0)))[1]


def test_where_the_guide_points_becomes_entry_and_target(
    guide_room: AttendedRoom, operator: RoomClient
) -> None:
    operator.record_target(label="as it stands")
    state = idle(operator)
    assert state.last_outcome == "guide_recording done"
    newest = operator.targets()[-1]
    assert (newest.label, newest.current) == ("as it stands", True)
    sigma_mm = [e for e in operator.events() if e.kind == "target_set"][-1].body["sigma_mm"]
    miss = (true_tip_mm(guide_room, 80.0) - np.array(newest.patient_mm))[IN_PLANE]
    assert np.linalg.norm(miss) < 5 * sigma_mm
    assert state.entry_patient_mm is not None
    assert state.entry_patient_mm[1] == pytest.approx(-2.0)


def test_an_entry_point_that_is_changed_while_a_move_waits_voids_the_plan(
    operator: RoomClient,
) -> None:
    operator.set_entry((6.0, -22.0, -18.0))
    operator.set_target((8.0, -82.0, -20.0))
    operator.start_approach()
    asked = wait_for(operator.state, lambda s: s.question is not None, PATIENCE_S).question
    assert asked is not None
    assert "the needle's tip" in asked.question
    before = operator.state().robot.positions_um
    operator.set_entry((7.0, -22.0, -18.0))
    code, text = refusal(lambda: operator.answer(asked.question_id, "confirm"))
    assert code in ("plan_void", "stale_question")
    assert "entry point was changed by tester" in text
    after = idle(operator)
    assert "entry point was changed" in after.last_outcome
    assert after.robot.positions_um == before


def test_confirmed_move_by_move_the_needle_comes_to_ready(
    guide_room: AttendedRoom, operator: RoomClient
) -> None:
    stop_all(operator)
    target = (6.5, -82.0, -19.5)
    operator.set_entry((5.5, -22.0, -18.5))
    operator.set_target(target)
    operator.start_approach()
    while not (state := operator.state()).ready:
        assert state.procedure == "guide_approach", state.last_outcome
        if state.question is not None:
            assert state.question.plan is not None
            choice = "confirm" if "confirm" in state.question.choices else "rescan"
            operator.answer(state.question.question_id, choice)
        wait_for(
            operator.state,
            lambda s: s.ready or s.question is not None or s.procedure is None,
            PATIENCE_S,
        )
    arrival = operator.state().arrival
    assert arrival is not None
    assert arrival.tip_mm is not None
    assert arrival.tip_below_joint_mm is not None
    assert arrival.tip_covariance_mm2 is not None
    tip = true_tip_mm(guide_room, arrival.tip_below_joint_mm)
    miss = (tip - np.array(arrival.tip_mm))[IN_PLANE]
    assert np.linalg.norm(miss) < 5 * np.sqrt(np.trace(arrival.tip_covariance_mm2))
    assert np.linalg.norm((tip - np.array(target))[IN_PLANE]) < 0.4
    wait_for(operator.state, lambda s: s.robot.insertion_locked, PATIENCE_S)
    operator.record_puncture(insertion_depth_mm=80.0)
    operator.needle_out()
    assert not wait_for(operator.state, lambda s: not s.robot.insertion_locked).ready
