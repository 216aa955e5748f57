"""While the case record cannot be used: what is owed to it, and the state that is shown meanwhile.

A full or read-only disk, a vanished mount, a locked database end nothing. The loop holds: it keeps
the link alive, answers STOP, refuses every order with the reason, and begins again from the record
as soon as that can be written.
"""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass, field
from typing import Any

from case_record.record import CaseRecord
from service.room.alarm_list import Condition
from service.room.refusal import ConflictError
from service.room.state import AlarmState, LostState, MeasurementState, RobotState, RoomState

RECORD_FAULTS = (sqlite3.Error, OSError)
_SOURCE = "service"


@dataclass(eq=False)
class Trouble:
    """Why the loop holds, since when, and what must be recorded first of all."""

    why: str = ""
    since_s: float = 0.0
    since_monotonic_s: float = 0.0
    owed: list[tuple[str, str, dict[str, Any]]] = field(default_factory=list)
    abort: str = ""

    @property
    def is_there(self) -> bool:
        return bool(self.why)

    def begin(self, error: BaseException) -> bool:
        """Note the reason; True if it is a new one."""
        why = f"{type(error).__name__}: {error}"
        if not self.why:
            self.since_s, self.since_monotonic_s = time.time(), time.monotonic()
        is_new, self.why = why != self.why, why
        return is_new

    def owe_stop(self, by: str, emergency: bool) -> None:
        """A STOP that went out on the line but could not be recorded yet."""
        kind = "emergency" if emergency else "stop"
        self.owed.append((kind, by, {"pressed_s": time.time()}))
        self.abort = f"STOP by {by}"

    def settle(self, record: CaseRecord) -> None:
        """Record what is owed, all or nothing; raises as long as the record cannot be written."""
        if not (self.why or self.owed or self.abort):
            return
        with record.transaction():
            lasted_s = round(time.monotonic() - self.since_monotonic_s, 3)
            if self.why:
                body = {"why": self.why, "since_s": self.since_s, "lasted_s": lasted_s}
                record.append_event("record_usable_again", body, source=_SOURCE)
            for kind, by, body in self.owed:
                record.append_event(kind, body, source=_SOURCE, who=by)
            running = record.running_procedure()
            if self.abort and running is not None:
                record.end_procedure(running.procedure_id, "aborted", {"reason": self.abort})
                what = {"procedure_id": running.procedure_id, "name": running.name}
                body = {**what, "reason": self.abort}
                record.append_event("procedure_aborted", body, source=_SOURCE)
        self.why, self.abort, self.owed = "", "", []

    def refusal(self) -> ConflictError:
        text = (
            f"The case record cannot be used ({self.why}): no command is carried out until it "
            "can be."
        )
        return ConflictError("record_unusable", text)

    def condition(self) -> Condition:
        text = f"The case record cannot be used: {self.why}"
        what = (
            "Free space on the case's disk, or remount it. Motion is blocked until then; the room "
            "continues by itself."
        )
        return Condition("record_unusable", "alarm", text, what)


def _not_known(before: MeasurementState | None, wrong: Condition) -> MeasurementState | None:
    """Whether what was measured still holds cannot be looked up."""
    lost = LostState(code=wrong.code, text=wrong.text)
    return None if before is None else before.model_copy(update={"lost": lost, "age_s": None})


def held(before: RoomState, robot: RobotState, wrong: Condition, since_s: float) -> RoomState:
    """The state while the rest of it is not known: nothing in it says READY or asks for anything.

    since_s: since when `wrong` has stood.
    """
    alarm = AlarmState(**vars(wrong), since_s=since_s)
    others = [a for a in before.alarms if a.code != wrong.code]
    state = before.model_copy(
        update={
            "at_s": time.time(),
            "prompt": f"{wrong.text}. {wrong.what_to_do}",
            "ready": False,
            "arrival": None,
            "robot": robot,
            "jog_possible": False,
            "acquisition_request": None,
            "question": None,
            "error": None,
            "error_reason": wrong.text,
            "measurement": _not_known(before.measurement, wrong),
            "alarms": [alarm, *others],
        }
    )
    same = state.model_copy(update={"at_s": before.at_s}) == before
    return state.model_copy(update={"revision": before.revision + (not same)})
