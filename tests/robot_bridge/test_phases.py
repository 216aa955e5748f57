"""Every phase with every event, in every combination of arming, lock, certainty and motion.

The expectation is written down here a second time, in other words than the program's: as a list of
what each request needs. Whatever is not allowed must change nothing and move nothing.
"""

import contextlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from axis_model import AXES
from virtual_room import VirtualRoom

from robot_bridge.daemon.bridge import Bridge
from robot_bridge.protocol.bridge_end import RequestReceived, SessionOpened, StopReceived
from robot_bridge.protocol.messages import (
    Arm,
    Code,
    CommandState,
    CorrectPosition,
    DeclarePosition,
    Disarm,
    HelloRequest,
    Home,
    Message,
    Move,
    Rearm,
    SetDrives,
    SetInsertionLock,
    SetPhase,
    Status,
)
from robot_bridge.protocol.phases import ALLOWED, WorkPhase, may_follow, motion_allowed

P = WorkPhase
LATCHED = (P.STOP, P.EMERGENCY)
MAY_MOVE = {P.CALIBRATION, P.TARGETING, P.MOVE_TO_TARGET, P.MANUAL}
MAY_HOME = {P.START_UP, P.CALIBRATION, P.MANUAL}
TRANSITIONS = {
    P.START_UP: {P.CALIBRATION, P.PLANNING, P.MANUAL},
    P.CALIBRATION: {P.START_UP, P.PLANNING, P.TARGETING, P.MANUAL},
    P.PLANNING: {P.START_UP, P.CALIBRATION, P.TARGETING, P.MANUAL},
    P.TARGETING: {P.CALIBRATION, P.PLANNING, P.MOVE_TO_TARGET, P.MANUAL},
    P.MOVE_TO_TARGET: {P.CALIBRATION, P.PLANNING, P.TARGETING, P.MANUAL},
    P.MANUAL: {P.START_UP, P.CALIBRATION, P.PLANNING, P.TARGETING},
    P.STOP: set(),
    P.EMERGENCY: set(),
}


@dataclass(frozen=True)
class Case:
    phase: WorkPhase
    armed: bool
    locked: bool
    certain: bool
    moving: bool
    fault: bool

    @property
    def possible(self) -> bool:
        latched = self.phase in LATCHED
        if latched and (self.armed or self.moving):
            return False
        if self.moving and not (self.armed and self.certain and not self.locked):
            return False
        if self.moving and self.phase not in MAY_MOVE:
            return False
        return not (self.moving and self.fault)


CASES = [
    case
    for values in itertools.product(P, *[(False, True)] * 5)
    if (case := Case(*values)).possible
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("phases")


class Bench:
    """A bridge in exactly the wanted standing, reached through its own doors where there are."""

    def __init__(self, folder: Path, case: Case) -> None:
        self.room = VirtualRoom(folder / f"{next(_number)}", seed=3)
        bridge = self.room.bridge
        assert bridge is not None
        self.bridge: Bridge = bridge
        self._open()
        if case.certain:
            self.ask(DeclarePosition(dict.fromkeys(AXES, 0), "test", self.now_ms))
        if case.phase in LATCHED:
            self._receive_stop(case.phase is P.EMERGENCY)
        else:
            for phase in _way_to(case.phase):
                self.ask(SetPhase(phase.value, "test", self.now_ms))
        if case.armed:
            self.ask(Arm("test", 0, self.now_ms))
        if case.moving:
            self.ask(self.move("under way", 9000))
            self.bridge.tick()
            assert self.bridge.moving
        if case.locked:
            self.ask(SetInsertionLock(True, "test", self.now_ms))
        if case.fault:
            self.room.motors.fault = "encoder"
            self.bridge.motors.poll()
        status = self.bridge.status()
        reached = Case(
            WorkPhase(status.phase),
            status.armed,
            status.insertion_locked,
            status.position_certain,
            status.moving,
            status.fault is not None,
        )
        assert reached == case
        self.begun_before = len(self.room.stage.begun)
        self.before = status

    def _open(self) -> None:
        end = self.bridge.end
        hello = SessionOpened(HelloRequest(1, "test", 1, "x"))
        end.open_session(hello, self.bridge._hello(1))
        self.bridge.take_output()

    def _receive_stop(self, emergency: bool) -> None:
        self.bridge._receive_stop(StopReceived(7, emergency))

    @property
    def now_ms(self) -> int:
        return self.bridge.status().now_ms

    def move(self, command_id: str, um: int) -> Move:
        setpoints_um = dict.fromkeys(AXES, um)
        return Move(command_id, setpoints_um, None, self.bridge.last_motion, self.now_ms)

    def ask(self, request: Message):
        answer = self.bridge._answer(request)
        return answer

    @property
    def began_something(self) -> bool:
        self.bridge.tick()
        return len(self.room.stage.begun) > self.begun_before


_number = itertools.count()


@contextlib.contextmanager
def standing(folder: Path, case: Case) -> Iterator[Bench]:
    bench = Bench(folder, case)
    try:
        yield bench
    except BaseException as error:
        error.add_note(f"in the standing {case}")
        raise
    finally:
        bench.room.close()


def _way_to(phase: WorkPhase) -> list[WorkPhase]:
    ways = {
        P.START_UP: [],
        P.TARGETING: [P.PLANNING, P.TARGETING],
        P.MOVE_TO_TARGET: [P.PLANNING, P.TARGETING, P.MOVE_TO_TARGET],
    }
    return ways.get(phase, [phase])


def _without_time(status: Status) -> Status:
    return Status(**{**status.__dict__, "now_ms": 0, "refused": 0})


def test_there_are_many_standings():
    assert len(CASES) > 100
    assert {case.phase for case in CASES} == set(P)


def test_the_table_of_transitions_is_the_one_written_down_here():
    for now, wanted in itertools.product(P, P):
        expected = wanted in TRANSITIONS[now] or wanted is now
        assert may_follow(now, wanted) == expected, (now, wanted)
    assert {phase for phase in P if motion_allowed(phase)} == MAY_MOVE
    assert {phase for phase in P if ALLOWED[phase].home} == MAY_HOME
    assert all(ALLOWED[phase].after_rearm is P.START_UP for phase in LATCHED)


def test_a_move_begins_only_where_everything_allows_it(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            answer = bench.ask(bench.move("new", 500))
            allowed = (
                case.phase in MAY_MOVE and case.armed and case.certain
                and not (case.locked or case.moving or case.fault)
            )  # fmt: skip
            assert (answer.state == CommandState.ACCEPTED) == allowed
            if not allowed:
                assert answer.state == CommandState.REFUSED
                assert answer.code != Code.OK
                assert answer.text
                assert _without_time(bench.bridge.status()) == _without_time(bench.before)
                assert bench.room.commands["new"].state is CommandState.REFUSED
            assert bench.began_something == allowed


def test_homing_begins_only_where_everything_allows_it(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            answer = bench.ask(Home("new", "test", bench.now_ms))
            allowed = (
                case.phase in MAY_HOME
                and case.armed
                and not (case.locked or case.moving or case.fault)
            )
            assert (answer.state == CommandState.ACCEPTED) == allowed, answer
            assert bench.began_something == allowed


def test_arming_is_for_an_unlatched_bridge_without_faults(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            answer = bench.ask(Arm("test", bench.before.stop_count, bench.now_ms))
            allowed = case.phase not in LATCHED and not case.fault
            assert (answer.code == Code.OK) == allowed
            assert bench.bridge.armed == (allowed or case.armed)
            assert not bench.began_something


def test_rearming_is_for_a_latched_bridge_and_names_the_stop(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            latched = case.phase in LATCHED
            wrong = bench.ask(Rearm("test", bench.before.stop_count + 1, bench.now_ms))
            assert wrong.code != Code.OK
            answer = bench.ask(Rearm("test", bench.before.stop_count, bench.now_ms))
            assert (answer.code == Code.OK) == (latched and not case.fault)
            if answer.code == Code.OK:
                assert bench.bridge.phase is P.START_UP
                assert bench.bridge.armed
                assert not bench.bridge.stopped
            else:
                assert bench.bridge.phase is case.phase
            assert not bench.began_something


def test_disarming_is_always_done_and_stops_what_runs(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            assert bench.ask(Disarm("test")).code == Code.OK
            assert not bench.bridge.armed
            assert not bench.room.stage.moving
            assert not bench.began_something


@pytest.mark.parametrize("wanted", P)
def test_a_phase_is_set_only_along_the_table(folder: Path, wanted: WorkPhase):
    for case in CASES:
        with standing(folder, case) as bench:
            answer = bench.ask(SetPhase(wanted.value, "test", bench.now_ms))
            allowed = not case.moving and (
                wanted in TRANSITIONS[case.phase] or wanted is case.phase
            )
            allowed = allowed and case.phase not in LATCHED
            assert (answer.code == Code.OK) == allowed, answer
            assert bench.bridge.phase is (wanted if allowed else case.phase)
            assert not bench.began_something


@pytest.mark.parametrize("locked", [True, False])
def test_the_lock_can_always_be_set_and_stops_what_runs(folder: Path, locked: bool):
    for case in CASES:
        with standing(folder, case) as bench:
            assert bench.ask(SetInsertionLock(locked, "test", bench.now_ms)).code == Code.OK
            assert bench.bridge.insertion_locked == locked
            if locked:
                assert not bench.room.stage.moving
            assert not bench.began_something


def test_a_position_is_declared_only_at_standstill(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            bench.room.motors.fault = None
            answer = bench.ask(DeclarePosition(dict.fromkeys(AXES, 5), "test", bench.now_ms))
            assert (answer.code == Code.OK) == (not case.moving)
            assert bench.bridge.certain == (case.certain or not case.moving)
            assert not bench.began_something


@pytest.mark.parametrize("on", [False, True])
def test_drives_go_off_at_standstill_and_on_without_stop_or_lock(folder: Path, on: bool):
    for case in CASES:
        with standing(folder, case) as bench:
            answer = bench.ask(SetDrives(on, "test", bench.now_ms))
            allowed = not case.moving and not (on and (case.phase in LATCHED or case.locked))
            assert (answer.code == Code.OK) == allowed
            assert not bench.began_something


def test_a_position_is_corrected_only_at_standstill_and_moves_nothing(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            correction = CorrectPosition({"xt": 700}, {"xt": 50}, bench.before.last_motion, 0)
            answer = bench.ask(replace(correction, seen_ms=bench.now_ms))
            assert (answer.code == Code.OK) == (not case.moving)
            assert bench.bridge.certain == case.certain
            assert not bench.began_something


@pytest.mark.parametrize("emergency", [False, True])
def test_stop_works_in_every_standing(folder: Path, emergency: bool):
    for case in CASES:
        with standing(folder, case) as bench:
            bench.bridge._receive_stop(StopReceived(99, emergency))
            wanted = P.EMERGENCY if emergency or case.phase is P.EMERGENCY else P.STOP
            assert bench.bridge.phase is wanted
            assert bench.bridge.stopped
            assert not bench.bridge.armed
            assert bench.bridge.stop_count == bench.before.stop_count + 1
            assert not bench.room.stage.moving
            assert not bench.began_something
            assert bench.bridge.end.take_output(), "no acknowledgement"


def test_a_new_session_disarms_and_stops_what_runs(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            bench.bridge._open_session(SessionOpened(HelloRequest(2, "other", 1, "x")))
            assert not bench.bridge.armed
            assert not bench.room.stage.moving
            assert bench.bridge.phase is case.phase
            assert not bench.began_something


def test_silence_latches_a_stop_if_anything_could_move(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            for _ in range(20):
                bench.room.clock.now_s += 0.1
                bench.bridge.tick()
            could_move = case.armed or case.moving
            assert not bench.bridge.armed
            assert not bench.room.stage.moving
            assert bench.bridge.stopped == (could_move or case.phase in LATCHED)
            assert not bench.began_something


def test_requests_sent_too_long_ago_are_refused_whatever_they_ask(folder: Path):
    for case in CASES:
        with standing(folder, case) as bench:
            old_ms = bench.now_ms - 1001
            old = [
                Arm("test", bench.before.stop_count, old_ms),
                Rearm("test", bench.before.stop_count, old_ms),
                SetPhase(P.MANUAL.value, "test", old_ms),
                SetInsertionLock(False, "test", old_ms),
                DeclarePosition(dict.fromkeys(AXES, 5), "test", old_ms),
                SetDrives(False, "test", old_ms),
                CorrectPosition({"xt": 5}, {"xt": 5}, bench.bridge.last_motion, old_ms),
                Move("late", dict.fromkeys(AXES, 5), None, bench.bridge.last_motion, old_ms),
                Home("late home", "test", old_ms),
            ]
            for request in old:
                assert bench.ask(request).code == Code.STALE_COMMAND
            future = Move(
                "early", dict.fromkeys(AXES, 5), None, bench.bridge.last_motion, old_ms + 9999
            )
            assert bench.ask(future).code == Code.STALE_COMMAND
            assert _without_time(bench.bridge.status()) == _without_time(bench.before)
            assert not bench.began_something


def test_there_is_no_other_request_than_those_tested_here():
    tested = {
        Arm, Rearm, Disarm, SetPhase, SetInsertionLock, DeclarePosition, CorrectPosition, Move,
        Home, SetDrives,
    }  # fmt: skip
    from robot_bridge.daemon.rules import _RULES

    assert set(_RULES) == tested
    assert RequestReceived.__annotations__["request"] is Message
