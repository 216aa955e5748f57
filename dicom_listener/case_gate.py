"""What the open case takes of what arrives, and to whom it is bound.

A case takes what is of its own patient and study. Before its first used slice it takes only what
would do for one of its holds, so that nothing of a patient on somebody else's table lies in its
folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from case_record.record import CaseRecord
from case_record.rows import Event, NewSlice
from dicom_listener.belonging import (
    ACCEPTED,
    BOUND,
    HELD,
    SAME_PATIENT,
    Binding,
    after_event,
    event_body,
    may_be_same_patient,
    why_not_of,
)
from dicom_listener.holding_area import INBOX, Arrival, HoldingArea
from dicom_slice.patient import Identity
from dicom_slice.reasons import Reason, SetAside

TAKEN = "slices_taken"
# it would do, and came for a hold of this case: what becomes of the next ones depends on it
_AT_A_HOLD = frozenset(
    {
        Reason.OUTSIDE_HOLD,
        Reason.AFTER_INCOMPLETE_HOLD,
        Reason.RECEIVED_AFTER_HOLD,
        Reason.NOT_EXPECTED,
        Reason.LATE,
        Reason.FUTURE,
        Reason.NO_TIME,
        Reason.IMPLAUSIBLE_TIME,
        Reason.CLOCK_UNKNOWN,
        Reason.NOT_CONFIRMED,
    }
)
_SOURCE = "listener"


class CaseGate:
    """`area` None: the room has this case only, and whatever arrives is recorded in it.

    binding: None until a slice was used. to_take: studies that wait in the holding area and have
    turned out to be this case's own.
    """

    def __init__(self, record: CaseRecord, area: HoldingArea | None = None) -> None:
        self._record = record
        self._area = area
        self.binding: Binding | None = None
        self.to_take: list[str] = []

    def why_elsewhere(self, arrival: Arrival, rows: Sequence[NewSlice]) -> SetAside | None:
        """Why the file does not go into this case, or None."""
        if self._area is None:
            return None
        whose = arrival.identity
        if not whose.study:
            return SetAside(Reason.UNKNOWN_STUDY, _reason_of(rows, "its study is unknown"))
        if self.binding is not None and whose.study in self.binding.studies:
            why = why_not_of(self.binding, whose)
            return why if why is not None and why.code == Reason.OTHER_PATIENT else None
        other = self._area.holding.case_of(whose.study)
        if other not in (None, self._record.case_dir.name):
            return SetAside(Reason.OTHER_CASE, f"its study belongs to case {other}")
        if self.binding is not None:
            return why_not_of(self.binding, whose)
        if any(row.state != "quarantined" or row.reason_code in _AT_A_HOLD for row in rows):
            return None
        reason = _reason_of(rows, "set aside")
        return SetAside(Reason.NO_SLICE_USED, f"{reason}; no slice of this case has been used yet")

    def hold(self, arrival: Arrival, why: SetAside) -> None:
        """Keep the file out of the case, whose record says that, and no more of whom it shows."""
        assert self._area is not None
        self._area.keep(arrival, why)
        body: dict[str, object] = {"code": str(why.code)}
        if why.code == Reason.OTHER_CASE:
            body[SAME_PATIENT] = may_be_same_patient(self.binding, arrival.identity)
        self._record.append_event(HELD, body, source=_SOURCE)

    def bring_in(self, path: Path) -> None:
        """Move the file into the case's inbox. OSError: it lies where it was."""
        if self._area is not None:
            self._area.give(path, self._record.case_dir / INBOX)

    def used(self, whose: Identity) -> None:
        """A slice is used: the first one binds the case."""
        if self.binding is None and whose.study:
            self._record.append_event(BOUND, event_body(whose), source=_SOURCE)
            self._bind(Binding.to(whose), whose.study)

    def heed(self, event: Event, *, replaying: bool) -> None:
        """What the record says of the binding, by whomever."""
        binding = after_event(self.binding, event.kind, event.body)
        if replaying:
            self.binding = binding
        elif binding != self.binding and binding is not None:
            self._bind(binding, event.body["study"])
        if event.kind == TAKEN and not replaying:
            self.to_take.append(event.body["study"])

    def _bind(self, binding: Binding, study: str) -> None:
        self.binding = binding
        if self._area is not None:
            self._area.holding.bind(study, self._record.case_dir.name)
            self.to_take.append(study)


def _reason_of(rows: Sequence[NewSlice], default: str) -> str:
    return next((row.reason for row in rows if row.reason), default)


def recorded_binding(record: CaseRecord) -> Binding | None:
    """What a case is bound to, as its record says."""
    events = [*record.events_of_kind(BOUND), *record.events_of_kind(ACCEPTED)]
    binding = None
    for event in sorted(events, key=lambda event: event.event_id):
        binding = after_event(binding, event.kind, event.body)
    return binding
