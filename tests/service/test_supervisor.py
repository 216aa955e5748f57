"""`autospine up`: one child's end ends nobody else, nobody gives up, nobody waits for who hangs."""

import configparser
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from lone_service import CONFIG

from case_record.presence import FOLDER, Hanging, Presence
from room_config.shell import autospine
from service.cli import supervisor
from service.cli.children import rotate
from service.cli.main import SUBCOMMANDS

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "examples" / "systemd"
LISTENER = """
[listener]
port = 0
"""
PATIENCE_S = 120.0


class RunningUp:
    """`autospine up` on an empty room."""

    def __init__(self, folder: Path) -> None:
        (folder / "room.toml").write_text(CONFIG + LISTENER)
        words = autospine("up", "--config", str(folder / "room.toml"), "--exit-with-parent")
        log = (folder / "up.log").open("wb")
        with log:
            self.process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log
            )
        assert self.process.stdout is not None
        self.facts = json.loads(self.process.stdout.readline())

    def pids(self) -> dict[str, int]:
        """Of the children that run."""
        found = {}
        listed = subprocess.run(
            ["ps", "-ww", "--ppid", str(self.process.pid), "-o", "pid=,stat=,args="],
            capture_output=True, text=True, check=False,
        ).stdout  # fmt: skip
        for line in listed.splitlines():
            pid, state, words = line.split(None, 2)
            for name in supervisor.PROCESSES:
                if f"cli.main {name} " in words and not state.startswith("Z"):
                    found[name] = int(pid)
        return found

    def kill_and_await(self, name: str) -> None:
        """As `kill -9`; until another one runs in its place."""
        before = self.pids()[name]
        os.kill(before, signal.SIGKILL)
        wait_until(lambda: self.pids().get(name) not in (before, None))


def wait_until(wanted: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not wanted():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[RunningUp]:
    up = RunningUp(tmp_path)
    yield up
    up.process.kill()
    up.process.communicate()


def test_a_child_that_is_killed_is_started_again_and_nobody_else_is(running: RunningUp) -> None:
    first = running.pids()
    assert set(first) == set(supervisor.PROCESSES)
    for _ in range(3):
        running.kill_and_await("worker")
    running.kill_and_await("listener")
    now = running.pids()
    assert now["service"] == first["service"]
    assert httpx.get(f"{running.facts['url']}/healthz").status_code in (200, 503)
    running.kill_and_await("service")
    assert running.pids()["worker"] == now["worker"]
    assert running.process.poll() is None


def test_stop_is_heeded_while_a_child_hangs_and_nothing_is_left(running: RunningUp) -> None:
    pids = running.pids()
    for name in ("worker", "service"):
        os.kill(pids[name], signal.SIGSTOP)
    running.process.terminate()
    assert running.process.wait(PATIENCE_S) == 0
    for pid in pids.values():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


BEATING = """
import sys, time
from pathlib import Path
from case_record.presence import Presence
presence = Presence(Path(sys.argv[1]), "worker")
print('{"ready": true}', flush=True)
while True:
    presence.beat()
    time.sleep(0.05)
"""


def test_a_child_that_hangs_is_killed_and_started_again(tmp_path: Path) -> None:
    family = supervisor.Family(tmp_path / "logs")
    kept = supervisor.Kept(family, "worker", [sys.executable, "-c", BEATING, str(tmp_path)])
    hanging = Hanging(tmp_path, "up", hung_s=1.0, confirm_s=0.5)

    def look() -> None:
        kept.look(was_ready=True, hangs="worker" in hanging.look(["worker"]))

    try:
        wait_until(lambda: look() or kept.is_ready)
        first = family.children["worker"].process
        for _ in range(40):  # as long as it beats it is left alone
            look()
            time.sleep(0.05)
        assert first.poll() is None
        os.kill(first.pid, signal.SIGSTOP)
        wait_until(lambda: look() or first.poll() is not None)
        assert first.returncode == -signal.SIGKILL
        wait_until(lambda: look() or kept.is_ready)
        assert family.children["worker"].process is not first
    finally:
        family.end()
        hanging.close()


def test_a_disk_that_takes_nothing_says_of_nobody_that_it_hangs(tmp_path: Path) -> None:
    hanging = Hanging(tmp_path, "up", hung_s=0.0, confirm_s=0.5)
    with Presence(tmp_path, "worker"):
        wait_until(lambda: hanging.look(["worker"]) == ["worker"])
        # the supervisor's own beat does not show either, as on a read-only disk
        (tmp_path / FOLDER / "up").unlink()
        assert hanging.look(["worker"]) == []
    hanging.close()


@pytest.mark.soak
def test_every_process_of_the_room_that_hangs_is_started_again(running: RunningUp) -> None:
    before = running.pids()
    for pid in before.values():
        os.kill(pid, signal.SIGSTOP)
    wait_until(
        lambda: all(running.pids().get(name) not in (pid, None) for name, pid in before.items())
    )
    assert running.process.poll() is None
    for pid in before.values():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_room_that_can_never_run_is_said_at_once(tmp_path: Path) -> None:
    wrong = CONFIG.replace('bridge_link = "', 'host = "0.0.0.0"\nbridge_link = "')
    (tmp_path / "room.toml").write_text(wrong + LISTENER)
    words = autospine("up", "--config", str(tmp_path / "room.toml"))
    ended = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.returncode == 2
    assert "0.0.0.0 is not loopback" in ended.stderr.splitlines()[-1]


@pytest.mark.soak
@pytest.mark.parametrize("name", supervisor.PROCESSES)
def test_twenty_ends_in_a_row_are_no_reason_to_give_up(running: RunningUp, name: str) -> None:
    others = {n: pid for n, pid in running.pids().items() if n != name}
    for _ in range(20):
        running.kill_and_await(name)
    assert {n: pid for n, pid in running.pids().items() if n != name} == others


def test_pauses_grow_to_a_limit_and_begin_anew_after_a_while(tmp_path: Path) -> None:
    family = supervisor.Family(tmp_path)
    kept = supervisor.Kept(family, "false", [sys.executable, "-c", "import sys; sys.exit(1)"])
    pauses = []
    for _ in range(8):
        kept._has_ended("ended", now_s=0.0)
        pauses.append(kept._pause_s)
    assert pauses == [0.5, 1, 2, 4, 8, 10, 10, 10]
    kept._has_ended("ended", now_s=1000.0)
    assert kept._pause_s == supervisor.FIRST_PAUSE_S


def test_logs_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "worker.log"
    with path.open("ab", buffering=0) as writer:
        for number in range(40):
            writer.write(b"%03d\n" % number * 256)
            rotate(path, most_bytes=2000, kept=3)
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["worker.log", "worker.log.1", "worker.log.2", "worker.log.3"]
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) < 4 * 4000
    assert (path.read_bytes() or (tmp_path / "worker.log.1").read_bytes()).endswith(b"039\n")


@pytest.mark.parametrize("unit", sorted(UNITS.glob("*.service")), ids=lambda path: path.stem)
def test_the_units_have_the_supervisors_policy(unit: Path) -> None:
    read = configparser.ConfigParser(interpolation=None, strict=False)
    read.optionxform = str
    read.read(unit)
    service = read["Service"]
    assert read["Unit"]["StartLimitIntervalSec"] == "0"
    assert service["Restart"] == "always"
    assert service["RestartSec"] == f"{supervisor.FIRST_PAUSE_S * 1000:.0f}ms"
    assert service["RestartMaxDelaySec"] == f"{supervisor.LONGEST_PAUSE_S:.0f}s"
    assert float(service["TimeoutStopSec"].rstrip("s")) >= supervisor.END_S
    assert service["UMask"] == "0077"
    if unit.stem != "autospine-bridge":  # which has a guardian of its own
        assert float(service["WatchdogSec"].rstrip("s")) > supervisor.HUNG_S
    assert "Requires" not in read["Unit"]  # nobody's end ends another
    words = service["ExecStart"].split()
    name = unit.stem.removeprefix("autospine-")
    assert name in SUBCOMMANDS
    assert words[1] == name or words[1:3] == ["-m", "robot_bridge"]
