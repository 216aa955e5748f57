"""The emulated bus beyond the manuals' examples: framing, limits, ramps, flash, faults."""

import itertools
import subprocess
import sys

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st
from test_emulator_vectors import Bench, unparked

from robot_bridge.emulator.axis import Motor
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.status import Status, parse_status


def status(bench: Bench, address: int = 0) -> Status:
    return parse_status(bench.say(f"X{address}U0\r".encode()).decode().split(":")[1].strip())


def test_escape_cancels_a_line_and_nothing_is_answered():
    bench = unparked(Bench((1,)))
    assert bench.say(b"X1J100\x1b\r") == b""
    assert not bench.controllers[0].moving
    assert bench.say(b"X1E\r") == b"X1E:0\r"


def test_an_unfinished_line_is_abandoned_after_300_ms_and_told_as_command_error():
    bench = Bench((1,))
    status(bench, 1)
    assert bench.say(b"X1J1", 0.4) == b""
    assert bench.say(b"00\r") == b""
    assert status(bench, 1) & Status.COMMAND_ERROR
    assert not status(bench, 1) & Status.COMMAND_ERROR


def test_a_line_in_pieces_within_300_ms_is_whole():
    bench = Bench((1,))
    bench.say(b"X1", 0.2)
    bench.say(b"E", 0.2)
    assert bench.say(b"\r") == b"X1E:0\r"


def test_semicolons_run_silently_and_errors_only_show_in_the_status():
    bench = unparked(Bench((1, 2)))
    status(bench, 1)
    status(bench, 2)
    assert bench.say(b"X1Y3,-5;X2Y4,77;X2Q;") == b""
    assert bench.say(b"X1Y3\r") == b"X1Y3:-5\r"
    assert bench.say(b"X2Y4\r") == b"X2Y4:77\r"
    assert not status(bench, 1) & Status.COMMAND_ERROR
    assert status(bench, 2) & Status.COMMAND_ERROR


def test_a_line_without_its_x_is_done_by_nobody_and_shows_in_the_status():
    bench = Bench((2,))
    status(bench, 2)
    before = bench.say(b"X2Y4\r")
    assert bench.say(b"2Y4,0;") == b""
    assert bench.say(b"X2Y4\r") == before
    assert status(bench, 2) & Status.COMMAND_ERROR


def test_a_stop_with_rubbish_behind_it_is_still_a_stop():
    bench = unparked(Bench((1,)))
    bench.say(b"X1J1000,0,100\r")
    assert bench.controllers[0].moving
    assert bench.say(b"X1S?!x\r") == b"X1S?!x\r"
    assert not bench.controllers[0].moving


def test_terminators_by_switch():
    assert Bench((1,)).say(b"X1\n") == b"X1\n"  # an echo carries back what was sent
    assert Bench((1,)).say(b"X1E\n") == b"X1E:0\r"
    assert Bench((1,), Switches(terminator="crlf")).say(b"X1E\r") == b"X1E:0\r\n"
    assert Bench((1,), Switches(terminator="lf")).say(b"X1\r") == b"X1\n"


def test_own_echo_comes_before_the_answer():
    assert Bench((1,), Switches(own_echo=True)).say(b"X1E\r") == b"X1E\rX1E:0\r"


def test_equals_is_a_comma():
    bench = Bench((1,))
    assert bench.say(b"X1Y8=900\r") == b"X1Y8=900\r"
    assert bench.say(b"X1Y8\r") == b"X1Y8:900\r"
    assert bench.say(b"X1H=972\r") == b"X1H=972\r"
    assert bench.say(b"X1H\r") == b"X1H:972\r"


@pytest.mark.parametrize("line", [b"X1Y6,2\r", b"X1Y10,801\r", b"X1Y40,127\r", b"X1Y2,-1\r"])
def test_settings_out_of_range_are_not_executed(line: bytes):
    assert Bench((1,)).say(line) == line.replace(b"\r", b"!\r")


def test_settings_not_saved_are_lost_with_the_supply_and_saved_ones_are_not():
    bench = Bench((1,))
    bench.say(b"X1Y3,-777\r")
    assert bench.say(b"X1Y1\r") == b"X1Y1:1, Flash differ\r"
    bench.say(b"X1Y32\r")
    bench.say(b"X1Y4,888\r")
    bench.say(b"X1Y13,10\r")
    bench.say(b"X1Y32\r")
    bench.controllers[0].power_on(bench.now_s)
    assert bench.say(b"X1Y3\r") == b"X1Y3:-777\r"
    assert bench.say(b"X1Y13\r") == b"X1Y13:0, None\r"  # serial encoders do not survive
    bench.say(b"X1Y1,3\r")
    assert bench.say(b"X1Y3\r") == b"X1Y3:-10000\r"


def test_a_reset_is_deaf_for_two_and_a_half_seconds():
    bench = unparked(Bench((1,)))
    assert bench.say(b"X1Y41\r") == b"X1Y41:0, Reset\r"
    assert bench.say(b"X1E\r", 1.0) == b""
    bench.wait(2.0)
    assert bench.say(b"X1E\r") == b"X1E:0\r"
    assert status(bench, 1) == Status.RESET | Status.PARKED


def test_unparking_takes_80_ms_and_parking_250_ms():
    bench = Bench((1,))
    bench.say(b"X1M2\r", 0.07)
    assert bench.controllers[0].parked
    bench.wait(0.02)
    assert not bench.controllers[0].parked
    bench.say(b"X1M4\r", 0.24)
    assert not bench.controllers[0].parked
    bench.wait(0.02)
    assert bench.controllers[0].parked
    bench.say(b"X1M1\r")
    assert bench.say(b"X1M\r") == b"X1M:1\r"
    bench.say(b"X1M6\r", 0.3)
    assert bench.say(b"X1M\r") == b"X1M:5\r"


def ready_for_targets(motor: Motor | None = None) -> Bench:
    bench = unparked(Bench((1,), motor=motor))
    bench.say(b"X1Y11,5825\r")  # 100 nm a count at 4.5 um a step
    bench.say(b"X1Y3,-100000\r")
    bench.say(b"X1Y4,100000\r")
    status(bench, 1)
    return bench


def test_a_target_is_reached_and_its_time_is_kept():
    bench = ready_for_targets()
    bench.say(b"X1T40000,1500\r", 0.1)
    assert status(bench, 1) == Status.TARGET_MODE | Status.RUNNING
    bench.wait(1.0)
    assert status(bench, 1) == Status.TARGET_MODE | Status.TARGET_REACHED
    assert abs(bench.controllers[0].count - 40_000) <= 1
    answer = bench.say(b"X1Y23\r").decode()
    elapsed_ms, reached = (int(v) for v in answer.split(":")[1].split(","))
    # 4 mm at 6.75 mm/s, and 75 ms each to go from 0 to 1500 Hz and back at 20 Hz/ms.
    assert reached == 1
    assert 593 + 37 <= elapsed_ms <= 593 + 37 + 120
    assert bench.say(b"X1Y8\r") == b"X1Y8:1500\r"  # the speed was written to Y8


def test_the_target_loop_holds_against_a_push_until_told_to_stop():
    bench = ready_for_targets()
    bench.say(b"X1T5000\r", 1.0)
    bench.controllers[0].physics.displace(50.0)
    bench.wait(0.5)
    assert abs(bench.controllers[0].count - 5000) <= 1
    bench.say(b"X1S\r")
    bench.controllers[0].physics.displace(50.0)
    bench.wait(0.5)
    assert abs(bench.controllers[0].count - 5500) <= 1


def test_setting_the_encoder_in_target_mode_moves_the_motor():
    bench = ready_for_targets()
    bench.say(b"X1T1000\r", 1.0)
    bench.say(b"X1E0\r", 1.0)
    assert bench.controllers[0].physics.position_um == pytest.approx(200, abs=0.3)


@pytest.mark.parametrize("refuse", [False, True])
def test_beyond_a_target_limit(refuse: bool):
    switches = Switches(target_beyond_limit="refuse" if refuse else "stop_there")
    bench = unparked(Bench((1,), switches))
    status(bench, 1)
    bench.say(b"X1Y11,5825\r")
    bench.say(b"X1Y4,2000\r")
    answer = bench.say(b"X1T3000\r", 1.0)
    if refuse:
        assert answer == b"X1T3000!\r"
        assert bench.controllers[0].count == 0
    else:
        assert answer == b"X1T3000\r"
        assert 2000 <= bench.controllers[0].count <= 2100
        assert status(bench, 1) & Status.TARGET_LIMIT


def test_a_reversed_encoder_drives_away_until_the_limit():
    bench = ready_for_targets(Motor(encoder_reversed=True))
    bench.say(b"X1Y3,-3000\r")
    bench.say(b"X1T1000\r", 2.0)
    assert bench.controllers[0].count <= -3000
    assert status(bench, 1) & Status.TARGET_LIMIT


def test_the_script_finds_direction_and_gain():
    bench = ready_for_targets(Motor(encoder_reversed=True))
    assert bench.say(b"X1Y25,1\r") == b"X1Y25,1\r"
    assert bench.say(b"X1Y25\r", 0.01) == b"X1Y25:1,1\r"
    bench.wait(0.5)
    assert bench.say(b"X1Y25\r") == b"X1Y25:1,0\r"
    assert bench.say(b"X1Y6\r") == b"X1Y6:1\r"
    gain = int(bench.say(b"X1Y11\r").decode().split(":")[1])
    assert gain == pytest.approx(65536 * 4 / 45, rel=0.01)  # 45 counts a step
    bench.say(b"X1T1000\r", 1.0)
    assert abs(bench.controllers[0].count - 1000) <= 1


def test_the_host_may_own_the_encoder():
    bench = ready_for_targets()
    bench.say(b"X1Y13,0\r")
    bench.say(b"X1T1000,500\r")
    controller = bench.controllers[0]
    for _ in range(100):  # every 10 ms, as the manual suggests
        count = round(controller.physics.position_um / 0.1)
        bench.say(f"X1E{count};".encode(), 0.01)
    assert abs(controller.physics.position_um - 100) < 8  # one loop at 500 Hz is 22 um at most


def test_run_answers_by_switch():
    for switches, forward, back in (
        (Switches(), b"1", b"1"),
        (Switches(run_answer="222"), b"222", b"-222"),
    ):
        bench = unparked(Bench((1,), switches))
        bench.say(b"X1J500,0,100\r")
        assert bench.say(b"X1J\r") == b"X1J:" + forward + b"\r"
        bench.say(b"X1J-500,0,100\r")
        assert bench.say(b"X1J\r") == b"X1J:" + back + b"\r"
        bench.say(b"X1S\r")
        assert bench.say(b"X1J\r") == b"X1J:0\r"


def test_overheat_and_supply_faults_stop_the_motor_and_are_told():
    bench = unparked(Bench((1,)))
    bench.say(b"X1J5000,0,100\r")
    bench.controllers[0].faults.supply_lost = True
    bench.wait(0.01)
    assert not bench.controllers[0].moving
    assert status(bench, 1) & Status.VOLTAGE_ERROR
    assert b"31.4*" in bench.say(b"X1U2\r")
    bench.controllers[0].faults.supply_lost = False
    assert b"47.2*" in bench.say(b"X1U2\r")  # an error was seen since it was last asked
    assert b"47.2," in bench.say(b"X1U2\r")
    bench.controllers[0].faults.overheat = True
    assert bench.say(b"X1J10\r") == b"X1J10!\r"
    assert status(bench, 1) & Status.OVERHEAT


def test_a_limit_switch_counts_only_when_enabled():
    bench = unparked(Bench((1,)))
    bench.controllers[0].faults.limit_switch = True
    bench.say(b"X1J100,0,1000\r", 0.05)
    assert bench.controllers[0].moving
    bench.say(b"X1Y2,1\r", 0.01)
    assert not bench.controllers[0].moving
    assert status(bench, 1) & Status.EXTERNAL_LIMIT
    assert bench.say(b"X1Y22\r").endswith(b",1\r")


def test_overspeed_by_switch():
    slow = Motor(capacitance_nf=2064)
    clamped = unparked(Bench((1,), motor=slow))
    assert clamped.say(b"X1U3\r") == b"X1U3:2064nF,457Hz Delta\r"
    clamped.say(b"X1J457,0,1500\r", 0.98)
    assert clamped.controllers[0].moving
    clamped.wait(0.05)
    assert not clamped.controllers[0].moving
    refused = unparked(Bench((1,), Switches(overspeed="refuse"), slow))
    assert refused.say(b"X1J457,0,1500\r") == b"X1J457,0,1500!\r"


def test_the_position_log():
    bench = unparked(Bench((1,)))
    bench.say(b"X1L-10\r")  # armed until the next motion
    bench.say(b"X1J100,0,100\r", 0.35)
    numbers = bench.say(b"X1L0\r").decode().strip().split(":")[1].split(",")
    count, positions = int(numbers[3]), [int(n) for n in numbers[4:]]
    assert count == len(positions)
    assert 30 <= count <= 36
    steps = [b - a for a, b in itertools.pairwise(positions)]
    assert all(40 <= step <= 50 for step in steps)  # one step of 45 counts every 10 ms


def test_digital_outputs():
    bench = Bench((1,))
    assert bench.say(b"X1D\r") == b"X1D:111,1100\r"  # they are inputs, pulled up
    bench.say(b"X1D0,0\rX1D1,0\rX1D2,0\r")
    assert bench.say(b"X1D\r") == b"X1D:000,1100\r"
    assert bench.say(b"X1D1,1\r") == b"X1D1,1\r"
    assert bench.say(b"X1D\r") == b"X1D:010,1100\r"
    assert bench.say(b"X1U1\r") == b"X1U1:2c\r"
    assert bench.say(b"X1D3,1\r") == b"X1D3,1!\r"


@given(st.binary(max_size=120))
def test_no_bytes_break_the_emulator_and_it_answers_afterwards(data: bytes):
    bench = Bench((1, 2))
    bench.say(data, 0.01)
    bench.wait(0.5)
    for controller in bench.controllers:
        controller.settings.store(40, 5 + bench.controllers.index(controller))
        controller.deaf_until_s = 0.0
    assert bench.say(b"\x1b;X5\r").endswith(b"X5\r")


def test_the_emulator_as_a_process_serves_a_pseudo_terminal(tmp_path):
    link = tmp_path / "pty"
    command = [sys.executable, "-m", "robot_bridge.emulator", "--pty-path", str(link)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert str(link) in process.stdout.readline()
        with serial.Serial(str(link), 115200, timeout=20) as port:
            port.write(b"X1?\r")
            assert port.read_until(b"\r") == b"X1?:PMD401 V13\r"
            port.write(b"X127\r")
            assert port.read_until(b"X2\r") == b"X1\rX2\r"
        process.terminate()
        process.wait(60)
