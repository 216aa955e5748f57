"""Why an order is refused, and which approach came to its end and waits for the needle."""

from __future__ import annotations

from typing import Any

from case_record.record import CaseRecord
from service.procedure.registry import APPROACHES


class ConflictError(Exception):
    """Not now; the text says why and what to do. `code` is for programs."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


def ready_arrival(record: CaseRecord) -> tuple[int, dict[str, Any]] | None:
    """The approach (id and result) that came to its end last, until the needle is out.

    What came first is said by the record's order. Whether the guide is at the target still is
    another question: `service.room.present.readiness`.
    """
    done = [record.last_procedure(name, "done") for name in APPROACHES]
    arrival = max((row for row in done if row), key=lambda row: row.procedure_id, default=None)
    if arrival is None or arrival.result is None or arrival.ended_s is None:
        return None
    if record.running_procedure() is not None:
        return None
    out = record.last_event("needle_out")
    if out is not None and out.seq > arrival.ended_seq:
        return None
    return arrival.procedure_id, dict(arrival.result)
