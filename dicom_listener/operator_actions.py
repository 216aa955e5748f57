"""What people say to the listener, by way of the record: each in an event that names them.

A person who overrules the listener knows what was scanned when; what cannot be true is refused all
the same. It is checked by all that needs no clock of the scanner: the listener's reasons that speak
of times and counts may be overruled, no others.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from case_record.record import CaseRecord
from case_record.rows import Hold, SliceRow
from dicom_listener.scanner_clocks import CLOCK_COMPARED, CLOCK_FORGOTTEN
from dicom_slice.geometry import SliceGeometry
from dicom_slice.reasons import Reason

_SOURCE = "operator"
BY_TIME = frozenset(
    {
        Reason.NO_TIME,
        Reason.IMPLAUSIBLE_TIME,
        Reason.FUTURE,
        Reason.LATE,
        Reason.CLOCK_UNKNOWN,
        Reason.NO_HOLD,
        Reason.RECEIVED_AFTER_HOLD,
        Reason.OUTSIDE_HOLD,
        Reason.NOT_EXPECTED,
        Reason.AFTER_INCOMPLETE_HOLD,
        Reason.OUT_OF_ORDER,
        Reason.NOT_CONFIRMED,
    }
)
_MADE_BY_PEOPLE = "operator"
_SAME_PLANE_MM = 0.5
_SAME_DIRECTION = 1e-3
_SAME_SPACING_MM = 1e-3


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
    record.append_event(CLOCK_COMPARED, body, source=_SOURCE, who=who)


def reset_clock(record: CaseRecord, who: str, why: str = "") -> None:
    """The scanner's clock was set: forget what was known of it, until the clocks are compared."""
    record.append_event(CLOCK_FORGOTTEN, {"why": why}, source=_SOURCE, who=who)


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


def why_not_by_hand(
    record: CaseRecord, row: SliceRow, hold: Hold, planes_mm: Sequence[float] = ()
) -> str:
    """Why a slice cannot be of a hold, whoever says so; empty if nothing speaks against it.

    planes_mm: where slices may lie along their normal besides where the last used one lies.
    """
    return (
        _why_not_at_all(row)
        or _why_not_then(record, row, hold)
        or _why_other(record, row, planes_mm)
    )


def offered_hold(record: CaseRecord, row: SliceRow, planes_mm: Sequence[float] = ()) -> Hold | None:
    """The hold for which a slice that was set aside may be offered: the one that stands."""
    hold = record.open_hold()
    if hold is None or row.state != "quarantined" or why_not_by_hand(record, row, hold, planes_mm):
        return None
    return hold


def _why_not_at_all(row: SliceRow) -> str:
    if not row.header.get("geometry"):
        return "it has no geometry"
    if row.reason_code and row.reason_code not in {*BY_TIME, _MADE_BY_PEOPLE}:
        return f"it was set aside for what it is, not for its time: {row.reason}"
    return ""


def _why_not_then(record: CaseRecord, row: SliceRow, hold: Hold) -> str:
    """By the order in which this computer saw things: slices before holds are not of them."""
    settled_s = hold.settled_monotonic_s
    before = settled_s is not None and row.received_monotonic_s < settled_s
    if before or row.seq < hold.begun_seq:
        return f"it was received before the robot settled at hold {hold.hold_id}"
    there = len(record.slices(hold_id=hold.hold_id, state="assigned"))
    if hold.ended_at_s is not None and there >= hold.expected_slices:
        return f"hold {hold.hold_id} has ended and has all its slices"
    return ""


def _why_other(record: CaseRecord, row: SliceRow, planes_mm: Sequence[float]) -> str:
    """Compared with the slice that was used last."""
    used = record.last_slice("assigned")
    if used is None:
        return ""
    for name, words in (
        ("study_instance_uid", "study"),
        ("frame_of_reference_uid", "frame of reference"),
    ):
        mine, others = row.header.get(name), used.header.get(name)
        if mine and others and mine != others:
            return f"it has a different {words} from the slices in use"
    return _why_other_geometry(_geometry(row.header), _geometry(used.header), planes_mm)


def _why_other_geometry(
    mine: SliceGeometry, used: SliceGeometry, planes_mm: Sequence[float]
) -> str:
    if mine.shape != used.shape:
        return f"its grid is {mine.shape}, that of the slices in use {used.shape}"
    if not np.allclose(mine.spacing_mm, used.spacing_mm, atol=_SAME_SPACING_MM):
        return (
            f"its pixels are {mine.spacing_mm} mm, those of the slices in use {used.spacing_mm} mm"
        )
    for name in ("row_direction", "col_direction"):
        if not np.allclose(getattr(mine, name), getattr(used, name), atol=_SAME_DIRECTION):
            return "it lies in a different plane from the slices in use"
    at_mm = float(mine.normal @ np.array(mine.position_mm))
    wanted_mm = [*planes_mm, float(used.normal @ np.array(used.position_mm))]
    if not min(abs(at_mm - one) for one in wanted_mm) <= _SAME_PLANE_MM:
        return f"it lies at {at_mm:.1f} mm, the slices in use at {wanted_mm[-1]:.1f} mm"
    return ""


def _geometry(header: Any) -> SliceGeometry:
    return SliceGeometry(**{name: tuple(value) for name, value in header["geometry"].items()})
