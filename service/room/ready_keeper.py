"""Keeps READY true: the lock comes before it, and what does not hold any more is taken back."""

from __future__ import annotations

from robot_bridge.client.client import BridgeError
from service.room.context import SOURCE, RoomContext
from service.room.motion_allowed import lock_wanted
from service.room.validity import (
    READY,
    READY_LOST,
    Readiness,
    lost_since_ready,
    readiness,
    was_ready,
)


def keep_ready(room: RoomContext) -> None:
    """Set the insertion lock where it is wanted; write down when READY is said and when it is lost.

    Nobody asks for this: the control loop does it all the time.
    """
    found = readiness(room.record, room.now())
    _write_down(room, found)
    if _set_lock(room, found):
        _write_down(room, readiness(room.record, room.now()))


def _set_lock(room: RoomContext, found: Readiness | None) -> bool:
    """Set the lock if it is wanted and missing; whether it was set now."""
    status = room.link.status
    if status is None or status.insertion_locked or status.moving:
        return False
    if not lock_wanted(room.record, found):
        return False
    try:
        room.link.client.set_insertion_lock(True, SOURCE)
    except BridgeError:
        return False  # asked again at the next tick; until then there is no READY
    room.note("insertion_locked", SOURCE, {})
    return True


def _write_down(room: RoomContext, found: Readiness | None) -> None:
    if found is None:
        return
    said = was_ready(room.record, found.procedure_id)
    if found.ready and not said:
        names = ("measurement_id", "error_mm", "sigma_mm", "probability")
        numbers = {name: found.arrival.get(name) for name in names}
        room.note(READY, SOURCE, {"procedure_id": found.procedure_id, **numbers})
    if found.lost is None or not said:
        return
    if lost_since_ready(room.record, found.procedure_id) is None:
        body = {"procedure_id": found.procedure_id, "code": found.lost.code}
        room.note(READY_LOST, SOURCE, {**body, "reason": found.lost.text})
