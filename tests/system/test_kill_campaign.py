"""kill -9 of any process at any instant: the case goes on, and nothing moves that nobody asked for.

The motions are watched from outside, at the motors' truth port, through every start and every kill.
"""

import contextlib
import os
import random
import signal
import threading
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from case_record.record import CaseRecord
from simulator.truth_client import TruthAddress
from simulator.unintended import TrueMotion, ask_motions, unintended_motions

VICTIMS = {
    "service": "cli.main service",
    "worker": "cli.main worker",
    "listener": "cli.main listener",
    "scanner": "cli.main scanner",
    "bridge": "robot_bridge",
    "motors": "simulator.motors",
    "serial line": "simulator.serial_line",
}
DEMO = "the demo itself"


class MotionWatch:
    """Keeps every motion that the motors' process tells of while a demo runs."""

    def __init__(self, case_dir: Path) -> None:
        self._config = case_dir / "room.toml"
        self._over = threading.Event()
        self._seen: dict[tuple[str, float], TrueMotion] = {}
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> dict[tuple[str, float], TrueMotion]:
        self._thread.start()
        return self._seen

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._over.wait(0.1):
            with contextlib.suppress(OSError, ValueError, KeyError):
                table = tomllib.loads(self._config.read_text())
                port = table["virtual"]["scanner"]["motors_truth_port"]
                for motion in ask_motions(TruthAddress("127.0.0.1", port)):
                    self._seen[(motion.axis, motion.start_s)] = motion


@dataclass(frozen=True)
class Plan:
    """Which case is disturbed, and how: `kills` at most, each within `reach_s` of the start."""

    kills: int
    punctures: int
    reach_s: float
    words: tuple[str, ...] = ()
    largest_error_mm: float = 0.10

    @property
    def demo_words(self) -> list[str]:
        return ["--exit", "--punctures", str(self.punctures), "--seed", "5", *self.words]


def kill_at_random(demo, case_dir, dice, plan) -> str | None:
    """Run the demo and kill one of its processes; None if it was done before."""
    running = demo(*plan.demo_words, case_dir=case_dir)
    victim = dice.choice([*VICTIMS, DEMO])
    pid = running.process.pid if victim == DEMO else running.pid_of(VICTIMS[victim], 300.0)
    running.pid_of(VICTIMS["scanner"], 300.0)  # the last one to be started
    deadline_s = time.monotonic() + dice.uniform(0.0, plan.reach_s)
    while time.monotonic() < deadline_s and running.process.poll() is None:
        running.look()
        time.sleep(0.02)
    if running.process.poll() is None:  # else the number may belong to somebody else by now
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    ended = running.ended(300.0)
    note(case_dir, f"killed {victim}: exit {ended.code}: {ended.err[-300:]!r}")
    assert "Traceback" not in ended.err
    assert "still moving" not in ended.err
    running.assert_nothing_left(60.0)
    return None if ended.code == 0 else victim


def note(case_dir: Path, text: str) -> None:
    """One line in the log of the whole campaign, beside the cases."""
    with (case_dir.parent / "campaign.log").open("a") as log:
        log.write(f"{time.strftime('%H:%M:%S')} {case_dir.name} {text}\n")


def campaign(demo, case_dir, seed, plan) -> list[str]:
    """Kill, restart, kill again; then let the case come to its end. Return who was killed."""
    dice = random.Random(seed)
    victims = []
    with MotionWatch(case_dir) as motions:
        for _ in range(plan.kills):
            victim = kill_at_random(demo, case_dir, dice, plan)
            if victim is None:
                break
            victims.append(victim)
        last = demo(*plan.demo_words, case_dir=case_dir)
        ended = last.ended(600.0)
    note(case_dir, f"went on to its end: exit {ended.code}")
    assert ended.code == 0, f"after {victims}: {ended.err[-1500:]}"
    results = ended.results()
    assert len(results["punctures"]) == plan.punctures
    assert all(one["true_error_mm"] <= plan.largest_error_mm for one in results["punctures"])
    assert results["unintended_motions"] == 0
    with CaseRecord(case_dir) as record:
        assert record.verify_events() > 20
        assert motions, "the watch saw nothing"
        assert unintended_motions(list(motions.values()), record.moves()) == []
    return victims


def test_a_case_goes_on_after_random_kills(demo, tmp_path):
    assert campaign(demo, tmp_path / "case", 1, Plan(kills=1, punctures=1, reach_s=6.0))


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_soak_fifty_kills_over_ten_cases(demo, tmp_path):
    killed: list[str] = []
    number = 0
    while len(killed) < 50:
        plan = Plan(kills=5, punctures=4, reach_s=10.0)
        killed += campaign(demo, tmp_path / f"case-{number}", 100 + number, plan)
        number += 1
    assert len(set(killed)) >= 5


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_soak_cases_of_four_axes_go_on_after_random_kills(demo, tmp_path):
    killed: list[str] = []
    number = 0
    while len(killed) < 10:
        plan = Plan(5, 2, 15.0, ("--guide",), largest_error_mm=0.4)
        killed += campaign(demo, tmp_path / f"case-{number}", 200 + number, plan)
        number += 1
