"""What people say to the listener, by way of the record: each in an event that names them."""

import time

from case_record.record import CaseRecord

_SOURCE = "operator"


def reassign(record: CaseRecord, slice_id: int, hold_id: int | None, who: str, why: str) -> None:
    """An operator overrules: the slice belongs to this hold, or (None) to none. Who is recorded."""
    with record.transaction():
        record.decide_slice(
            slice_id,
            state="quarantined" if hold_id is None else "assigned",
            hold_id=hold_id,
            reason_code="operator" if hold_id is None else "",
            reason=why if hold_id is None else "",
            decided_by=who,
        )
        body = {"slice_id": slice_id, "hold_id": hold_id, "why": why}
        record.append_event("slice_reassigned", body, source=_SOURCE, who=who)


def sync_clock(record: CaseRecord, offset_s: float, uncertainty_s: float, who: str) -> None:
    """The two clocks were compared now: offset_s is ours minus the scanner's."""
    body = {"offset_s": offset_s, "uncertainty_s": uncertainty_s, "at_s": time.time()}
    record.append_event("clock_sync", body, source=_SOURCE, who=who)


def reset_clock(record: CaseRecord, who: str, why: str = "") -> None:
    """The scanner's clock was set: forget what was known of it, until the clocks are compared."""
    record.append_event("clock_reset", {"why": why}, source=_SOURCE, who=who)


def give_up_slices(record: CaseRecord, hold_id: int, who: str, why: str) -> int:
    """No more slices will come of this hold: none is missing, so no later one is doubted for it.

    Return how many were given up. Whoever says so knows that none was acquired and is on its way:
    this takes away the protection against a missing slice that turns up at the next hold.
    """
    with record.transaction():
        hold = record.hold(hold_id)
        there = len(record.slices(hold_id=hold_id, state="assigned"))
        missing = max(0, hold.expected_slices - there)
        if missing:
            record.expect_slices(hold_id, there)
        body = {"hold_id": hold_id, "expected": hold.expected_slices, "there": there, "why": why}
        record.append_event("slices_given_up", body, source=_SOURCE, who=who)
    return missing
