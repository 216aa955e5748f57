"""What stands in the way of an order: nothing starts while the needle may be in, and so on."""

from __future__ import annotations

from typing import Any

from case_record.record import CaseRecord
from robot_bridge.client.client import BridgeStatus
from service.procedure.registry import APPROACHES


class ConflictError(Exception):
    """Not now; the text says why and what to do. `code` is for programs."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


def may_start(record: CaseRecord, status: BridgeStatus | None) -> ConflictError | None:
    """Why the robot may not begin to move now, or None."""
    if status is None:
        return ConflictError("no_link", "No link to the robot.")
    if record.running_procedure() is not None:
        return ConflictError("busy", "A procedure is running: wait for its end or abort it.")
    if ready_arrival(record) is not None or status.insertion_locked:
        return ConflictError("insertion_locked", "Motion is locked until the needle is out.")
    if status.stopped or not status.armed:
        return ConflictError("not_armed", "Re-arm the robot first.")
    return None


def ready_arrival(record: CaseRecord) -> tuple[int, dict[str, Any]] | None:
    """The approach (id and result) whose target the needle guide is at, until the needle is out."""
    done = [record.last_procedure(name, "done") for name in APPROACHES]
    arrival = max((row for row in done if row), key=lambda row: row.procedure_id, default=None)
    if arrival is None or arrival.result is None or arrival.ended_s is None:
        return None
    if record.running_procedure() is not None:
        return None
    out = record.last_event("needle_out")
    if out is not None and out.wall_s > arrival.ended_s:
        return None
    return arrival.procedure_id, dict(arrival.result)
