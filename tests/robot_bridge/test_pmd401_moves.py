"""The driver against emulated controllers over real pseudo-terminals: moves, stops, power."""

import time

import pytest
from pmd_rig import axis_config, finish, opened, rig, wait_until
from virtual_line import VirtualLine

from robot_bridge.daemon.motors import POLL_BOUND_S, STOP_BOUND_S, MotorError
from robot_bridge.emulator.axis import Motor
from robot_bridge.emulator.runs import OpenRun
from robot_bridge.pmd.driver import UNTRIED, PmdMotors


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_two_axes_arrive_where_they_were_sent(drive: str):
    with rig() as made, opened(made, drive) as motors:
        motors.move_to({"xt": 3000, "yt": -1500})
        status = finish(motors)
        assert status.fault is None
        assert status.reached
        assert status.readback_um == {"xt": 3000, "yt": -1500}
        assert made.position_um(1) == pytest.approx(3000, abs=1)
        assert made.position_um(2) == pytest.approx(-1500, abs=1)


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_setpoints_are_absolute(drive: str):
    with rig() as made, opened(made, drive) as motors:
        for setpoint_um in (700, -300, -300, 1200, 0):
            motors.move_to({"xt": setpoint_um})
            assert finish(motors).reached
            assert made.position_um(1) == pytest.approx(setpoint_um, abs=1)


def test_the_same_setpoint_again_moves_nothing_in_open_loop():
    with rig() as made, opened(made, approach_um=0) as motors:
        motors.move_to({"xt": 500})
        finish(motors)
        runs = made.runs()
        motors.move_to({"xt": 500})
        assert finish(motors).reached
        assert made.runs() == runs


def test_the_last_leg_always_comes_from_below():
    with rig() as made, opened(made) as motors:
        motors.move_to({"xt": -400})
        finish(motors)
        assert made.runs() == 2  # below, then up
        assert not made.controller(1).reverse
        motors.move_to({"xt": 400})
        finish(motors)
        assert made.runs() == 3  # from below anyway


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_a_negative_sign_turns_the_axis_round(drive: str):
    with rig() as made, opened(made, drive, sign=-1) as motors:
        motors.move_to({"xt": 1000})
        assert finish(motors).readback_um["xt"] == 1000
        assert made.position_um(1) == pytest.approx(-1000, abs=1)


def test_each_direction_has_its_own_step_length():
    with rig() as made, opened(made, step_um_forward=9.0, approach_um=0) as motors:
        motors.move_to({"xt": 1000})
        finish(motors)
        assert made.position_um(1) == pytest.approx(500, abs=1)  # true steps are 4.5 um
        motors.move_to({"xt": 0})
        finish(motors)
        assert made.position_um(1) == pytest.approx(-500, abs=1)


def test_axes_on_ports_of_their_own_move_together():
    with rig((1,)) as first, rig((1,), tcp=True) as second:
        axes = [axis_config("xt", first.url, 1), axis_config("yt", second.url, 1)]
        motors = PmdMotors(axes)
        motors.open()
        motors.declare_position({"xt": 0, "yt": 0})
        motors.move_to({"xt": 800, "yt": 900})
        assert finish(motors).reached
        motors.close()
        assert first.position_um(1) == pytest.approx(800, abs=1)
        assert second.position_um(1) == pytest.approx(900, abs=1)


def test_position_is_uncertain_after_power_up_until_declared():
    with rig() as made, opened(made, declare=False) as motors:
        assert not motors.poll().certain
        motors.declare_position({"xt": 100})
        assert not motors.poll().certain
        motors.declare_position({"yt": 200})
        status = motors.poll()
        assert status.certain
        assert status.readback_um == {"xt": 100, "yt": 200}


def test_an_encoder_that_kept_its_supply_is_still_certain_for_the_next_driver():
    with rig() as made:
        with opened(made, "closed_loop") as motors:
            motors.move_to({"xt": 500, "yt": 0})
            finish(motors)
        with opened(made, "closed_loop", declare=False) as motors:
            status = motors.poll()
            assert status.certain
            assert status.readback_um["xt"] == pytest.approx(500, abs=1)
        with opened(made, "open_loop", declare=False) as motors:
            assert not motors.poll().certain


def test_opening_moves_nothing_and_warns_that_it_is_untried():
    with rig() as made, opened(made, declare=False) as motors:
        assert UNTRIED in motors.poll().warnings
        assert made.causes == []


# Bounds of time are held on the line's own clock: what a busy computer adds is not the driver's.


def test_stop_ends_the_motion_of_all_axes_at_once():
    line = VirtualLine({"xt": "open_loop", "yt": "open_loop"})
    line.open_at_zero()
    line.motors.move_to({"xt": 15_000, "yt": 15_000})
    while line.poll().readback_um["xt"] <= 500:
        assert line.position_um() < 14_000
    begun_s = line.now_s
    line.motors.stop()
    assert line.now_s - begun_s < STOP_BOUND_S
    assert not line.moving()
    stood_um = line.position_um()
    status = line.motors.poll()
    assert not status.moving
    assert not status.certain  # an open-loop run that was cut short cannot be accounted for
    line.wait(1.0)
    assert line.position_um() == stood_um


def test_stop_works_before_open_and_again_and_again():
    line = VirtualLine({"xt": "open_loop", "yt": "open_loop"})
    for _ in range(2):
        let_run(line)
        line.motors.stop()
        assert not line.moving()
    line.motors.stop()
    assert not line.motors.poll().moving


def let_run(line: VirtualLine) -> None:
    """Somebody else's open-loop run, far longer than any test."""
    line.controller().unpark()
    line.wait(1.0)
    line.controller().begin_open_run(OpenRun(10**9, 1, 100.0), "run")
    assert line.moving()


def test_stop_says_which_axis_did_not_confirm():
    line = VirtualLine({"xt": "open_loop", "yt": "open_loop"})
    line.open_at_zero()
    line.controller(2).faults.dead = True
    begun_s = line.now_s
    with pytest.raises(MotorError, match="yt") as caught:
        line.motors.stop()
    assert caught.value.code == "stop_unconfirmed"
    assert line.now_s - begun_s < STOP_BOUND_S


def test_no_poll_takes_longer_than_its_bound():
    line = VirtualLine({"xt": "closed_loop", "yt": "closed_loop"})
    line.bus.faults.drop_probability = 0.02
    line.open_at_zero()
    line.motors.move_to({"xt": 5000, "yt": 5000})
    longest_s, moving = 0.0, True
    while moving:
        begun_s = line.now_s
        moving = line.motors.poll().moving
        longest_s = max(longest_s, line.now_s - begun_s)
        line.wait(0.002)
    assert 0.0 < longest_s < POLL_BOUND_S


def test_beyond_travel_is_refused_and_nothing_moves():
    with rig() as made, opened(made) as motors:
        with pytest.raises(MotorError, match=r"outside -20000\.\.20000 um") as caught:
            motors.move_to({"xt": 0, "yt": 20_001})
        assert caught.value.code == "beyond_travel"
        with pytest.raises(MotorError, match="no axis 'zt'"):
            motors.move_to({"zt": 0})
        with pytest.raises(MotorError):
            motors.move_to({"xt": float("nan")})
        assert made.runs() == 0


def test_parked_while_imaging_parks_after_each_move_and_unparks_for_the_next():
    with rig() as made, opened(made, "closed_loop", park_after_move=True) as motors:
        for setpoint_um in (300, 900):
            motors.move_to({"xt": setpoint_um, "yt": 0})
            status = finish(motors)
            assert status.parked
            assert status.reached
        assert made.position_um(1) == pytest.approx(900, abs=1)


def test_park_leaves_target_mode_so_that_unparking_moves_nothing():
    with rig() as made, opened(made, "closed_loop") as motors:
        motors.move_to({"xt": 300, "yt": 100})
        finish(motors)
        motors.park()
        wait_until(motors, lambda s: s.parked)
        with made.lock:
            made.controller(1).physics.displace(200.0)
            made.bus.receive(b"X1M2;", time.monotonic())
        time.sleep(0.1)
        assert made.position_um(1) == pytest.approx(500, abs=1)


def test_the_speed_is_capped_by_what_the_controller_measured():
    slow = Motor(capacitance_nf=2064)
    with rig(motor=slow) as made, opened(made) as motors:
        motors.move_to({"xt": 1000})
        wait_until(motors, lambda s: made.controller(1).run is not None)
        with made.lock:
            run = made.controller(1).run
            assert run is None or run.frequency_hz == 457
        assert finish(motors).reached


def test_the_response_delay_is_set_at_every_opening():
    with rig() as made:
        for delay_us in (200, 20):
            motors = PmdMotors([axis_config("xt", made.url, 1)], response_delay_us=delay_us)
            motors.open()
            motors.close()
            assert made.controller(1).settings[44] == delay_us
