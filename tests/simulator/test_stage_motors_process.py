"""`python -m simulator.motors` as a real process: serial bytes in, truth out, restart."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.daemon.motors import MotorStatus
from robot_bridge.pmd.driver import PmdMotors


class Room:
    """The process, and a client of its truth port."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.pty, self.state = folder / "motors", folder / "true_positions.json"
        command = [sys.executable, "-m", "simulator.motors", "--pty-path", str(self.pty)]
        command += ["--state", str(self.state), "--seed", "3", "--speed-factor", "20", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.ready = json.loads(self.process.stdout.readline())

    def ask(self, request: str) -> dict:
        with socket.create_connection(("127.0.0.1", self.ready["truth_port"]), 5) as client:
            client.sendall(request.encode() + b"\n")
            with client.makefile("r") as answers:
                return json.loads(answers.readline())

    def kill(self, signal_number: int = signal.SIGTERM) -> int:
        self.process.send_signal(signal_number)
        code = self.process.wait(5)
        if self.process.stdout is not None:
            self.process.stdout.close()
        return code


@pytest.fixture
def folder(tmp_path: Path):
    return tmp_path


@contextlib.contextmanager
def room(folder: Path, *options: str):
    made = Room(folder, *options)
    try:
        yield made
    finally:
        if made.process.poll() is None:
            made.kill()


@contextlib.contextmanager
def driver(made: Room, drive: str = "open_loop"):
    axes = [
        AxisConfig(
            name=name,
            controller=made.ready["pty"],
            address=address,
            drive=drive,
            travel_min_um=-20_000,
            travel_max_um=20_000,
            sign=1,
            speed_hz=1000,
            tolerance_um=20,
            step_um_forward=4.5,
            step_um_reverse=4.5,
            approach_um=0,
            counts_per_mm=10_000.0,
            tolerance_counts=2,
            encoder_type=1,
            home_um=None,
        )
        for address, name in enumerate(("xt", "yt"), 1)
    ]
    motors = PmdMotors(axes)
    try:
        motors.open()
        motors.declare_position({"xt": 0, "yt": 0})
        yield motors
    finally:
        motors.close()


def finish(motors: PmdMotors) -> MotorStatus:
    deadline_s = time.monotonic() + 60
    while (status := motors.poll()).moving:
        assert time.monotonic() < deadline_s
        time.sleep(0.002)
    return status


def test_the_truth_follows_an_open_loop_move_within_the_scatter_of_the_motor(folder: Path):
    with room(folder) as made, driver(made) as motors:
        before = made.ask("where")
        assert before["positions_mm"] == {"xt": 0.0, "yt": 0.0}
        assert (before["moves"], before["moving"]) == (0, False)
        motors.move_to({"xt": 5000, "yt": -5000})
        assert finish(motors).reached
        after = made.ask("where")
        assert after["moves"] == 2
        # 4.5 um nominal, less 2.5 % load, 3 % asymmetry, 1 % scatter, 14 um repeatability.
        assert 4.6 < after["positions_mm"]["xt"] < 5.3
        assert -5.3 < after["positions_mm"]["yt"] < -4.6
        assert after["positions_mm"]["xt"] != 5.0


def test_an_encoder_brings_the_stage_where_it_was_sent(folder: Path):
    with (
        room(folder, "--encoder-um-per-count", "0.1") as made,
        driver(made, "closed_loop") as motors,
    ):
        motors.move_to({"xt": 5000, "yt": -5000})
        assert finish(motors).reached
        truth_mm = made.ask("where")["positions_mm"]
        assert truth_mm["xt"] == pytest.approx(5.0, abs=0.002)
        assert truth_mm["yt"] == pytest.approx(-5.0, abs=0.002)


def test_a_motor_mounted_the_other_way_round_moves_the_axis_the_other_way(folder: Path):
    with room(folder, "--reversed", "xt") as made, driver(made) as motors:
        motors.move_to({"xt": 2000, "yt": 2000})
        finish(motors)
        truth_mm = made.ask("where")["positions_mm"]
        assert -2.2 < truth_mm["xt"] < -1.8
        assert 1.8 < truth_mm["yt"] < 2.2


def test_history_tells_motion_from_rest(folder: Path):
    with room(folder) as made, driver(made) as motors:
        begun_s = time.time()
        motors.move_to({"xt": 2000})
        finish(motors)
        time.sleep(0.1)
        during = made.ask(f"history {begun_s} {time.time()}")
        assert during["moved"]
        assert during["known"]
        track_mm = [positions["xt"] for _, positions in during["samples"]]
        assert track_mm == sorted(track_mm)
        assert during["start_mm"]["xt"] == 0.0
        assert track_mm[-1] == made.ask("where")["positions_mm"]["xt"]
        rested_s = time.time()
        time.sleep(0.1)
        rest = made.ask(f"history {rested_s} {time.time()}")
        assert not rest["moved"]
        assert rest["start_mm"]["xt"] == track_mm[-1]


def test_motions_list_every_motion_with_its_cause(folder: Path):
    with room(folder) as made, driver(made) as motors:
        motors.move_to({"xt": 1000})
        finish(motors)
        made.ask("slip yt 0.25")
        motions = made.ask("motions")["motions"]
        runs = [m for m in motions if m["cause"] == "run"]
        assert [(m["axis"], m["from_mm"] < 0.01, m["to_mm"] > 0.9) for m in runs] == [
            ("xt", True, True)
        ]
        slips = [m for m in motions if m["cause"] == "unprompted"]
        assert [(m["axis"], m["to_mm"] - m["from_mm"]) for m in slips] == [("yt", 0.25)]
        assert {m["cause"] for m in motions} == {"run", "unpark", "unprompted"}


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_restart_stands_where_it_stood_even_when_killed_in_motion(folder: Path, how: int):
    with room(folder, "--speed-factor", "1") as made, driver(made) as motors:
        motors.move_to({"xt": 15_000})
        until_s = time.monotonic() + 0.3
        while time.monotonic() < until_s:
            motors.poll()
        stood_mm = made.ask("where")["positions_mm"]["xt"]
        assert stood_mm > 0.2
        made.kill(how)
    last_mm = json.loads(made.state.read_text())["positions_mm"]["xt"]
    assert stood_mm <= last_mm < stood_mm + 0.5
    with room(folder) as again:
        assert again.ask("where")["positions_mm"]["xt"] == last_mm
        assert again.ask("where")["moving"] is False


def test_it_ends_with_its_parent_when_asked(folder: Path):
    script = (
        "import subprocess, sys, time\n"
        "p = subprocess.Popen([sys.executable, '-m', 'simulator.motors', '--pty-path',"
        " sys.argv[1], '--state', sys.argv[2], '--exit-with-parent'])\n"
        "print(p.pid, flush=True)\n"
        "time.sleep(1.5)\n"
    )
    parent = subprocess.run(
        [sys.executable, "-c", script, str(folder / "pty"), str(folder / "state.json")],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    pid = int(parent.stdout.splitlines()[0])
    deadline_s = time.monotonic() + 60
    while Path(f"/proc/{pid}/stat").exists() and time.monotonic() < deadline_s:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        if state == "Z":
            break
        time.sleep(0.05)
    else:
        assert not Path(f"/proc/{pid}").exists()
    assert not os.path.lexists(folder / "pty")


def test_requests_that_make_no_sense_get_an_error_and_the_process_lives_on(folder: Path):
    with room(folder) as made:
        for request in (
            "nonsense",
            "history 1",
            "history a b",
            "fault zt overheat on",
            "fault xt nonsense on",
            "line nonsense 1",
            "slip xt x",
            "where now",
        ):
            assert "error" in made.ask(request), request
        assert "positions_mm" in made.ask("where")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--axes", "xt,xt"], "--axes"),
        (["--reversed", "zt"], "--reversed"),
        (["--scatter", "nan"], "scatter"),
        (["--speed-factor", "0"], "--speed-factor"),
        (["--encoder-um-per-count", "nan"], "--encoder-um-per-count"),
        (["--pty-path", "/nonexistent/x"], "/nonexistent"),
    ],
)
def test_bad_options_end_in_one_line_and_code_two(folder: Path, options: list[str], named: str):
    command = [sys.executable, "-m", "simulator.motors", "--pty-path", str(folder / "pty")]
    command += ["--state", str(folder / "state.json"), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert named in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "text", ["{}", "", '{"positions_mm": {"xt": 1}}', '{"positions_mm": {"xt": NaN, "yt": 0}}']
)
def test_a_damaged_state_file_is_refused_by_name(folder: Path, text: str):
    (folder / "state.json").write_text(text)
    command = [sys.executable, "-m", "simulator.motors", "--pty-path", str(folder / "pty")]
    command += ["--state", str(folder / "state.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "state.json" in done.stderr
