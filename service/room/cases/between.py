"""The room with no case open: it shows the robot, answers STOP, and begins a case."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import structlog

from case_record.cases import Cases
from room_config.load import Config
from service.room.alarm_list import Condition
from service.room.cases.held import HeldSlices
from service.room.cases.life import begin, reopen
from service.room.refusal import ConflictError
from service.room.state import AlarmState, ProcessState, RobotState, RoomState

log = structlog.get_logger()


class BetweenCases:
    """`problem`: why the case that is named as open cannot be worked on; empty: none is open."""

    def __init__(self, config: Config, cases: Cases, problem: str = "") -> None:
        self._config = config
        self._cases = cases
        self._held = HeldSlices(cases)
        self.problem = problem

    def carry_out(self, name: str, arguments: Mapping[str, Any]) -> Any:
        """Carry out a command; raises ConflictError for those that need a case."""
        if name == "note_stop":
            log.warning("stop", **arguments)  # the bridge has it in its journal
            return None
        if name == "begin_case":
            words = {key: value for key, value in arguments.items() if key != "by"}
            return begin(self._cases, self._config.room.name, arguments["by"], words).name
        if name == "reopen_case":
            return reopen(self._cases, arguments["folder"], arguments["by"]).name
        text = self.problem or "No case is open. Start one first (New case)."
        raise ConflictError("no_case", text)

    def keep_ready(self) -> None:
        """Nothing is ready."""

    def look_for_plans(self) -> None:
        """Nothing is proposed without a case."""

    def describe(
        self,
        before: RoomState,
        robot: RobotState,
        processes: list[ProcessState],
        wrong: Callable[[RoomState], Sequence[Condition]],
        now_s: float,
    ) -> RoomState:
        """What a screen shows: nothing of any case."""
        state = RoomState.initial(self._config).model_copy(
            update={
                "revision": before.revision,
                "service_id": before.service_id,
                "at_s": now_s,
                "robot": robot,
                "processes": processes,
                "holding": self._held.look(),
                "prompt": self._prompt(robot),
            }
        )
        since_s = {alarm.code: alarm.since_s for alarm in before.alarms}
        alarms = [
            AlarmState(**vars(one), since_s=since_s.get(one.code, now_s)) for one in wrong(state)
        ]
        state = state.model_copy(update={"alarms": alarms})
        same = state.model_copy(update={"at_s": before.at_s}) == before
        return state.model_copy(update={"revision": before.revision + (not same)})

    def conditions(self) -> list[Condition]:
        """What is wrong with the cases."""
        if not self.problem:
            return []
        what = "Start a new case. Nothing in that folder has been changed."
        return [Condition("case_unusable", "alarm", self.problem, what)]

    def _prompt(self, robot: RobotState) -> str:
        if self.problem:
            return f"{self.problem} Start a new case."
        if robot.linked and robot.insertion_locked:
            return (
                "Motion is locked for a needle. Start a case, then confirm when the needle is "
                "withdrawn."
            )
        return "Start a case."
