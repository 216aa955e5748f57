"""Commands to the case itself: finish it, go on with one of another day, take slices in."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from dicom_listener.taking import TakingError, accept_frame, take_study
from robot_bridge.client.client import BridgeError
from service.room.cases.life import CONTINUED, FINISHED, CaseLife
from service.room.context import RoomContext
from service.room.refusal import ConflictError
from service.room.validity import needle_may_be_in

WHILE_ASKING = frozenset({"note_stop", "continue_case", "finish_case", "needle_out"})


class CaseCommands:
    """What may be asked of the open case."""

    def __init__(self, room: RoomContext, life: CaseLife) -> None:
        self._room = room
        self._life = life

    def check(self, name: str) -> None:
        """Raise ConflictError for an order that has to wait until somebody says: go on."""
        if self._life.asks and name not in WHILE_ASKING:
            raise ConflictError(
                "case_of_another_day",
                "This case was left open on another day: first continue it or finish it.",
            )

    def begin_case(self, by: str, **_: str) -> str:
        """There is one already."""
        described = self._room.record.last_event("case_described")
        label = str(described.body.get("label") or "") if described else ""
        name = f"{self._room.record.case_dir.name}{f' ({label})' if label else ''}"
        raise ConflictError("case_open", f"Case {name} is open: finish it before starting another.")

    def reopen_case(self, folder: str, by: str) -> str:
        """Only where none is open."""
        return self.begin_case(by)

    def finish_case(self, by: str, park: bool = False) -> str:
        """Nothing moves in this case any more: disarm, take the power off if wished, and close it.

        park: the drives as well, which a robot out of reach refuses.
        Return the name of its folder. The needle must be out, and no procedure may run.
        """
        room, cases = self._room, self._life.cases
        cases.check_may_change()
        if room.record.running_procedure() is not None:
            raise ConflictError("busy", "A procedure is running: let it finish, or end it.")
        status = room.link.status
        locked = status is not None and status.insertion_locked
        if locked or needle_may_be_in(room.record):
            raise ConflictError(
                "needle_in",
                "The needle may be in: confirm that it is withdrawn, then finish the case.",
            )
        self._disarm(by, park)
        with room.record.transaction():
            room.record.end_open_hold(time.time())
            room.note(FINISHED, by, {"linked": status is not None})
        cases.set_open(None)
        return room.record.case_dir.name

    def _disarm(self, by: str, park: bool) -> None:
        """Without a link there is nothing to disarm: the bridge has stopped by itself."""
        client, status = self._room.link.client, self._room.link.status
        if status is None:
            if park:
                raise ConflictError("no_link", "The case stays open: no link to park the drives.")
            return
        try:
            if park and not status.parked:
                client.set_drives(on=False, by=by)
            if status.armed:
                client.disarm(by)
        except BridgeError as error:
            raise ConflictError("robot_refused", f"The case stays open: {error}") from error

    def continue_case(self, by: str) -> None:
        """Go on with the case of another day that was found open."""
        if self._life.asks:
            self._room.note(CONTINUED, by, {})
            self._life.asks = False

    def take_slices(self, study: str, by: str) -> None:
        """The slices of a study that wait in the holding area belong to this case."""
        self._refuse_while_measuring()
        try:
            take_study(self._room.record, self._life.cases.home, study, by)
        except TakingError as error:
            raise ConflictError("not_taken", str(error)) from error

    def accept_frame_of_reference(self, by: str) -> None:
        """The table was moved: the new frame of reference counts from now on."""
        self._refuse_while_measuring()
        try:
            accept_frame(self._room.record, by)
        except TakingError as error:
            raise ConflictError("no_new_frame", str(error)) from error

    def _refuse_while_measuring(self) -> None:
        if self._room.record.running_procedure() is not None:
            raise ConflictError(
                "busy",
                "A procedure is running and relies on the slices used so far: end it first.",
            )

    def all(self) -> tuple[Callable[..., Any], ...]:
        return (
            self.begin_case,
            self.reopen_case,
            self.finish_case,
            self.continue_case,
            self.take_slices,
            self.accept_frame_of_reference,
        )
