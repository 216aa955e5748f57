"""The engineer's commands as processes, to a running daemon and directly to the controllers."""

import contextlib
import io
import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from bridge_room import AXES, BridgeRoom, bridge_room, wait_for

from robot_bridge.engineer.main import main
from simulator.stage_physics import PiezoLegsStage, StageParameters


def robot(room: BridgeRoom, *arguments: str, link: bool = True) -> subprocess.CompletedProcess[str]:
    where = ["--link", room.line.far] if link else ["--direct"]
    where = ["--config", str(room.config_file), *where, "--by", "engineer", "--json", *arguments]
    if link:
        return in_this_process(where)
    command = [sys.executable, "-m", "robot_bridge.engineer.main", *where]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def in_this_process(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    """The same `main`, without the second that a new interpreter takes."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def fields(ended: subprocess.CompletedProcess[str]) -> dict:
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_declare_then_jog_moves_one_axis_by_the_asked_distance(shared_room: BridgeRoom):
    room = shared_room
    declared = fields(robot(room, "declare", *[f"{axis}=0" for axis in AXES]))
    assert declared["position_certain"]
    assert fields(robot(room, "--yes", "jog", "xt", "-1.25"))["state"] == "DONE"
    truth = room.controllers.positions_um()
    assert truth["xt"] == pytest.approx(-1250, abs=20)
    assert truth["yt"] == pytest.approx(0, abs=20)
    assert fields(robot(room, "status"))["armed"] is False


def test_a_direct_jog_needs_no_daemon_and_keeps_the_journal(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        at = ["--at", "xt=0", "--yes"]
        assert fields(robot(room, *at, "jog", "xt", "2", link=False))["state"] == "DONE"
        assert room.controllers.positions_um()["xt"] == pytest.approx(2000, abs=20)
        journal = (tmp_path / "state" / "bridge_journal.jsonl").read_text()
        assert "engineer-jog" in journal
        assert fields(robot(room, "stop", link=False)) == {"stopped": True}


def test_jog_keeps_the_bridges_checks(shared_room: BridgeRoom):
    room = shared_room
    before_um = room.controllers.positions_um()
    robot(room, "declare", "xt=14.5", "yt=0", "xb=0", "yb=0")
    beyond = robot(room, "--yes", "jog", "xt", "1")
    assert beyond.returncode == 3
    assert "beyond_travel" in beyond.stderr
    for bad in (
        ["jog", "xt", "nan"],
        ["jog", "xt", "6"],
        ["jog", "zz", "1"],
        ["jog", "xt", "1"],
    ):
        ended = robot(room, *bad)  # the last one lacks --yes
        assert ended.returncode == 2, ended
        assert ended.stderr.count("\n") == 1
    assert room.controllers.positions_um() == before_um


def test_a_jog_from_an_uncertain_position_is_refused(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        room.start_daemon()
        uncertain = robot(room, "--yes", "jog", "xt", "1")
        assert uncertain.returncode == 3
        assert "position_uncertain" in uncertain.stderr
        report = ["--config", str(room.config_file), "--json", "status"]
        assert fields(in_this_process(report))["positions_um"] == dict.fromkeys(AXES, "unknown")


def test_stop_latches_and_rearm_clears_it(shared_room: BridgeRoom):
    room = shared_room
    stopped = fields(robot(room, "stop"))
    assert stopped["stopped"] is True
    once_more = fields(robot(room, "stop"))
    assert once_more["stop_count"] == stopped["stop_count"] + 1, "one command, one stop"
    refused = robot(room, "--yes", "jog", "xt", "1")
    assert refused.returncode == 3
    assert "stop_latched" in refused.stderr
    cleared = fields(robot(room, "--yes", "rearm"))
    assert cleared["stopped"] is False
    again = robot(room, "--yes", "rearm")
    assert again.returncode == 3
    assert "not_stopped" in again.stderr


def stage_with_stops() -> PiezoLegsStage:
    parameters = StageParameters(
        travel_um=(-2100.0, 2100.0), has_encoder=True, scatter=0.0, repeatability_um=0.0
    )
    return PiezoLegsStage(parameters, 500.0, random.Random(5))


def test_homing_finds_the_hard_stops_and_makes_the_position_certain(tmp_path: Path):
    with bridge_room(tmp_path, travel_mm=2.0, make_stage=stage_with_stops) as room:
        room.start_daemon()
        ended = fields(robot(room, "--yes", "home"))
        assert ended["state"] == "DONE"
        assert ended["readback_um"] == pytest.approx(dict.fromkeys(AXES, -2000), abs=20)
        truth_um = room.controllers.positions_um()
        assert truth_um == pytest.approx(dict.fromkeys(AXES, -2100), abs=20)
        assert fields(robot(room, "status"))["position_certain"]
        assert fields(robot(room, "--yes", "jog", "yt", "1"))["state"] == "DONE"
        assert room.controllers.positions_um()["yt"] == pytest.approx(-1100, abs=20)


def test_calibrate_steps_finds_the_step_length_of_the_stage(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        ended = robot(room, "--yes", "calibrate-steps", "yb", "--runs", "2", link=False)
        measured = fields(ended)
        assert measured["step_um_forward"] == pytest.approx(4.5, abs=0.05)
        assert measured["step_um_reverse"] == pytest.approx(4.5, abs=0.05)


def test_direct_commands_are_refused_while_the_daemon_runs(shared_room: BridgeRoom):
    room = shared_room
    room.ready_client()
    for arguments in (["status"], ["--yes", "calibrate-steps", "xt"]):
        ended = robot(room, *arguments, link=False)
        assert ended.returncode == 3
        assert "another bridge is using it" in ended.stderr
        assert "Traceback" not in ended.stderr


def test_capture_writes_the_bytes_of_both_directions(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        file = tmp_path / "capture.jsonl"
        command = [sys.executable, "-m", "robot_bridge.engineer.main", "--config"]
        command += [str(room.config_file), "--direct", "capture", str(file), "--seconds", "1"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert ended.returncode == 0, ended.stderr
        directions = {json.loads(line)[1] for line in file.read_text().splitlines()}
        assert directions == {"tx", "rx"}


def test_status_reads_the_daemons_own_report_without_a_session(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    wait_for(lambda: client.pump(0.05) or room.status_file()["armed"], 60, "the report")
    command = [sys.executable, "-m", "robot_bridge.engineer.main", "--config"]
    command += [str(room.config_file), "--json", "status"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert json.loads(ended.stdout)["pid"] == room.daemons[0].pid
    client.pump(0.1)  # our session still stands


def test_without_a_bridge_the_error_is_one_line_and_exit_3(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        ended = robot(room, "--timeout", "1", "status")
        assert ended.returncode == 3
        assert "no answer from a bridge" in ended.stderr
        assert ended.stderr.count("\n") == 1


def test_stop_gets_through_while_another_program_has_the_line(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    ended = robot(room, "--timeout", "0.5", "stop")
    assert ended.returncode == 3
    assert "STOP was sent" in ended.stderr
    client.pump(0.3)  # the other program's session still stands, and sees the stop
    assert client.status.stopped
    other = robot(room, "--timeout", "0.5", "status")
    assert other.returncode == 3
    assert "cannot be opened" in other.stderr
