"""The worker: whatever a measurement does, it ends that measurement and nothing else."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from case_record.attempts import MOST_DEATHS, Attempts
from case_record.record import CaseRecord

CONFIG = """
[room]
name = "worker"
case_dir = "case"

[service]
bridge_link = "/dev/null"
"""


@pytest.fixture
def record(tmp_path: Path):
    (tmp_path / "room.toml").write_text(CONFIG)
    with CaseRecord(tmp_path / "case", create=True) as opened:
        opened.start_case("worker", seed=0)
        yield opened


def start_worker(folder: Path) -> subprocess.Popen:
    words = [sys.executable, "-m", "service.cli.main", "worker"]
    words += ["--config", str(folder / "room.toml"), "--exit-with-parent"]
    log = (folder / "worker.log").open("a")
    with log:
        return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)


def wait_for_end(record: CaseRecord, number: int):
    deadline_s = time.monotonic() + 60.0
    while (row := record.measurement(number)).state == "requested":
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    return row


@pytest.mark.parametrize(
    ("request_body", "reason"),
    [
        ({}, "KeyError"),
        ({"holds": 7}, "TypeError"),
        ({"holds": [{"hold_id": 1, "shift_mm": [0, 0]}]}, "no slice"),
    ],
)
def test_a_request_that_the_program_fails_at_fails_alone(record, tmp_path, request_body, reason):
    worker = start_worker(tmp_path)
    try:
        row = wait_for_end(record, record.request_measurement("ml", [1], request_body))
        assert (row.state, reason in row.reason) == ("failed", True)
        again = wait_for_end(record, record.request_measurement("ml", [1], request_body))
        assert again.state == "failed"
        assert worker.poll() is None
    finally:
        worker.communicate()


def test_a_second_worker_is_refused_with_who_is_there_and_takes_over_when_that_is_killed(
    record, tmp_path
):
    first = start_worker(tmp_path)
    wait_for_end(record, record.request_measurement("ml", [1], {}))
    second = start_worker(tmp_path)
    assert second.wait(60.0) == 2
    second.communicate()
    assert f"another worker (process {first.pid})" in (tmp_path / "worker.log").read_text()
    first.kill()
    first.communicate()
    third = start_worker(tmp_path)
    try:
        row = wait_for_end(record, record.request_measurement("ml", [1], {}))
        assert row.state == "failed"
    finally:
        third.communicate()


def test_a_request_that_killed_the_worker_twice_is_not_tried_again(record, tmp_path):
    number = record.request_measurement("ml", [1], {"holds": []})
    for _ in range(MOST_DEATHS):
        dying = os.fork()
        if dying == 0:  # as a library that crashes, or the kernel that wants its memory back
            with Attempts(record.case_dir, "worker").at(f"measurement {number}"):
                os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(dying, 0)
    worker = start_worker(tmp_path)
    try:
        row = wait_for_end(record, number)
        assert (row.state, row.reason_code) == ("failed", "worker_ended")
        assert "2 times" in row.reason
        other = wait_for_end(record, record.request_measurement("ml", [1], {"holds": []}))
        assert other.reason_code == "no_slices"
    finally:
        worker.communicate()


def test_work_that_failed_by_an_exception_is_no_death(tmp_path):
    with Attempts(tmp_path, "worker") as attempts:
        with pytest.raises(ValueError, match="x"), attempts.at("a"):
            raise ValueError("x")
        assert attempts.deaths("a") == 0


def test_what_is_kept_of_deaths_is_bounded_and_survives_nonsense(tmp_path):
    for number in range(200):
        attempts = Attempts(tmp_path, "worker")
        attempts.at(str(number)).__enter__()
        attempts.close()
    file = tmp_path / "processes" / "worker.doing"
    assert file.stat().st_size < 4096
    file.write_text("{nonsense")
    with Attempts(tmp_path, "worker") as attempts:
        assert attempts.deaths("199") == 0
