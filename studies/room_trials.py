"""The paper's Table II in a real room: it drives, a person punctures, and it goes on after any end.

What has been done stands in `punctures.jsonl`, one line a puncture; the room's own record knows the
rest. It never arms the robot and never says that a needle is out before a person has.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from room_config.exit_codes import COULD_NOT
from service.client import RefusedByServiceError, RoomClient, ServiceGoneError
from service.procedure.strategies import STRATEGIES
from service.room.belief.state import BeliefState, GoalBelief
from service.room.state import RoomState
from service.web.schemas import LONGEST_JOG_UM, EventBody
from studies.navigation import RANDOM_POINT_MM, Group, GroupResult, Puncture
from studies.navigation_study import NavigationStudy

LOG = "punctures.jsonl"
_POLL_S = 0.1
_GONE_S = 120.0
_BUSY, _NOT_NOW = 503, 409
_MOST_FAILURES = 4
_LOOKED_BACK = 900  # events: an approach and what may follow it have fewer

Seen = TypeVar("Seen")


class StudyEndedError(Exception):
    """The study cannot go on now; one line with what to do. What was done is kept."""

    exit_code = COULD_NOT


class ProcedureEndedError(Exception):
    """A procedure of the room came to nothing; why."""


@dataclass(frozen=True)
class Made:
    """One puncture. minutes: from the start of its approach to READY, as the room's record says;
    the first of a strategy is the target itself and has no approach."""

    strategy: str
    number: int
    procedure_id: int | None = None
    estimated_error_mm: float = 0.0
    sigma_mm: float = 0.0
    iterations: int = 0
    frames: int = 0
    minutes: float = 0.0


@dataclass(frozen=True)
class Study:
    """What a folder is a study of; goal: of the room before it began, which adaptive steers by."""

    room: str
    strategies: tuple[str, ...]
    punctures: int
    seed: int
    goal: GoalBelief


class Log:
    """Appended to, never changed; a line that was torn by a sudden end is cut off."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / LOG
        whole = self._path.read_bytes() if self._path.exists() else b""
        kept = whole[: whole.rfind(b"\n") + 1]
        if kept != whole:
            with self._path.open("r+b") as file:
                file.truncate(len(kept))
        try:
            lines = [json.loads(line) for line in kept.splitlines()]
            self._study = Study(**_with_goal(lines[0])) if lines else None
            self.made = [Made(**line) for line in lines[1:]]
        except (ValueError, TypeError) as error:
            raise ValueError(f"{self._path}: not the log of a study ({error})") from None

    def begin(self, study: Study) -> Study:
        """The study of this folder, begun now or before; ValueError if it is another one."""
        if self._study is None:
            self._append({**vars(study), "goal": study.goal.model_dump()})
            self._study = study
        for name in ("room", "strategies", "punctures", "seed"):
            was, wanted = getattr(self._study, name), getattr(study, name)
            if was != wanted:
                raise ValueError(
                    f"{self._path}: a study with {name} {was}, not {wanted}: use another --out"
                )
        return self._study

    def add(self, made: Made) -> None:
        self._append(asdict(made))
        self.made.append(made)

    def of(self, strategy: str) -> list[Made]:
        return [one for one in self.made if one.strategy == strategy]

    def _append(self, line: dict[str, Any]) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
            file.flush()
            os.fsync(file.fileno())


def _with_goal(line: dict[str, Any]) -> dict[str, Any]:
    return {**line, "strategies": tuple(line["strategies"]), "goal": GoalBelief(**line["goal"])}


class RoomTrials:
    """Drives the room. ask: shows a person what to do and waits until it is done; tell: shows."""

    def __init__(
        self,
        client: RoomClient,
        log: Log,
        ask: Callable[[str], object],
        tell: Callable[[str], object],
    ) -> None:
        self._client, self._log, self._ask, self._tell = client, log, ask, tell
        self._told = ""
        self._calibrated = ""  # for which strategy, in this run

    def run(self, strategies: Sequence[str], punctures: int, seed: int) -> None:
        """Until every puncture is made; StudyEndedError, ValueError."""
        state = self._idle()
        if state.guide:
            raise ValueError("the room steers a guide with two fiducials; the bench has one")
        goal = _belief(state).goal
        self._study = self._log.begin(Study(state.room, tuple(strategies), punctures, seed, goal))
        try:
            for strategy in strategies:
                self._trial(strategy)
        except RefusedByServiceError as error:
            raise StudyEndedError(
                f"the room refused: {error}; run this again to continue"
            ) from error
        self._set("", self._study.goal)

    def _trial(self, strategy: str) -> None:
        if not self._log.of(strategy):
            self._ask(
                f"{strategy}: fix a new sheet under the robot and make sure that the robot may "
                "move; it will move from now on."
            )
            self._start(strategy)
        while (number := len(self._log.of(strategy))) < self._study.punctures:
            self._again_and_again(strategy, partial(self._puncture, strategy, number))

    def _again_and_again(self, strategy: str, attempt: Callable[[], None]) -> None:
        """What came to nothing is tried again after another calibration, some times."""
        for number in range(_MOST_FAILURES):
            try:
                if number:
                    self._calibrate(strategy)
                attempt()
                return
            except ProcedureEndedError as error:
                why = str(error)
                self._tell(f"{strategy}: {why}")
        raise StudyEndedError(f"{strategy}: failed {_MOST_FAILURES} times: {why}")

    def _make_target(self, strategy: str) -> None:
        if self._calibrated != strategy:
            self._calibrate(strategy)
        self._procedure(lambda: self._client.record_target(f"{strategy} of the bench study"))

    def _start(self, strategy: str) -> None:
        """Calibrate, make the place where the robot stands then the target, and puncture it."""
        self._unlock(self._settled())
        self._set(strategy, _belief(self._idle()).goal)
        self._again_and_again(strategy, lambda: self._make_target(strategy))
        self._client.lock_motion()
        self._ask_for_puncture(strategy, 0)
        self._log.add(Made(strategy, 0))
        self._client.needle_out()

    def _calibrate(self, strategy: str) -> None:
        self._procedure(self._client.start_calibration)
        self._set(strategy, self._goal(strategy))
        self._calibrated = strategy

    def _goal(self, strategy: str) -> GoalBelief:
        """The paper stops below one pixel of the image looked at; adaptive by the room's own goal.

        A room stops by a probability: the least that it allows comes nearest to the paper's rule.
        """
        if STRATEGIES[strategy].fuses:
            return self._study.goal
        state = self._idle()
        assert state.slice is not None, "there was a calibration"
        least, most = _belief(state).settings.tolerance_mm
        pixel_mm = max(state.slice.spacing_mm) / STRATEGIES[strategy].fine.factor
        if not least <= pixel_mm <= most:
            raise StudyEndedError(
                f"{strategy} stops below one pixel, {pixel_mm:g} mm; the room allows {least:g} to "
                f"{most:g} mm: set service.tolerance_range_mm in its file"
            )
        least_sure = _belief(state).settings.confidence[0]
        return self._study.goal.model_copy(
            update={"tolerance_mm": pixel_mm, "confidence": least_sure}
        )

    def _set(self, strategy: str, goal: GoalBelief) -> None:
        wanted = {**goal.model_dump(), "strategy": strategy or goal.strategy}
        if _belief(self._idle()).goal.model_dump() != wanted:
            self._client.change_settings(**wanted)

    def _puncture(self, strategy: str, number: int) -> None:
        """One more: from a random point to the target, and the needle."""
        state = self._settled()
        counted = {one.procedure_id for one in self._log.made}
        if not (state.ready and state.arrival and state.arrival.procedure_id not in counted):
            self._unlock(state)
            self._set(strategy, self._goal(strategy))
            self._go_away(number)
            self._procedure(self._client.start_approach)
            state = self._wait(lambda s: s.ready or s.ready_lost, "READY")
        arrival = state.arrival
        if not state.ready or arrival is None:
            raise ProcedureEndedError(state.ready_lost.text if state.ready_lost else "not READY")
        if not state.punctured:
            self._ask_for_puncture(strategy, number)
            with contextlib.suppress(RefusedByServiceError):  # READY is over: the hole stays
                self._client.record_puncture()
        made = Made(
            strategy,
            number,
            arrival.procedure_id,
            arrival.error_mm,
            arrival.sigma_mm,
            arrival.iterations,
            arrival.frames,
            self._minutes(arrival.procedure_id),
        )
        self._log.add(made)
        self._client.needle_out()

    def _ask_for_puncture(self, strategy: str, number: int) -> None:
        self._ask(
            f"{strategy}, puncture {number + 1} of {self._study.punctures}: push the needle "
            "through the sheet once and take it out (if it was already done, do not do it again)."
        )

    def _unlock(self, state: RoomState) -> None:
        if state.robot.insertion_locked:
            self._ask(
                "Motion is locked: check that the needle is withdrawn; motion is then unlocked."
            )
            self._client.needle_out()

    def _go_away(self, number: int) -> None:
        """To a random point, the same for every strategy."""
        state = self._idle()
        calibration = _belief(state).calibration
        if calibration is None:
            raise ProcedureEndedError("the room has to be calibrated again")
        rng = np.random.default_rng((self._study.seed, number))
        for axis in sorted(calibration.per_axis):
            low, high = state.robot.travel_um[axis]
            point_um = 1000 * rng.uniform(-RANDOM_POINT_MM, RANDOM_POINT_MM)
            goal_um = round(min(max(point_um, low), high))
            away_um = goal_um - state.robot.positions_um[axis]
            while away_um:
                jog_um = min(max(away_um, -LONGEST_JOG_UM), LONGEST_JOG_UM)
                self._procedure(partial(self._client.jog, axis, jog_um))
                away_um -= jog_um

    def _minutes(self, procedure_id: int) -> float:
        """From the start of an approach to its end, by the events of the room."""
        after = max(0, self._look().event_id - _LOOKED_BACK)
        events = self._events(after)
        mine = [event for event in events if event.body.get("procedure_id") == procedure_id]
        ended_s = [event.wall_s for event in mine if event.kind == "procedure_done"]
        return (ended_s[0] - mine[0].wall_s) / 60 if ended_s else 0.0

    def _procedure(self, start: Callable[[], int]) -> None:
        """Start it, wait for its end; ProcedureEndedError unless it is done."""
        before, number = self._begin(start)

        def end() -> EventBody | None:
            events = self._events(before)
            ends = (e for e in events if e.kind.startswith("procedure_"))
            return next((e for e in ends if e.body.get("procedure_id") == number), None)

        self._wait(lambda s: s.procedure is None and end() is not None, "it is done")
        event = end()
        assert event is not None
        if event.kind != "procedure_done":
            raise ProcedureEndedError(str(event.body.get("reason", event.kind)))

    def _begin(self, start: Callable[[], int]) -> tuple[int, int]:
        """The last event before, and the procedure's number; again where the robot was stopped in
        that instant."""
        while True:
            before = self._idle().event_id
            try:
                return before, start()
            except RefusedByServiceError as error:
                if error.status != _NOT_NOW or _could_move(self._look()):
                    raise

    def _idle(self) -> RoomState:
        """Once nothing runs and the robot could move."""
        return self._wait(_could_move, "the robot is armed and stands still")

    def _settled(self) -> RoomState:
        return self._wait(lambda s: s.procedure is None and s.robot.linked, "the room is done")

    def _wait(self, wanted: Callable[[RoomState], object], what: str) -> RoomState:
        """Look until it is so; what a person has to do meanwhile is told once."""
        while True:
            state = self._look()
            if wanted(state):
                self._told = ""
                return state
            if state.question or state.procedure is None:
                self._tell_once(f"waiting until {what}; the room's page says: {state.prompt}")
            time.sleep(_POLL_S)

    def _tell_once(self, text: str) -> None:
        if text != self._told:
            self._tell(text)
            self._told = text

    def _look(self) -> RoomState:
        return self._read(self._client.state)

    def _events(self, after: int) -> list[EventBody]:
        return self._read(partial(self._client.events, after=after))

    def _read(self, look: Callable[[], Seen]) -> Seen:
        """Look again while the service is gone or too busy, for a while."""
        deadline_s = time.monotonic() + _GONE_S
        while True:
            try:
                return look()
            except (ServiceGoneError, RefusedByServiceError) as error:
                busy = getattr(error, "status", _BUSY) == _BUSY
                if not busy or time.monotonic() > deadline_s:
                    raise StudyEndedError(f"{error}; run this again to continue") from error
            time.sleep(_POLL_S)


def _could_move(state: RoomState) -> bool:
    robot = state.robot
    return (
        state.belief is not None
        and state.procedure is None
        and robot.linked
        and robot.armed
        and not robot.stopped
        and not robot.moving
        and robot.position_certain
    )


def _belief(state: RoomState) -> BeliefState:
    assert state.belief is not None, "waited for"
    return state.belief


def with_places(
    strategies: Sequence[str],
    seed: int,
    made: Sequence[Made],
    places: Mapping[str, NDArray[np.float64]],
) -> NavigationStudy:
    """What was made and where it was measured, in the form of the virtual studies.

    places (n, 2) mm by strategy; on a photo nobody knows which hole is the first, and the scatter
    does not depend on it.
    """
    results: dict[str, tuple[GroupResult, ...]] = {}
    for name in strategies:
        mine = sorted((one for one in made if one.strategy == name), key=lambda one: one.number)
        away_mm = places[name][1:] - places[name][0]
        punctures = tuple(
            Puncture(
                (float(y), float(x)),
                one.estimated_error_mm,
                one.sigma_mm,
                math.nan,
                one.iterations,
                one.frames,
                one.minutes,
            )
            for one, (x, y) in zip(mine[1:], away_mm, strict=True)
        )
        group = Group("benchtop", name, seed, len(mine))
        results[name] = (GroupResult(group, punctures, ()),)
    return NavigationStudy("benchtop", results)
