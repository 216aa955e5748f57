"""Whole-room tests: real processes of the virtual room, started as a user starts them."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

AUTOSPINE = Path(sys.executable).parent / "autospine"


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it said."""

    code: int
    out: str
    err: str

    def results(self) -> dict:
        return json.loads(self.out)


def children_of(pid: int) -> dict[int, str]:
    """Process id -> command line of everything below `pid`."""
    listed = subprocess.run(
        ["ps", "-ww", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True
    ).stdout
    rows = [line.split(None, 2) for line in listed.splitlines()]
    below: dict[int, str] = {}
    wave = {pid}
    while wave:
        wave_next = set()
        for child, parent, *words in rows:
            if int(parent) in wave:
                below[int(child)] = words[0] if words else ""
                wave_next.add(int(child))
        wave = wave_next
    return below


def still_alive(pids: dict[int, str]) -> dict[int, str]:
    """Those that run on (a zombie does not)."""
    alive = {}
    for pid, name in pids.items():
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            continue
        if state != "Z":
            alive[pid] = name
    return alive


class RunningDemo:
    """`autospine demo` as a process, with its case folder."""

    def __init__(self, case_dir: Path, *words: str) -> None:
        self.case_dir = case_dir
        self.process = subprocess.Popen(
            [AUTOSPINE, "demo", "--json", "--case", case_dir, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.seen: dict[int, str] = {}

    def look(self) -> dict[int, str]:
        """Note and return the processes of the room."""
        self.seen.update(children_of(self.process.pid))
        return self.seen

    def pid_of(self, part: str, timeout_s: float = 120.0) -> int:
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            for pid, words in self.look().items():
                if part in words:
                    return pid
            time.sleep(0.1)
        raise AssertionError(f"no process {part!r} in {self.seen}")

    def wait_for_event(self, kind: str, timeout_s: float = 120.0) -> None:
        """Until the case record has an event of this kind."""
        from case_record.record import CaseRecord, CaseRecordError

        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            self.look()
            try:
                with CaseRecord(self.case_dir) as record:
                    if record.last_event(kind) is not None:
                        return
            except CaseRecordError:
                pass
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.1)
        raise AssertionError(f"no event {kind!r} within {timeout_s:.0f} s")

    def ended(self, timeout_s: float = 240.0) -> Ended:
        out, err = self.process.communicate(timeout=timeout_s)
        return Ended(self.process.returncode, out, err)

    def assert_nothing_left(self, within_s: float = 60.0) -> None:
        deadline_s = time.monotonic() + within_s
        while (left := still_alive(self.seen)) and time.monotonic() < deadline_s:
            time.sleep(0.1)
        assert left == {}

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
            self.process.communicate()


@pytest.fixture
def demo(tmp_path):
    started: list[RunningDemo] = []

    def start(*words: str, case_dir: Path | None = None) -> RunningDemo:
        started.append(RunningDemo(case_dir or tmp_path / "case", *words))
        return started[-1]

    yield start
    for running in started:
        running.kill()
