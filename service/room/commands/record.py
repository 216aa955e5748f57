"""What the operator tells the record: slices, clocks, the case."""

from __future__ import annotations

import time

from dicom_listener.operator_actions import give_up_slices, reassign, reset_clock, why_not_by_hand
from dicom_listener.scanner_clocks import CLOCK_COMPARED
from service.room.context import RoomContext
from service.room.refusal import ConflictError


class RecordCommands:
    """Decisions and remarks of the operator; nothing moves by them."""

    def __init__(self, room: RoomContext) -> None:
        self._room = room

    def assign_slice(self, slice_id: int, hold_id: int | None, why: str, by: str) -> None:
        """Overrule the listener: the slice belongs to this hold, or (None) to none.

        What needs no clock of the scanner is checked for people too, and a reason is asked for.
        """
        record = self._room.record
        row = record.slice(slice_id)
        if hold_id is not None:
            refused = why_not_by_hand(record, row, record.hold(hold_id), self._planes_mm())
            if refused:
                text = f"Slice {slice_id} does not belong to hold {hold_id}: {refused}. Rescan."
                raise ConflictError("not_of_hold", text)
            if not why.strip():
                raise ConflictError(
                    "no_reason", "Give a reason why this slice belongs to that hold."
                )
        reassign(record, slice_id, hold_id, by, why.strip())

    def _planes_mm(self) -> tuple[float, ...]:
        guide = self._room.config.service.guide
        return () if guide is None else (guide.upper_slice_mm, guide.lower_slice_mm)

    def give_up_slices(self, hold_id: int, why: str, by: str) -> None:
        """No more slices will come of a hold: the next one need not be scanned again for it."""
        hold = self._room.record.hold(hold_id)
        if hold.ended_at_s is None and self._room.record.running_procedure() is not None:
            raise ConflictError(
                "busy",
                f"Slices are still being requested for hold {hold_id}: end the procedure first.",
            )
        give_up_slices(self._room.record, hold_id, by, why)

    def describe_case(self, by: str, **words: str) -> None:
        """Write down what the operator says about the case."""
        self._room.note("case_described", by, dict(words))

    def compare_clocks(self, by: str, offset_s: float, uncertainty_s: float) -> None:
        """The room's clock minus the scanner's, compared just now; the listener heeds the event."""
        body = {"offset_s": offset_s, "uncertainty_s": uncertainty_s, "at_s": time.time()}
        self._room.note(CLOCK_COMPARED, by, body)

    def forget_clock(self, why: str, by: str) -> None:
        """The scanner's clock was set, or seemed to be: slices wait for the next comparison."""
        reset_clock(self._room.record, by, why)
