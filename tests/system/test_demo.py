"""`autospine demo`: the whole room does the whole job, and ends as it should whatever happens."""

import os
import signal
import socket
import urllib.request

import pytest

from case_record.record import CaseRecord
from simulator.demo.room import known_faults
from simulator.misassigned import misassigned, read_truth

PROCESSES = {
    "service": "cli.main service",
    "worker": "cli.main worker",
    "listener": "cli.main listener",
    "scanner": "cli.main scanner",
    "bridge": "robot_bridge",
    "motors": "simulator.motors",
    "serial line": "simulator.serial_line",
}


def assert_good(results: dict, punctures: int) -> None:
    assert len(results["punctures"]) == punctures
    assert results["unintended_motions"] == 0
    for puncture in results["punctures"]:
        assert puncture["true_error_mm"] <= 0.10
        assert puncture["frames"] >= 1
        assert puncture["scan_s"] > 0


def test_calibration_and_punctures_end_near_the_target(demo):
    running = demo("--exit", "--punctures", "2", "--seed", "11")
    running.wait_for_event("calibration_started")
    ended = running.ended()
    assert ended.code == 0, ended.err
    assert_good(ended.results(), 2)
    running.assert_nothing_left()
    with CaseRecord(running.case_dir) as record:
        assert record.verify_events() > 20
        assert all(move.state == "DONE" for move in record.moves())
        assert record.count_slices().get("quarantined", 0) == 0


def test_the_page_stays_up_until_ctrl_c_and_then_all_ends(demo):
    running = demo("--punctures", "1", "--seed", "3")
    running.wait_for_event("needle_out")
    url = next(
        line.split("page: ")[1].strip() for line in running.process.stderr if "page: " in line
    )
    with urllib.request.urlopen(url, timeout=60) as page:
        assert b"AutoSPINe" in page.read()
    running.look()
    running.process.send_signal(signal.SIGINT)
    ended = running.ended()
    assert ended.code == 0, ended.err
    assert "Traceback" not in ended.err
    running.assert_nothing_left()
    port = int(url.rsplit(":", 1)[1])
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


@pytest.mark.parametrize(
    "victim",
    [
        # the ones that hold the robot by default, every one in the long campaign
        pytest.param(name, marks=() if name in ("bridge", "service") else pytest.mark.soak)
        for name in PROCESSES
    ],
)
def test_a_killed_process_ends_in_a_stopped_robot_and_the_case_goes_on(demo, victim):
    running = demo("--exit", "--punctures", "1", "--seed", "5")
    running.wait_for_event("move_sent")
    os.kill(running.pid_of(PROCESSES[victim]), signal.SIGKILL)
    ended = running.ended()
    assert ended.code == 3
    assert f"{victim} was killed by SIGKILL" in ended.err
    assert "still moving" not in ended.err
    assert "Traceback" not in ended.err
    running.assert_nothing_left()

    again = demo("--exit", "--punctures", "1", "--seed", "5", case_dir=running.case_dir)
    ended = again.ended()
    assert ended.code == 0, ended.err
    assert_good(ended.results(), 1)
    with CaseRecord(running.case_dir) as record:
        record.verify_events()


def test_when_the_demo_itself_is_killed_every_process_ends(demo):
    running = demo("--exit", "--punctures", "1")
    running.wait_for_event("move_sent")
    running.kill()
    running.assert_nothing_left()


def test_a_port_in_use_is_named(demo):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        running = demo("--exit", "--page-port", str(port))
        ended = running.ended()
    assert ended.code == 2
    assert f"{port}" in ended.err
    assert "Traceback" not in ended.err


def test_an_unknown_fault_is_named_with_those_that_exist(demo):
    ended = demo("--exit", "--fault", "earthquake").ended()
    assert ended.code == 2
    assert "earthquake" in ended.err
    assert "late" in ended.err


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10))
def test_three_punctures_for_ten_seeds(demo, seed):
    running = demo("--exit", "--punctures", "3", "--seed", str(seed))
    ended = running.ended()
    assert ended.code == 0, ended.err
    assert_good(ended.results(), 3)


@pytest.mark.soak
@pytest.mark.parametrize("fault", known_faults())
def test_a_fault_of_the_scanner_costs_slices_but_no_accuracy(demo, fault):
    running = demo("--exit", "--punctures", "1", "--seed", "2", "--fault", fault)
    ended = running.ended()
    assert ended.code in (0, 3), ended.err
    if ended.code == 0:
        assert_good(ended.results(), 1)
    assert "Traceback" not in ended.err
    with CaseRecord(running.case_dir) as record:
        truth = read_truth(running.case_dir / "virtual" / "acquisitions.jsonl")
        assert misassigned(record.slices(), truth) == []
