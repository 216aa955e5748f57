"""Identity by motion: what looks like the fiducial is it only if it goes with the robot."""

import numpy as np
import pytest
from line_room import ORIGIN_MM, patient_mm, running_line_room

from service.procedure.identity import PROOF

TARGET_MM = (ORIGIN_MM[0] + 1.0, ORIGIN_MM[1] - 2.0)


@pytest.fixture
def room(tmp_path):
    with running_line_room(tmp_path) as running:
        running.calibrate()
        yield running


def proof_moves(room):
    with room.record() as record:
        return [move for move in record.moves() if move.purpose == PROOF]


def jog(room, axis, distance_um):
    room.call("jog", axis=axis, distance_um=distance_um)
    return room.run_to_end()


def replaced_by(room, *decoys_mm):
    """The fiducial is out of the slice, and something else that is round is there."""

    def replace():
        room.fiducial_visible = False
        room.decoys_mm = [np.array(place) for place in decoys_mm]

    room.do(replace)


def test_another_sphere_at_the_target_is_not_ready(room):
    room.call("set_target", patient_mm=patient_mm(*TARGET_MM))
    jog(room, "xt", 3000)
    replaced_by(room, TARGET_MM)
    room.call("start_approach")
    state = room.run_to_end()
    assert not state.ready
    assert "not the fiducial" in state.last_outcome
    assert not state.robot.insertion_locked
    assert len(proof_moves(room)) == 1


def test_another_sphere_does_not_become_the_target(room):
    jog(room, "xt", 3000)
    replaced_by(room, (42.0, 61.5))
    room.call("record_target")
    state = room.run_to_end()
    assert state.target_patient_mm is None
    assert "not the fiducial" in state.last_outcome


def test_a_fiducial_that_was_lost_and_found_again_is_proven_before_ready(room):
    """It is lost where it should have come to, and then something round is seen just there."""
    room.call("set_target", patient_mm=patient_mm(*TARGET_MM))

    def lost_at_first(state):
        replaced_by(room, TARGET_MM)
        return state.question.choices[0]

    room.do(lambda: setattr(room, "fiducial_visible", False))
    room.call("start_approach")
    state = room.run_to_end(lost_at_first)
    assert not state.ready
    assert "not the fiducial" in state.last_outcome


def test_the_fiducial_itself_is_ready_after_a_proof_move_where_nothing_else_moved(room):
    jog(room, "xt", -2000)
    jog(room, "yt", 1000)
    room.call("set_target", patient_mm=patient_mm(*TARGET_MM))
    room.call("start_approach")
    room.run_to_end()
    state = room.until(lambda s: s.ready)
    assert state.arrival.error_mm < 0.06
    assert len(proof_moves(room)) == 1
    truth_mm = room.do(room.true_plane_mm)
    assert np.linalg.norm(truth_mm - TARGET_MM) < 0.06


def test_the_fiducials_place_becomes_the_target_after_a_proof_move_and_the_way_back(room):
    at_um = jog(room, "xt", 3000).robot.positions_um
    room.call("record_target")
    state = room.run_to_end()
    x, _, z = room.until(lambda s: s.target_patient_mm).target_patient_mm
    assert state.robot.positions_um == at_um
    assert np.allclose([-z, x], room.do(room.true_plane_mm), atol=0.03)
    assert len(proof_moves(room)) == 1


def test_where_a_move_has_shown_it_no_proof_move_is_made(room):
    room.ready()
    room.call("needle_out")
    room.ready(2.0, 2.0)
    room.call("needle_out")
    room.call("record_target")
    room.run_to_end()
    assert not proof_moves(room)
    # not even after a jog, if the approach moves by itself
    jog(room, "xt", 1500)
    room.ready(-1.0, -1.0)
    assert not proof_moves(room)


def test_a_proof_move_waits_for_confirmation_like_any_other(tmp_path):
    with running_line_room(tmp_path, "confirm_moves = true") as room:
        room.calibrate()
        jog(room, "xt", -2000)
        jog(room, "yt", 1000)
        room.call("set_target", patient_mm=patient_mm(*TARGET_MM))
        room.call("start_approach")
        state = room.until(lambda s: s.question is not None)
        assert "as a proof move" in state.question.question
        begun = len(room.line.stage.begun)
        room.call("answer", question_id=state.question.question_id, choice="reject")
        state = room.run_to_end()
        assert not state.ready
        assert len(room.line.stage.begun) == begun
