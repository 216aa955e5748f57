"""The engineer's day at a bench, by the commands of docs/bring_up.md, on one, two and four axes.

Real processes for the emulator, real pseudo-terminals; no room, no link, no daemon.
"""

import contextlib
import os
import tomllib
from pathlib import Path

import pytest
from bench_rig import bench

from robot_bridge.daemon.journal import Journal
from robot_bridge.engineer.main import main
from robot_bridge.pmd.ports import SerialPort


@pytest.mark.parametrize(
    "drives",
    [
        {"xt": "closed_loop"},
        {"xt": "open_loop", "yt": "open_loop"},
        dict.fromkeys(("xt", "yt", "xb", "yb"), "closed_loop"),
    ],
    ids=["one", "two", "four"],
)
def test_the_first_day_of_a_bench(tmp_path: Path, drives: dict[str, str]):
    names = list(drives)
    addresses = ",".join(str(n) for n in range(1, len(names) + 1))
    with bench(tmp_path, addresses) as room:
        boards = room.robot("scan", room.port)[1]["boards"]
        assert [board["address"] for board in boards] == list(range(1, len(names) + 1))
        assert boards[0]["serial_number"] == "4010001"
        room.write_file(drives)
        status = room.direct("status")
        assert status["positions_um"] == dict.fromkeys(names, "unknown")
        assert not status["position_certain"]
        assert "home or declare it" in room.refused("jog", "xt", "0.2")
        if drives["xt"] == "closed_loop":
            found = room.direct("find-encoder", "xt")
            assert found["encoder_direction"] == 0
            assert found["counts_per_mm_if_steps_are_right"] == pytest.approx(10_000, rel=0.02)
            assert found["for_the_file"] == ["encoder_direction = 0"]
            measured = room.direct("calibrate-steps", "xt", "--runs", "2")
            lines = tomllib.loads("\n".join(measured["for_the_file"]))
            both = ("step_um_forward", "step_um_reverse")
            assert lines == pytest.approx(dict.fromkeys(both, 4.5), rel=0.01)
        room.tell("push 1 0.5")
        jogged = room.direct("--at", "xt=0", "jog", "xt", "0.2")
        assert jogged["state"] == "DONE"
        assert isinstance(jogged["readback_um"].pop("xt"), int)
        assert set(jogged["readback_um"].values()) <= {"unknown"}
        truth_mm = room.truth_mm()
        assert truth_mm["1"] == pytest.approx(0.7, abs=0.02)
        assert all(truth_mm[a] == 0 for a in truth_mm if a != "1")
        home = room.direct("home", "xt")
        assert home["state"] == "DONE"
        assert room.truth_mm()["1"] == pytest.approx(-19.5, abs=0.05)
        assert room.direct("drives", "on") == {"parked": False}
        assert room.direct("drives", "off") == {"parked": True}
        assert room.direct("stop") == {"stopped": True}


def test_boards_get_their_addresses_one_by_one(tmp_path: Path):
    with bench(tmp_path, "0,5") as room:
        scanned = room.robot("scan", room.port)[1]
        assert [board["address"] for board in scanned["boards"]] == [0, 5]
        assert "factory" in scanned["hint"]
        assert "already" in room.robot("set-address", room.port, "0", "5")[2]
        assert room.robot("set-address", room.port, "0", "1")[1]["address"] == 1
        room.tell("power-cycle 1")
        boards = room.robot("scan", room.port)[1]["boards"]
        assert [board["address"] for board in boards] == [1, 5]
        assert room.robot("set-address", room.port, "9", "3")[0] == 3


def test_people_are_told_without_brackets_and_quotes(tmp_path: Path, capsys):
    with bench(tmp_path, "0,5") as room:
        assert main(["scan", room.port]) == 0
        said = capsys.readouterr().out.splitlines()
        assert said[0] == f"{'boards':20} address 0, identity PMD401 V13, serial_number 4010001"
        assert said[1].strip() == "address 5, identity PMD401 V13, serial_number 4010002"
        room.write_file({"xt": "open_loop"})
        file = tmp_path / "bench.toml"
        file.write_text(file.read_text().replace("address = 1", "address = 5"))
        assert main(["--config", str(file), "--direct", "status"]) == 0
        said = capsys.readouterr().out
        assert "positions_um         xt unknown\n" in said
        assert "xt (volts_48 47.2, board_celsius 41)\n" in said
        assert "armed                no\n" in said
        assert not set("[]{}'") & set(said)


def test_a_port_where_nobody_answers_or_that_is_not_there(tmp_path: Path):
    master, slave = os.openpty()
    try:
        code = main(["scan", os.ttyname(slave)])
    finally:
        os.close(master)
        os.close(slave)
    assert code == 3
    assert main(["scan", str(tmp_path / "nothing")]) == 3
    assert main(["status"]) == 2  # no --config


def test_an_emergency_at_the_controllers_parks_and_latches(tmp_path: Path):
    with bench(tmp_path, "1") as room:
        room.write_file({"xt": "closed_loop"})
        assert room.direct("drives", "on") == {"parked": False}
        done = room.direct("stop", "--emergency")
        assert done == {"stopped": True, "parked": True, "latched": True}
        assert room.tell("where")["parked"] == {"1": True}
        assert "stop_latched" in room.refused("--at", "xt=0", "jog", "xt", "0.1")
        assert "stop_latched" in room.refused("drives", "on")
        room.direct("rearm")
        journal = Journal(tmp_path / "state")  # as a running bridge has it
        try:
            assert "NOT latched" in room.refused("stop", "--emergency")
        finally:
            journal.close()
        room.direct("--at", "xt=0", "jog", "xt", "0.1")


def test_the_state_belongs_to_the_file_and_the_port_to_one_program(tmp_path: Path, monkeypatch):
    """Seen: from another folder a jog ran beside a daemon with a latched stop."""
    with bench(tmp_path, "1") as room:
        room.write_file({"xt": "closed_loop"})
        room.direct("stop", "--emergency")
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        monkeypatch.chdir(elsewhere)
        assert "stop_latched" in room.refused("--at", "xt=0", "jog", "xt", "0.1")
        monkeypatch.chdir(tmp_path)
        code, _, said = room.robot(
            "--config", "bench.toml", "--direct", "--at", "xt=0", "jog", "xt", "0.1"
        )
        assert code == 3
        assert "stop_latched" in said
        other = tmp_path / "other.toml"  # a state of its own, and the same port
        other.write_text((tmp_path / "bench.toml").read_text().replace('"state"', '"state2"'))
        with contextlib.closing(SerialPort(room.port, 115200)):
            code, _, said = room.robot("--config", str(other), "--direct", "status")
        assert code == 3
        assert "lock" in said


def test_another_board_is_refused_until_it_is_accepted(tmp_path: Path):
    with bench(tmp_path, "1") as room:
        room.write_file({"xt": "closed_loop"})
        room.direct("status")
    with bench(tmp_path, "1", "--serial-number", "7777") as room:
        said = room.refused("status")
        assert "board 7777" in said
        assert "4010001" in said
        assert "accept-boards" in said
        file = tmp_path / "bench.toml"
        ours = file.read_text()
        file.write_text(ours + "serial_number = 4010001\n")  # the file is believed, not the command
        assert "change serial_number in the file" in room.refused("accept-boards")
        file.write_text(ours)
        assert room.direct("accept-boards") == {"boards": {"xt": "7777"}}
        room.direct("status")


def test_an_emergency_stop_at_an_input_stops_everything(tmp_path: Path):
    with bench(tmp_path, "1") as room:
        room.write_file({"xt": "closed_loop"})
        file = tmp_path / "bench.toml"
        file.write_text(file.read_text() + "estop_input = 3\n")  # high at rest
        room.direct("--at", "xt=0", "jog", "xt", "0.1")
        file.write_text(file.read_text().replace("estop_input = 3", "estop_input = 0"))  # low
        assert "emergency stop is pressed" in room.refused("--at", "xt=0", "jog", "xt", "0.1")
