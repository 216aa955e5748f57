"""What speaks against an encoder's count is heeded at once, and by the next program as well."""

import pytest
from axis_model import AXES
from pmd_bench import Bench
from virtual_room import VirtualRoom

from robot_bridge.daemon.motors import MotorError
from robot_bridge.daemon.whereabouts import Stand, Whereabouts
from robot_bridge.emulator.axis import RESET_AT_INDEX, Motor

INDEXED = Motor(index_um=1000.0)


def bench(**changes: object) -> Bench:
    return Bench(names=("xt",), motor=INDEXED, **changes)


def must_be_declared(made: Bench) -> None:
    made.motors.stop()
    assert made.rest().certain_axes == set()
    with pytest.raises(MotorError, match="position_uncertain"):
        made.motors.move_to({"xt": 5000})
    assert made.restart().certain_axes == set()


# --- an index mode that somebody has armed ----------------------------------------------------


def test_an_index_that_somebody_left_armed_is_disarmed_before_anything_moves():
    made = bench()
    made.board.index_mode = RESET_AT_INDEX
    status = made.restart()
    assert made.board.index_mode == 0
    assert status.certain_axes == {"xt"}  # it was not passed: the count is the old one
    assert made.move(3000).reached
    assert made.truth_um() == pytest.approx(3000, abs=1)


def test_a_count_that_was_reset_at_the_index_while_nobody_looked_is_not_believed():
    made = bench()
    made.move(500)
    made.board.index_mode = RESET_AT_INDEX
    made.board.physics.displace(700.0)
    made.line.wait(0.1)
    assert made.board.count == pytest.approx(2000, abs=5)  # from the index on
    assert made.restart().certain_axes == set()


def test_an_index_that_is_armed_later_is_found_before_the_next_move():
    made = bench()
    made.board.index_mode = RESET_AT_INDEX
    status = made.move(3000)
    assert status.fault == "index"
    assert "N reads 4" in status.fault_text
    assert made.truth_um() == 0
    assert made.rest().certain_axes == set()
    assert made.board.index_mode == 0


@pytest.mark.parametrize("lost_answers", [0, 1])
def test_an_index_that_resets_the_count_in_a_move_makes_it_uncertain(lost_answers: int):
    made = bench()
    made.move_until(3000, 900)
    made.board.index_mode = RESET_AT_INDEX
    while not made.board.index_found:
        made.line.wait(0.001)
    made.bus.faults.drop_replies = lost_answers
    status = made.finish()
    assert status.fault in ("index", "stopped")
    assert made.truth_um() < 1100
    must_be_declared(made)


def test_a_motor_that_leaves_its_target_unasked_is_not_where_it_counts():
    made = bench()
    made.move_until(3000, 500)
    made.board.stop()
    made.board.count -= 4000
    assert made.finish().fault == "stopped"
    must_be_declared(made)


def test_declaring_disarms_the_index_even_where_the_count_fits_already():
    made = bench()
    made.board.index_mode = RESET_AT_INDEX
    made.motors.declare_position({"xt": 0})
    assert made.board.index_mode == 0


def test_homing_that_was_stopped_leaves_no_index_armed():
    made = bench(home_to="index", home_um=0)
    made.motors.home(["xt"])
    while made.truth_um() > -2000:
        made.motors.poll()
        made.line.wait(0.005)
    assert made.board.index_mode == RESET_AT_INDEX
    made.motors.stop()
    made.rest()
    assert made.board.index_mode == 0
    must_be_declared(made)


@pytest.mark.parametrize("at_index", [0, 7000])
def test_where_the_index_is_counted_from_is_taken_into_account(at_index: int):
    """Y14: the count that the board gives to the index."""
    made = bench(home_to="index", home_um=500)
    made.board.settings.store(14, at_index)
    made.motors.home(["xt"])
    status = made.finish()
    assert status.fault is None, status
    assert made.truth_um() - status.readback_um["xt"] == pytest.approx(500, abs=2)
    assert made.move(-500).reached
    assert made.truth_um() == pytest.approx(0, abs=2)


# --- the encoder's error, and what a restart believes -----------------------------------------


@pytest.mark.parametrize("in_motion", [True, False])
def test_after_an_error_of_its_encoder_an_axis_is_declared_again(in_motion: bool):
    made = bench()
    if in_motion:
        made.move_until(3000, 500)
    made.board.faults.encoder_error = True
    status = made.finish() if in_motion else made.rest()
    assert status.fault == "controller_error"
    made.board.faults.encoder_error = False
    must_be_declared(made)
    made.motors.declare_position({"xt": round(made.truth_um())})
    assert made.restart().certain_axes == {"xt"}


def test_an_encoder_error_that_only_the_confirmation_of_a_stop_was_told_is_heeded():
    """It is latched, and told once."""
    made = bench()
    made.move_until(3000, 500)
    made.board.faults.encoder_error = True
    made.line.wait(0.001)
    made.board.faults.encoder_error = False
    made.motors.stop()
    must_be_declared(made)


def test_a_stage_that_was_pushed_is_not_certain_after_a_restart():
    made = bench()
    made.board.physics.displace(300.0)
    assert made.rest(0.1).certain_axes == set()
    must_be_declared(made)


def test_an_axis_that_was_being_homed_is_not_certain_after_a_restart():
    made = bench(home_to="index", home_um=0)
    made.motors.home(["xt"])
    for _ in range(60):
        made.motors.poll()
        made.line.wait(0.005)
    assert made.restart().certain_axes == set()
    assert made.board.index_mode == 0


def test_a_port_that_was_lost_in_a_move_gives_no_certain_count_back():
    made = bench()
    made.move_until(3000, 500)
    made.line.plugs["port"].out = True
    made.rest(1.5)
    made.line.plugs["port"].out = False
    status = made.rest(5.0)
    assert status.fault is None
    must_be_declared(made)


def test_the_journal_knows_which_axes_were_lost_at_rest(tmp_path):
    """The next bridge believes no count of theirs, whatever its motors say."""
    room = VirtualRoom(tmp_path, seed=6)
    client = room.client()
    client.open(5.0)
    client.declare_position(dict.fromkeys(AXES, 1000), "test")
    room.motors._certain.discard("xt")
    room.stage.from_um["xt"] = room.stage.to_um["xt"] = 1600
    room.run(1.0)
    assert set(room._journal.settled) == set(AXES) - {"xt"}
    taken = room._journal.stands["xt"]
    assert abs(taken.true_um - 1600) <= taken.bound_um
    client.declare_position({"xt": 1600}, "test")
    assert set(room._journal.settled) == set(AXES)


def test_an_axis_that_was_moved_by_something_else_stands_between():
    known = Whereabouts({}, {"xt": Stand(500), "yt": Stand(0)})
    known.strayed({"xt", "yt"}, {"xt": 900, "yt": 3})
    assert known.stands["yt"] == Stand(0)
    assert abs(known.stands["xt"].at_um - 900) <= known.stands["xt"].bound_um
    assert abs(known.stands["xt"].at_um - 500) <= known.stands["xt"].bound_um
