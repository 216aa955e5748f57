"""Faults of line, controller, motor and encoder: a typed fault, and all motors stopped."""

import os
import re
import time
import tty

import pytest
from pmd_rig import Rig, axis_config, finish, opened, rig, wait_until

from robot_bridge.daemon.motors import MotorError
from robot_bridge.emulator.axis import Motor
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.driver import PmdMotors
from robot_bridge.pmd.ports import SerialPort


def in_motion(motors: PmdMotors, made: Rig, um: int = 15_000) -> None:
    motors.move_to({"xt": um, "yt": um})
    wait_until(motors, lambda s: made.position_um(1) > 400 and made.position_um(2) > 400)


def nothing_moves(made: Rig) -> None:
    with made.lock:
        assert not any(c.moving for c in made.bus.controllers)
    stood_um = (made.position_um(1), made.position_um(2))
    time.sleep(0.03)
    assert (made.position_um(1), made.position_um(2)) == stood_um


def settled(motors: PmdMotors) -> None:
    """Let the confirmation of a stop come through."""
    for _ in range(10):
        motors.poll()
        time.sleep(0.002)


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
@pytest.mark.parametrize(
    ("fault", "code", "named"),
    [
        ("overheat", "overheat", "overheating"),
        ("supply_lost", "voltage", "48 V reads 31.4 V"),
        ("encoder_error", "controller_error", "encoder error"),
    ],
)
def test_a_controller_that_reports_an_error_ends_the_motion_of_all(
    drive: str, fault: str, code: str, named: str
):
    with rig(speed_factor=2.0) as made, opened(made, drive) as motors:
        in_motion(motors, made)
        with made.lock:
            setattr(made.controller(1).faults, fault, True)
        status = finish(motors)
        assert status.fault == code
        assert named in status.fault_text
        assert "axis xt (controller 1)" in status.fault_text
        assert not status.reached
        settled(motors)
        nothing_moves(made)


def test_a_lasting_fault_refuses_the_next_move_and_a_gone_one_does_not():
    with rig() as made, opened(made, "closed_loop") as motors:
        with made.lock:
            made.controller(1).faults.overheat = True
        wait_until(motors, lambda s: s.fault == "overheat")
        with pytest.raises(MotorError) as caught:
            motors.move_to({"xt": 100})
        assert caught.value.code == "overheat"
        with made.lock:
            made.controller(1).faults.overheat = False
        wait_until(motors, lambda s: s.fault is None)
        motors.move_to({"xt": 100})
        assert finish(motors).reached


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_a_power_cycle_in_motion_makes_the_position_uncertain(drive: str):
    with rig(speed_factor=2.0) as made, opened(made, drive) as motors:
        in_motion(motors, made)
        with made.lock:
            made.controller(2).power_on(time.monotonic())
        status = finish(motors)
        assert status.fault == "controller_reset"
        assert not status.certain
        settled(motors)
        nothing_moves(made)
        assert not motors.poll().certain
        motors.stop()
        assert not motors.poll().certain  # only a declaration or homing makes it certain


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_a_power_cycle_at_rest_is_noticed(drive: str):
    with rig() as made, opened(made, drive) as motors:
        motors.move_to({"xt": 500, "yt": 500})
        finish(motors)
        with made.lock:
            made.controller(1).power_on(time.monotonic())
        status = wait_until(motors, lambda s: s.fault is not None)
        assert status.fault == "controller_reset"
        assert not status.certain


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("flash", ["factory", "another robot's"])
def test_after_a_power_cycle_nothing_moves_until_all_settings_are_back(drive: str, flash: str):
    """Y3 to Y14 and Y44 come back from flash, whatever that holds; a move goes as far as asked."""
    with rig() as made, opened(made, drive, response_delay_us=100) as motors:
        motors.move_to({"xt": 500, "yt": 0})
        finish(motors)
        ours = dict(made.controller(1).settings.memory)
        with made.lock:
            if flash != "factory":
                made.controller(1).settings.flash |= {3: -5, 4: 5, 5: 900, 11: 7, 13: 0}
            made.controller(1).power_on(time.monotonic(), deaf_s=0.3)
        wait_until(motors, lambda s: s.fault is not None)
        with pytest.raises(MotorError):
            motors.move_to({"xt": 600, "yt": 0})
        status = wait_until(motors, lambda s: s.fault is None)
        assert status.certain_axes == {"yt"}
        numbers = (3, 4, 13, 44) if drive == "open_loop" else (3, 4, 5, 7, 10, 11, 12, 13, 44)
        assert {n: made.controller(1).settings[n] for n in numbers} == {n: ours[n] for n in numbers}
        with pytest.raises(MotorError, match="position_uncertain"):
            motors.move_to({"xt": 600, "yt": 0})
        motors.declare_position({"xt": 500})
        motors.move_to({"xt": 1700, "yt": 0})
        assert finish(motors).reached
        assert made.position_um(1) == pytest.approx(1700, abs=2)
        assert made.position_um(2) == 0


def test_a_power_cycle_is_noticed_even_if_the_telling_answer_is_lost():
    with rig() as made, opened(made, "closed_loop") as motors:
        with made.lock:
            made.controller(1).power_on(time.monotonic())
            # The parked state looks right; only the latched reset bit tells, and it is dropped.
            made.bus.faults.drop_replies = 1
        assert not wait_until(motors, lambda s: s.fault is not None).certain


@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_a_limit_switch_ends_the_motion(drive: str):
    with rig(speed_factor=2.0) as made, opened(made, drive) as motors:
        with made.lock:
            made.controller(1).settings.store(2, 1)
        in_motion(motors, made)
        with made.lock:
            made.controller(1).faults.limit_switch = True
        assert finish(motors).fault == "external_limit"
        settled(motors)
        nothing_moves(made)


@pytest.mark.parametrize("fault", ["stalled", "encoder_frozen"])
def test_an_encoder_that_does_not_follow_is_called_stalled(fault: str):
    with rig(speed_factor=1.0) as made, opened(made, "closed_loop") as motors:
        in_motion(motors, made)
        with made.lock:
            setattr(made.controller(1).faults, fault, True)
        status = finish(motors)
        assert status.fault == "stalled"
        assert not status.certain
        settled(motors)
        nothing_moves(made)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"encoder_reversed": True}, "-200 um by the encoder"),
        ({"um_per_count": 0.05}, "+400 um by the encoder"),
        ({"um_per_count": 0.2}, "+100 um by the encoder"),
    ],
)
def test_an_encoder_that_disagrees_with_the_motor_is_found_in_a_short_run(wrong: dict, told: str):
    """Mounted the wrong way round, or counts_per_mm wrong by two: no long way is believed."""
    with rig(motor=Motor(**wrong)) as made, opened(made, "closed_loop") as motors:
        motors.move_to({"xt": 5000})
        status = finish(motors)
        assert status.fault == "encoder_disagrees"
        assert told in status.fault_text
        assert "xt" not in status.certain_axes
        settled(motors)
        nothing_moves(made)
        assert abs(made.position_um(1)) < 250
        assert made.position_um(2) == 0


def test_a_dead_encoder_is_found_in_the_same_short_run():
    with rig() as made, opened(made, "closed_loop") as motors:
        with made.lock:
            made.controller(1).faults.encoder_frozen = True
        motors.move_to({"xt": 5000})
        status = finish(motors)
        assert status.fault == "encoder_disagrees"
        assert made.position_um(1) < 250


def test_a_setting_that_changed_by_itself_is_found_before_the_next_move():
    with rig() as made, opened(made, "closed_loop") as motors:
        with made.lock:
            made.controller(1).settings.store(4, 2000)  # a limit at 200 um
        motors.move_to({"xt": 1000})
        status = finish(motors)
        assert status.fault == "setting"
        assert "Y4 reads 2000" in status.fault_text
        assert made.position_um(1) == 0
        motors.stop()
        wait_until(motors, lambda s: made.controller(1).settings[4] == 200_004)
        wait_until(motors, lambda s: s.fault is None)
        motors.move_to({"xt": 1000})
        assert finish(motors).reached


def test_a_stage_pushed_at_rest_is_uncertain():
    with rig() as made, opened(made, "closed_loop") as motors:
        motors.move_to({"xt": 400, "yt": 0})
        finish(motors)
        with made.lock:
            made.controller(1).physics.displace(100.0)
        status = wait_until(motors, lambda s: s.fault is not None)
        assert status.fault == "moved_by_itself"
        assert "+100 um" in status.fault_text
        assert not status.certain


def test_a_closed_loop_move_corrects_a_slip_on_the_way():
    with rig(speed_factor=2.0) as made, opened(made, "closed_loop") as motors:
        in_motion(motors, made, 5000)
        with made.lock:
            made.controller(1).physics.displace(-150.0)
        assert finish(motors).reached
        assert made.position_um(1) == pytest.approx(5000, abs=1)


def test_one_wrong_bit_that_makes_a_motion_of_a_status_question_is_stopped_at_once():
    """`U0` and `T0` differ by one bit: the controller would go to zero."""
    switches = Switches(bare_status=False)
    with (
        rig(switches=switches, speed_factor=2.0) as made,
        opened(made, "closed_loop") as motors,
    ):
        motors.move_to({"xt": 5000, "yt": 0})
        finish(motors)
        real = made.bus._with_wrong_bit
        made.bus._with_wrong_bit = lambda line: line.replace(b"U0", b"T0")
        wait_until(motors, lambda s: not motors._other)
        with made.lock:
            made.bus.faults.garble_commands = 3  # both positions are asked first
        status = wait_until(motors, lambda s: s.fault is not None)
        made.bus._with_wrong_bit = real
        assert "damaged on the line" in status.fault_text
        settled(motors)
        nothing_moves(made)
        assert made.position_um(1) > 4500


def test_a_lost_run_command_is_not_sent_again():
    with rig() as made, opened(made) as motors:
        runs, sent = made.runs(), []
        real = made.bus._single

        def lose_runs(address, shown, body, delimiter, now_s):
            if body == "B1":
                sent.append(body)
                return
            real(address, shown, body, delimiter, now_s)

        made.bus._single = lose_runs
        motors.move_to({"xt": 1000})
        status = finish(motors)
        assert status.fault == "run_unconfirmed"
        assert not status.certain
        assert len(sent) == 1
        assert made.runs() == runs


def test_a_lost_answer_to_a_run_that_did_start_is_found_out():
    with rig(speed_factor=1.0) as made, opened(made) as motors:
        real = made.bus._reply

        def lose_run_echoes(shown, answer, delimiter, at_s):
            if answer.text == "B1":
                return
            real(shown, answer, delimiter, at_s)

        made.bus._reply = lose_run_echoes
        motors.move_to({"xt": 1500})
        status = finish(motors)
        assert status.reached
        assert status.certain
        assert made.runs() == 1
        assert made.position_um(1) == pytest.approx(1500, abs=1)


def test_a_dead_controller_is_named_and_the_other_stops():
    with rig(speed_factor=0.5) as made, opened(made) as motors:
        in_motion(motors, made)
        with made.lock:
            made.controller(1).faults.dead = True
        status = finish(motors)
        assert status.fault == "no_answer"
        assert "controller 1 did not answer" in status.fault_text
        settled(motors)
        with made.lock:
            assert not made.controller(2).moving


def test_chatter_of_other_devices_is_ignored():
    with rig() as made, opened(made, "closed_loop") as motors:
        with made.lock:
            made.bus.faults.chatter = [b"hello\r\n", b"X9E:5\r", b"\xff\x00\x80\r", b"X1T\r"]
        motors.move_to({"xt": 800, "yt": -800})
        assert finish(motors).reached
        assert made.position_um(1) == pytest.approx(800, abs=1)


def test_opening_a_port_that_is_not_there_says_which():
    motors = PmdMotors([axis_config("xt", "/dev/does-not-exist", 1)])
    with pytest.raises(MotorError, match="/dev/does-not-exist") as caught:
        motors.open()
    assert caught.value.code == "no_port"
    with pytest.raises(MotorError) as caught:
        motors.stop()
    assert caught.value.code == "stop_unconfirmed"
    motors.close()


def test_a_missing_controller_is_named_at_opening():
    with rig((1,)) as made:
        motors = PmdMotors([axis_config("xt", made.url, 1), axis_config("yt", made.url, 2)])
        with pytest.raises(MotorError, match=r"axis yt.*controller 2") as caught:
            motors.open()
        assert caught.value.code == "no_answer"
        motors.close()


def test_a_line_that_goes_away_ends_the_motion_with_a_fault():
    with rig(speed_factor=1.0) as made, opened(made) as motors:
        in_motion(motors, made)
        with made.lock:
            made.running = False
            made.server.wire.close()
        status = finish(motors)
        assert status.fault in ("port_failed", "no_answer")
        assert not status.certain


class Rough(IdealStage):
    """Every park and unpark shifts the stage by 30 um."""

    def park(self) -> None:
        self.displace(30.0)


def test_a_shift_by_parking_is_told():
    with (
        rig(stage=Rough) as made,
        opened(made, "closed_loop", park_after_move=True) as motors,
    ):
        motors.move_to({"xt": 500, "yt": 0})
        status = finish(motors)
        assert status.readback_um["xt"] == 530
        assert not status.reached
        assert any("parking moved it by +30 um" in warning for warning in status.warnings)


def test_after_a_limit_switch_the_axis_can_leave_it_again():
    with rig(speed_factor=2.0) as made, opened(made, "closed_loop") as motors:
        with made.lock:
            made.controller(1).settings.store(2, 1)
        in_motion(motors, made)
        with made.lock:
            made.controller(1).faults.limit_switch = True
        assert finish(motors).fault == "external_limit"
        settled(motors)
        with made.lock:
            made.controller(1).faults.limit_switch = False
        motors.stop()
        assert motors.poll().certain_axes == {"yt"}  # the travel ends before the switches
        motors.declare_position({"xt": round(made.position_um(1))})
        motors.move_to({"xt": 0, "yt": 0})
        assert finish(motors).reached


def test_parking_and_declaring_are_possible_in_spite_of_a_fault():
    with rig() as made, opened(made) as motors:
        with made.lock:
            made.controller(1).faults.overheat = True
        wait_until(motors, lambda s: s.fault == "overheat")
        motors.park()
        wait_until(motors, lambda s: s.parked)
        assert all(controller.parked for controller in made.bus.controllers)
        motors.declare_position({"xt": 5})
        status = motors.poll()
        assert status.readback_um == {"xt": 5, "yt": 0}
        assert status.certain
        assert made.runs() == 0


def test_a_port_that_comes_back_is_opened_again_and_the_position_is_uncertain(tmp_path):
    link = tmp_path / "controllers"
    with rig() as first:
        link.symlink_to(first.url)
        with opened(first, "closed_loop", controller=str(link)) as motors:
            motors.move_to({"xt": 500, "yt": 0})
            finish(motors)
            first.running = False
            time.sleep(0.05)
            first.server.wire.close()
            status = wait_until(motors, lambda s: s.fault is not None)
            assert not status.certain
            with pytest.raises(MotorError):
                motors.move_to({"xt": 0, "yt": 0})
            with rig() as second:
                link.unlink()
                link.symlink_to(second.url)
                status = wait_until(motors, lambda s: s.fault is None)
                assert not status.certain
                motors.declare_position({"xt": 0, "yt": 0})
                motors.move_to({"xt": 300, "yt": 0})
                assert finish(motors).reached
                assert second.position_um(1) == pytest.approx(300, abs=1)


def test_a_port_that_takes_no_bytes_is_an_error_within_its_bound():
    reader, writer = os.openpty()
    tty.setraw(writer)
    port = SerialPort(os.ttyname(writer), 115200)
    begun_s = time.monotonic()
    with pytest.raises(OSError, match="accepts no more bytes"):
        port.write(b"X" * 200_000)
    assert time.monotonic() - begun_s < 10.0  # its bound is far below; without one it hangs
    port.close()
    os.close(reader)
    os.close(writer)


def test_an_axis_that_should_stay_is_not_commanded():
    """With an approach from below it used to go to and fro; also if it reads a little off."""
    for drive in ("open_loop", "closed_loop"):
        with rig() as made, opened(made, drive, approach_um=230) as motors:
            motors.move_to({"xt": 500, "yt": -300})
            finish(motors)
            with made.lock:
                made.causes.clear()
            motors.move_to({"xt": 900, "yt": -310})
            assert finish(motors).reached
            assert {address for address, _ in made.causes} == {1}
            assert made.position_um(2) == pytest.approx(-300, abs=1)


def test_cables_that_change_places_without_a_drop_out_move_nothing():
    """Both boards have address 1, and the adapters never notice."""
    with rig(motor=Motor(serial_number=1)) as made, opened(made) as motors:
        with made.lock:
            made.controller(1).motor = Motor(serial_number=2)
        motors.move_to({"xt": 1000, "yt": 0})
        status = finish(motors)
        assert status.fault == "wrong_board"
        assert "board 2 answers" in status.fault_text
        nothing_moves(made)
        assert made.position_um(1) == 0
        assert "xt" not in motors.poll().certain_axes


def test_two_boards_that_come_back_under_each_others_names_move_nothing(tmp_path):
    """The serial number says which axis a board drives, not the name of its port."""

    def plug(made: Rig, name: str) -> None:
        link = tmp_path / name
        link.unlink(missing_ok=True)
        link.symlink_to(made.url)

    motor_x, motor_y = (
        Motor("PMD301", serial_number=n, firmware="V20") for n in (3010001, 3010002)
    )
    with rig((1,), motor=motor_x) as x, rig((1,), motor=motor_y) as y:
        plug(x, "one")
        plug(y, "two")
        axes = [
            axis_config(name, str(tmp_path / port), 1, "closed_loop")
            for name, port in (("xt", "one"), ("yt", "two"))
        ]
        motors = PmdMotors(axes, timeout_s=0.5)
        status = motors.open()
        assert any("same address 1" in warning for warning in status.warnings)
        assert motors.poll().boards == {"xt": "3010001", "yt": "3010002"}
        motors.declare_position({"xt": 0, "yt": 0})
        plug(y, "one")
        plug(x, "two")
        motors._lose_port("both unplugged")
        status = wait_until(motors, lambda s: s.fault == "wrong_board")
        assert "were swapped" in status.fault_text
        assert {"3010001", "3010002"} <= set(re.findall(r"board (\d+)", status.fault_text))
        for _ in range(3):
            with pytest.raises(MotorError):
                motors.move_to({"xt": 5000, "yt": 0})
        assert x.runs() == y.runs() == 0
        plug(x, "one")
        plug(y, "two")
        status = wait_until(motors, lambda s: s.fault is None)
        motors.close()
        other = PmdMotors([axis_config("xt", y.url, 1, "closed_loop")], timeout_s=0.5)
        other.know_boards({"xt": "3010001"})
        with pytest.raises(MotorError, match="wrong_board"):
            other.open()
        other.close()
