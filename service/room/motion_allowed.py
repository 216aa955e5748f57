"""What stands in the way of motion: nothing starts while the needle may be in, and so on."""

from __future__ import annotations

from case_record.record import CaseRecord
from service.room.refusal import ConflictError
from service.room.validity import Now, Readiness, needle_may_be_in, ready_arrival


def may_start(record: CaseRecord, now: Now) -> ConflictError | None:
    """Why the robot may not begin to move now, or None."""
    status = now.status
    if status is None:
        return ConflictError("no_link", "No link to the robot.")
    if record.running_procedure() is not None:
        return ConflictError("busy", "A procedure is running: let it finish, or end it.")
    if needle_may_be_in(record) or status.insertion_locked:
        return ConflictError("insertion_locked", "Motion is locked until the needle is withdrawn.")
    if status.stopped or not status.armed:
        return ConflictError("not_armed", "Re-arm the robot first.")
    return None


def lock_wanted(record: CaseRecord, readiness: Readiness | None) -> bool:
    """Whether the insertion lock is to be set: before READY is said, and while it may be in."""
    coming = readiness is not None and readiness.lost is None
    return needle_may_be_in(record) or (coming and ready_arrival(record) is not None)
