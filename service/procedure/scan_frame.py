"""What a position in a slice is relative to, and by which protocol it appears where it does.

A study or a frame of reference that begins anew may mean a table that has moved: nothing that was
seen before is where it was. A protocol with another bandwidth, imaging frequency or encoding
direction shows the fiducial's oil elsewhere beside the anatomy's water.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Measurement
from dicom_listener.belonging import ACCEPTED, BOUND, HELD, SAME_PATIENT, after_event
from dicom_slice.protocol import other_protocol
from dicom_slice.reasons import Reason

CASE_REOPENED = "case_reopened"


@dataclass(frozen=True)
class ScanFrame:
    """Of a slice, as its header says it; empty or None: the header does not say."""

    study: str = ""
    frame_of_reference: str = ""
    imaging_frequency_mhz: float | None = None
    pixel_bandwidth_hz: float | None = None
    phase_encoding_direction: str = ""

    @classmethod
    def of_header(cls, header: Mapping[str, Any]) -> ScanFrame:
        """From a slice's header as the case record keeps it."""
        return cls(
            str(header.get("study_instance_uid") or ""),
            str(header.get("frame_of_reference_uid") or ""),
            header.get("imaging_frequency_mhz"),
            header.get("pixel_bandwidth_hz"),
            str(header.get("phase_encoding_direction") or ""),
        )

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def other_place(self, other: ScanFrame) -> str:
        """What says that positions of the two need not be comparable; empty if nothing does."""
        if _differ(self.frame_of_reference, other.frame_of_reference):
            return "a different frame of reference"
        if _differ(self.study, other.study):
            return "a different study"
        return ""

    def other_protocol(self, other: ScanFrame) -> str:
        """What shows oil elsewhere beside water in the other's slices; empty if nothing does."""
        return other_protocol(self.to_json(), other.to_json())


STUDY_ACCEPTED = "study_accepted"


def newest_frame(record: CaseRecord) -> ScanFrame | None:
    """Of the newest slice that is used; None before the first one."""
    newest = record.last_slice("assigned")
    return None if newest is None else ScanFrame.of_header(newest.header)


def frame_of(record: CaseRecord, measurement: Measurement) -> ScanFrame | None:
    """Of the slices that were measured; None where the record does not say."""
    slice_id = (measurement.result or {}).get("slice_id")
    return None if slice_id is None else ScanFrame.of_header(record.slice(int(slice_id)).header)


def seen_seq(record: CaseRecord, measurement: Measurement) -> int:
    """From when on a measurement knows the scanner: its first slice, in the record's order."""
    slices = (measurement.result or {}).get("slice_ids", ())
    came = (record.slice(int(slice_id)).seq for slice_id in slices)
    return min(came, default=measurement.requested_seq)


def other_place_since(record: CaseRecord, seq: int, frame: ScanFrame) -> str:
    """What came after `seq` that says that the table may have moved since `frame`; empty if
    nothing did.
    """
    newest = newest_frame(record)
    if newest is not None and (other := frame.other_place(newest)):
        return other
    accepted = record.last_event(STUDY_ACCEPTED)
    if accepted is not None and accepted.seq > seq:
        study, reference = (
            str(accepted.body.get(k) or "") for k in ("study", "frame_of_reference")
        )
        if other := frame.other_place(ScanFrame(study, reference)):
            return other
    for came in record.scans_since(seq):
        if came["reason_code"] == Reason.OTHER_PATIENT:
            continue  # nobody's places in this case: see `others_since`
        if other := frame.other_place(ScanFrame.of_header(came)):
            return other
    return ""


def others_since(record: CaseRecord, seq: int) -> str:
    """Of whom else slices came after `seq` that wait outside of the case, or lie aside in it, and
    say that the table, or who lies on it, may have changed; empty if none did.

    What is pushed late of another patient's earlier case says nothing of the table.
    """
    for event in record.events_of_kind(HELD, after_seq=seq):
        code = event.body.get("code")
        if code == Reason.OTHER_PATIENT:
            return "a different patient"
        if code == Reason.OTHER_STUDY or event.body.get(SAME_PATIENT):
            return "a different study"
    came = record.scans_since(seq)
    return "a different patient" * any(one["reason_code"] == Reason.OTHER_PATIENT for one in came)


def _differ(mine: str, others: str) -> bool:
    """Two that are both known and not the same."""
    return bool(mine) and bool(others) and mine != others


def places_good_since(record: CaseRecord, until_seq: int | None = None) -> int:
    """The record's `seq` from which on places in the patient are still where they were, now or at
    `until_seq`.

    A study that was accepted with another frame of reference is one to which nothing compares.
    """
    since, binding = 0, None
    events = [*record.events_of_kind(BOUND), *record.events_of_kind(ACCEPTED)]
    for event in sorted(events, key=lambda event: event.seq):
        if until_seq is not None and event.seq > until_seq:
            break
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
