"""The emulator by the book: every exchange that the manual prints or describes, and its grammar.

References are sections of the PMD401 manual (150025-01). The property test says what every line
whatsoever is answered with; the table says what the manual's own examples are answered with.
"""

import json
import re
import signal
import socket
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_emulator_vectors import Bench, unparked

from robot_bridge.emulator.axis import Motor
from robot_bridge.pmd.status import Status, parse_status

WIDE = b"X1Y3,-1000000;X1Y4,1000000;"


def ready(index_um: float | None = None, **motor: object) -> Bench:
    bench = unparked(Bench((1,), motor=Motor(index_um=index_um, **motor)))
    bench.say(WIDE)
    return bench


def conversation(bench: Bench, *lines: tuple[bytes, bytes] | tuple[bytes, bytes, float]) -> None:
    for sent, answered, *wait_s in lines:
        assert bench.say(sent, *wait_s) == answered, sent


def test_a_stored_command_is_told_with_its_b_and_can_be_cleared():  # 4.8
    conversation(
        Bench((1,)),
        (b"X1T100b\r", b"X1T100b\r"),
        (b"X1B\r", b"X1B:T100b\r"),
        (b"X1B0\r", b"X1B0\r"),
        (b"X1B\r", b"X1B:\r"),
    )


def test_stored_commands_start_together_and_silently():  # 4.8
    bench = unparked(Bench((1, 2)))
    bench.say(WIDE + b"X2Y3,-1000000;X2Y4,1000000;X1T100b\rX2T200b\r")
    assert bench.say(b"X127B1\r", 1.0) == b""
    assert bench.say(b"X1T\r") == b"X1T:100\r"
    assert bench.say(b"X2T\r") == b"X2T:200\r"


def test_the_index_stops_and_does_not_reset_in_mode_2():  # 4.5
    bench = ready(index_um=50.0)
    conversation(
        bench,
        (b"X1N2\r", b"X1N2\r"),
        (b"X1I100,0,400\r", b"X1I100,0,400\r", 1.0),
        (b"X1N\r", b"X1N:2,500.\r"),
        (b"X1N?\r", b"X1N?:2,500, stopI\r"),
        (b"X1E\r", b"X1E:504\r"),
        (b"X1I10\r", b"X1I10!\r"),  # only while not found yet
        (b"X1N2\r", b"X1N2\r"),
        (b"X1I10\r", b"X1I10\r"),
    )


def test_the_index_resets_the_position_in_mode_4_and_y14_moves_it_afterwards():  # 4.5
    bench = ready(index_um=50.0)
    conversation(
        bench,
        (b"X1N4\r", b"X1N4\r"),
        (b"X1I100,0,400\r", b"X1I100,0,400\r", 1.0),
        (b"X1U0\r", b"X1U0:0900\r"),
        (b"X1N?\r", b"X1N?:1,500., indexed\r"),
        (b"X1E\r", b"X1E:4\r"),  # what it went on before it stood
        (b"X1Y14,1000\r", b"X1Y14,1000\r"),
        (b"X1E\r", b"X1E:1004\r"),
        (b"X1E500\r", b"X1E500\r"),
        (b"X1Y14\r", b"X1Y14:0\r"),
        (b"X1N\r", b"X1N:0,500\r"),
        (b"X1E\r", b"X1E:500\r"),
    )


def test_the_script_finds_direction_and_gain_and_can_be_stopped():  # 4.2.2
    bench = ready(encoder_reversed=True)
    conversation(bench, (b"X1Y25,1\r", b"X1Y25,1\r", 0.05), (b"X1Y25\r", b"X1Y25:1,1\r", 1.0))
    assert bench.say(b"X1Y25\r") == b"X1Y25:1,0\r"
    assert bench.say(b"X1Y6\r") == b"X1Y6:1\r"
    bench.say(b"X1Y25,1\r", 0.05)
    conversation(bench, (b"X1Y25,0\r", b"X1Y25,0\r"), (b"X1J\r", b"X1J:0\r"))


def test_reloading_brings_back_less_than_a_power_on():  # 4.2.2, Y1
    bench = Bench((1,))
    bench.say(b"X1Y14,77;X1Y44,99;X1Y2,1;X1Y13,0;X1Y5,9;X1Y12,3;X1Y38,5;")
    conversation(
        bench,
        (b"X1Y1\r", b"X1Y1:1, Flash differ\r"),
        (b"X1Y1,2\r", b"X1Y1,2\r"),
        (b"X1Y1\r", b"X1Y1:0, Flash equal\r"),
        (b"X1Y14\r", b"X1Y14:77\r"),
        (b"X1Y44\r", b"X1Y44:99\r"),
        (b"X1Y2\r", b"X1Y2:1\r"),
        (b"X1Y13\r", b"X1Y13:0, None\r"),
        (b"X1Y5\r", b"X1Y5:1\r"),
        (b"X1Y38\r", b"X1Y38:2047\r"),
    )
    bench.controllers[0].power_on(bench.now_s)
    conversation(bench, (b"X1Y14\r", b"X1Y14:0\r"), (b"X1Y44\r", b"X1Y44:20\r"))


def test_a_question_mark_adds_a_description():  # 4.2.2
    bench = Bench((1,))
    assert re.fullmatch(rb"X1Y11\?:250, [\w ]+\r", bench.say(b"X1Y11?\r"))
    assert bench.say(b"X1Y13?\r") == b"X1Y13?:1, Quad_32\r"


def test_parked_in_target_mode_is_not_running():  # 4.2.3
    bench = ready()
    bench.say(b"X1T500000\r", 0.05)
    assert parse_status(bench.say(b"X1U0\r")[5:9].decode()) & Status.RUNNING
    bench.say(b"X1M4\r", 0.5)
    status = parse_status(bench.say(b"X1U0\r")[5:9].decode())
    assert status & Status.PARKED
    assert not status & Status.RUNNING


@pytest.mark.parametrize("wiring", [1, 2])
def test_limit_switches_have_a_direction_and_can_be_left(wiring: int):  # 3.4, 4.2.2
    bench = ready(switches_um=(-300.0, 300.0))
    bench.say(f"X1Y2,{wiring}\r".encode())
    off, reverse, forward = {1: ("8", "a", "c"), 2: ("e", "c", "a")}[wiring]
    assert bench.say(b"X1U1\r").decode()[-2] == off
    bench.say(b"X1J1000,0,1000\r", 1.0)
    assert parse_status(bench.say(b"X1U0\r")[5:9].decode()) & Status.EXTERNAL_LIMIT
    assert bench.say(b"X1U1\r").decode()[-2] == forward
    assert bench.controllers[0].physics.position_um == pytest.approx(300, abs=6)
    bench.say(b"X1J10,0,1000\r", 0.5)  # further on: it does not go
    assert bench.controllers[0].physics.position_um == pytest.approx(300, abs=6)
    bench.say(b"X1S\rX1J-20,0,1000\r", 0.5)
    assert bench.controllers[0].physics.position_um == pytest.approx(210, abs=6)
    bench.say(b"X1J-1000,0,1000\r", 1.0)
    assert bench.say(b"X1U1\r").decode()[-2] == reverse


def test_outputs_read_high_until_they_are_set():  # 3.4
    assert Bench((1,)).say(b"X1D\r") == b"X1D:111,1100\r"
    assert Bench((1,), motor=Motor("PMD301")).say(b"X1D\r") == b"X1D:011,1100\r"


# --- the grammar ------------------------------------------------------------------------------

NUMBER = st.integers(-(10**6), 10**6).map(str)
BODY = st.one_of(
    st.just(""),
    st.sampled_from("?UMTRCEJHINBDLSYQWZ").flatmap(
        lambda letter: st.lists(NUMBER, max_size=3).map(lambda n: letter + ",".join(n))
    ),
    st.builds("Y{},{}".format, st.integers(0, 60), st.integers(-5, 70_000)),
    st.builds("Y{}".format, st.integers(0, 60)),
    st.builds("{}b".format, st.sampled_from(["T100", "J1,0,5", "E", "S"])),
    st.sampled_from(["N?", "Y11?", "Y13?", "B1", "B0", "B", "S garbage", "Y3=5", "H=900", "U4"]),
)
RENAMES = re.compile(r"Y40[,=]")
REBOOTS = re.compile(r"Y41$")


@settings(max_examples=400, deadline=None)
@given(st.lists(BODY, min_size=1, max_size=6))
def test_every_line_is_answered_by_its_echo_a_value_a_refusal_or_not_at_all(bodies: list[str]):
    """Manual 4.2. Address and body come back as sent; `;` and address 127 are silent; what
    is not understood is `_??_`, what cannot be done ends in `!`; a parked motor never moves.
    """
    bench = Bench((1, 7))
    for body in bodies:
        if RENAMES.match(body) or REBOOTS.match(body):
            continue
        before_um = bench.controllers[0].physics.position_um
        parked = bench.controllers[0].parked and not bench.controllers[0].busy
        answer = bench.say(f"X1{body}\r".encode(), 0.2).decode()
        shown = re.escape(body)
        known = rf"X1({shown}(!|:!|:[\x20-\x7e]*)?|_\?\?_{shown})\r"
        assert re.fullmatch(known, answer), (body, answer)
        if parked:
            assert bench.controllers[0].physics.position_um == before_um
        bench.controllers[0].stop()
        assert bench.say(f"X1{body};".encode(), 0.2) == b""
        bench.controllers[0].stop()
        if body:
            assert bench.say(f"X127{body}\r".encode(), 0.2) == b""
        assert bench.say(b"X9" + body.encode() + b"\r", 0.05) == b""
        bench.controllers[0].stop()


# --- as a program -----------------------------------------------------------------------------


def test_faults_switches_and_the_truth_by_a_command_while_it_runs(tmp_path):
    link = tmp_path / "pty"
    emulator = [sys.executable, "-m", "service.cli.main", "emulator"]
    command = [*emulator, "serve", "--addresses", "3", "--pty-path", str(link)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        port = str(told["control_port"])
        assert told["url"] == str(link)

        def tell(*words: str) -> tuple[int, dict]:
            done = subprocess.run(
                [*emulator, "tell", "--control-port", port, *words], capture_output=True, text=True
            )
            return done.returncode, json.loads(done.stdout)

        assert tell("where")[1]["positions_mm"] == {"3": 0.0}
        assert tell("push", "3", "1.5") == (0, {"ok": True})
        with socket.create_connection(("127.0.0.1", int(port))) as line:
            file = line.makefile("rw")
            for request, fine in (
                ("fault 3 overheat on", True),
                ("switch hex_case upper", True),
                ("line drop_replies 1", True),
                ("power-cycle 3", True),
                ("fault 3 nonsense on", False),
                ("fault 9 overheat on", False),
                ("switch hex_case purple", False),
                ("line drop_probability nan", False),
                ("push 3", False),
                ("what", False),
            ):
                file.write(request + "\n")
                file.flush()
                assert ("error" in json.loads(file.readline())) is not fine, request
        assert tell("where")[1]["positions_mm"] == {"3": 1.5}
        assert tell("fault", "3", "x", "on")[0] == 2
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    assert not link.is_symlink()
