"""Since when what a case knows is good: a table that was moved, or a case opened again, ends it."""

from __future__ import annotations

from case_record.record import CaseRecord
from dicom_listener.belonging import ACCEPTED, BOUND, after_event

CASE_REOPENED = "case_reopened"


def places_good_since(record: CaseRecord) -> int:
    """The record's `seq` from which on places in the patient are still where they were.

    A study that was accepted with another frame of reference is one to which nothing compares.
    """
    since, binding = 0, None
    events = [*record.events_of_kind(BOUND), *record.events_of_kind(ACCEPTED)]
    for event in sorted(events, key=lambda event: event.seq):
        before, binding = binding, after_event(binding, event.kind, event.body)
        if before is not None and binding is not None:
            frame = binding.frame_of_reference
            if not frame or frame != before.frame_of_reference:
                since = event.seq
    return since


def calibration_good_since(record: CaseRecord) -> int:
    """As `places_good_since`; in a case that was opened again the robot may be another one, too."""
    reopened = record.last_event(CASE_REOPENED)
    return max(places_good_since(record), 0 if reopened is None else reopened.seq)
