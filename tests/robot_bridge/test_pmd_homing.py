"""A reference is believed on evidence alone: the truth is the stage's own position."""

from collections.abc import Callable

import pytest
from pmd_bench import POLL_S, Bench
from pmd_rig import StageWithEnds, finish, opened, rig, wait_until

from robot_bridge.daemon.motors import MotorError
from robot_bridge.emulator.axis import Motor

SWITCHED = Motor(switches_um=(-20_000.0, 20_000.0))
WIRED = {"limit_switches": 1}


def test_a_mechanical_end_is_found_by_the_encoder_that_stops_following():
    with rig(stage=StageWithEnds) as made, opened(made, "closed_loop", declare=False) as motors:
        motors.home()
        status = finish(motors)
        assert status.fault is None, status
        assert status.certain
        assert status.readback_um == {"xt": -20_000, "yt": -20_000}
        assert made.position_um(1) == pytest.approx(-21_000, abs=1)
        motors.move_to({"xt": 0, "yt": -20_000})
        assert finish(motors).reached
        assert made.position_um(1) == pytest.approx(-1000, abs=1)
        assert made.position_um(2) == pytest.approx(-21_000, abs=1)


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_a_limit_switch_is_left_again_before_it_is_believed(drive: str):
    with rig(motor=SWITCHED) as made, opened(made, drive, declare=False, **WIRED) as motors:
        motors.home()
        status = finish(motors)
        assert status.fault is None, status
        assert status.certain
        # it stands a little off the switch, so that it can be homed again
        assert status.readback_um == pytest.approx({"xt": -19_500, "yt": -19_500}, abs=20)
        assert made.position_um(1) == pytest.approx(-19_500, abs=30)
        motors.home()
        assert finish(motors).certain


def test_one_axis_is_homed_and_the_others_neither_move_nor_become_certain():
    with rig(motor=SWITCHED) as made, opened(made, declare=False, **WIRED) as motors:
        motors.home(["yt"])
        status = finish(motors)
        assert status.certain_axes == {"yt"}
        assert made.position_um(1) == 0


def test_the_index_of_an_encoder_is_found_and_left_behind_in_the_count():
    motor = Motor(index_um=3000.0)
    changes = {"home_um": 500, "home_to": "index"}
    with (
        rig(stage=StageWithEnds, motor=motor) as made,
        opened(made, "closed_loop", declare=False, **changes) as motors,
    ):
        motors.home(["xt"])
        status = finish(motors)
        assert status.fault is None, status
        motors.move_to({"xt": -1000})
        assert finish(motors).reached
        assert made.position_um(1) == pytest.approx(1500, abs=2)


def test_a_board_that_came_to_the_axis_by_a_swapped_cable_is_not_homed():
    """Nothing dropped out: only the serial number tells."""
    with rig(stage=StageWithEnds) as made, opened(made, "closed_loop", declare=False) as motors:
        with made.lock:
            made.controller(1).motor = Motor(serial_number=77)
        motors.home(["xt"])
        assert finish(motors).fault == "wrong_board"
        assert made.runs() == 0


def test_an_index_that_was_not_found_leaves_no_run_that_ends_at_it():
    motor = Motor(index_um=50_000.0)
    changes = {"home_um": 0, "home_to": "index"}
    with (
        rig(stage=StageWithEnds, motor=motor) as made,
        opened(made, "closed_loop", declare=False, **changes) as motors,
    ):
        motors.home(["xt"])
        assert finish(motors).fault == "cannot_home"
        assert made.controller(1).index_mode == 0


def refused(motors, why: str) -> None:
    status = finish(motors)
    assert status.fault == "cannot_home"
    assert why in status.fault_text
    assert "xt" not in status.certain_axes
    for _ in range(5):
        motors.poll()
    with pytest.raises(MotorError):
        motors.move_to({"xt": 10_000, "yt": 0})


def test_an_axis_with_neither_encoder_nor_switch_is_declared_and_not_homed():
    with rig(stage=StageWithEnds) as made, opened(made, declare=False) as motors:
        motors.home(["xt"])
        refused(motors, "no encoder or limit switch")
        assert made.position_um(1) == 0


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("stuck", ["limit_switch", "limit_reverse", "limit_forward"])
def test_a_switch_that_is_on_before_the_run_is_no_reference(drive: str, stuck: str):
    with rig(motor=SWITCHED) as made, opened(made, drive, declare=False, **WIRED) as motors:
        with made.lock:
            setattr(made.controller(1).faults, stuck, True)
        motors.home(["xt"])
        refused(motors, "limit switch is on before the run")
        assert made.position_um(1) == 0


def test_a_switch_that_sticks_on_the_way_is_no_reference():
    with (
        rig(motor=SWITCHED, speed_factor=2.0) as made,
        opened(made, declare=False, **WIRED) as motors,
    ):
        motors.home(["xt"])
        wait_until(motors, lambda s: made.position_um(1) < -500)
        with made.lock:
            made.controller(1).faults.limit_reverse = True
        refused(motors, "stays on when the axis leaves it")


def test_switches_that_are_wired_the_wrong_way_round_are_no_reference():
    wrong = Motor(switches_um=(-20_000.0, 20_000.0), mounting=-1)
    with (
        rig(motor=wrong, stage=StageWithEnds) as made,
        opened(made, declare=False, **WIRED) as motors,
    ):
        motors.home(["xt"])
        refused(motors, "limit switch")


@pytest.mark.parametrize("fault", ["stalled", "encoder_frozen"])
def test_an_encoder_that_does_not_move_is_no_reference(fault: str):
    with rig(stage=StageWithEnds) as made, opened(made, "closed_loop", declare=False) as motors:
        with made.lock:
            setattr(made.controller(1).faults, fault, True)
        motors.home(["xt"])
        refused(motors, "the encoder")


@pytest.mark.parametrize("wrong", [{"um_per_count": 0.05}, {"encoder_reversed": True}])
def test_an_encoder_that_counts_wrongly_is_no_reference(wrong: dict):
    with (
        rig(stage=StageWithEnds, motor=Motor(**wrong)) as made,
        opened(made, "closed_loop", declare=False) as motors,
    ):
        motors.home(["xt"])
        refused(motors, "counts_per_mm")


def test_home_needs_a_configured_place():
    with (
        rig() as made,
        opened(made, home_um=None) as motors,
        pytest.raises(MotorError, match="home_mm"),
    ):
        motors.home()


# --- in virtual time --------------------------------------------------------------------------


def homing(motor: Motor | None = None, drive: str = "closed_loop", **changes: object) -> Bench:
    return Bench(drive, names=("xt",), motor=motor, stage=StageWithEnds, declare=False, **changes)


def home_until(made: Bench, at_um: float) -> None:
    """The search, in the negative direction, has come there."""
    made.motors.home(["xt"])
    while made.truth_um() > at_um:
        made.motors.poll()
        made.line.wait(POLL_S)


def run_until(made: Bench, wanted: Callable[[], bool]) -> None:
    for _ in range(20_000):
        if wanted():
            return
        made.motors.poll()
        made.line.wait(POLL_S)
    raise AssertionError("never")


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("latency_s", [0.0, 0.03])
def test_a_switch_that_trips_at_two_places_is_no_reference(drive: str, latency_s: float):
    made = homing(SWITCHED, drive, latency_s=latency_s, **WIRED)
    home_until(made, -3000)
    made.board.faults.limit_reverse = True  # a loose wire
    run_until(made, lambda: made.board.moving and not made.board.reverse)
    made.board.faults.limit_reverse = False
    run_until(made, lambda: made.board.moving and made.board.reverse)
    from_um = made.truth_um()
    run_until(made, lambda: made.truth_um() < from_um - 400)
    made.board.faults.limit_reverse = True
    status = made.finish()
    assert status.fault == "cannot_home"
    assert "away the second time" in status.fault_text
    assert status.certain_axes == set()


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("latency_s", [0.0, 0.03])
def test_a_sound_switch_trips_at_one_place(drive: str, latency_s: float):
    made = homing(SWITCHED, drive, latency_s=latency_s, **WIRED)
    made.motors.home(["xt"])
    status = made.finish()
    assert status.fault is None, status
    assert made.truth_um() == pytest.approx(status.readback_um["xt"], abs=100)


@pytest.mark.parametrize(
    ("drive", "wrong"),
    [
        ("open_loop", "limit_reverse"),
        ("closed_loop", "limit_reverse"),
        ("closed_loop", "encoder_frozen"),
    ],
)
def test_pulling_off_at_the_end_is_checked(drive: str, wrong: str):
    made = homing(SWITCHED, drive, **WIRED)
    home_until(made, -19_990)
    run_until(made, lambda: made.truth_um() > -19_100)
    run_until(made, lambda: made.truth_um() < -19_995)
    run_until(made, lambda: made.board.moving and not made.board.reverse)
    setattr(made.board.faults, wrong, True)
    status = made.finish()
    assert status.fault == "cannot_home"
    assert status.certain_axes == set()
    made.motors.stop()
    assert made.restart().certain_axes == set()


@pytest.mark.parametrize("latency_s", [0.0, 0.016])
def test_a_hard_stop_is_not_ground_against(latency_s: float):
    made = homing(latency_s=latency_s)
    made.motors.home(["xt"])
    status = made.finish()
    assert status.certain
    assert made.board.physics.ground_um < 2 * 1000  # two encounters; it was 3 mm


@pytest.mark.parametrize("to", ["switch", "index"])
def test_a_reference_that_does_not_come_ends_at_the_hard_stop_at_once(to: str):
    """Dead switches, or an index that is not there: the encoder tells."""
    changes = WIRED if to == "switch" else {"home_to": "index"}
    made = homing(SWITCHED, **changes)
    made.board.faults.limits_dead = True
    made.motors.home(["xt"])
    status = made.finish()
    assert status.fault == "cannot_home"
    assert made.board.physics.ground_um < 2 * 500


@pytest.mark.parametrize("to", ["end", "switch", "index"])
def test_a_motor_whose_encoder_is_dead_is_not_run_far(to: str):
    changes = {"switch": WIRED, "index": {"home_to": "index"}, "end": {}}[to]
    made = homing(SWITCHED, **changes)
    made.board.faults.encoder_frozen = True
    made.motors.home(["xt"])
    assert made.finish().fault == "cannot_home"
    assert abs(made.truth_um()) < 1500


@pytest.mark.parametrize("home_to", ["end", "switch", "index"])
def test_four_axes_on_one_slow_bus_home_within_the_time_that_is_asked_for_them(home_to: str):
    """The longest way: from the other end, or for an index to the end and back again."""
    motor = Motor(index_um=19_000.0) if home_to == "index" else SWITCHED
    changes: dict[str, object] = {"home_to": "index"} if home_to == "index" else {}
    if home_to == "switch":
        changes = dict(WIRED)
    made = Bench(latency_s=0.03, stage=StageWithEnds, motor=motor, home_um=-20_000, **changes)
    for board in made.boards:
        board.physics._position_um = 18_000.0 if home_to == "index" else 19_900.0
    made.restart()
    began_s = made.line.now_s
    made.motors.home()
    assert made.finish().certain
    assert made.line.now_s - began_s < made.axes[0].homing_s(len(made.axes))
