"""The holding area as the page shows it: what waits, why, and what may be done about it."""

from __future__ import annotations

import contextlib
import sqlite3
import time

from case_record.cases import Cases
from case_record.holding import HeldStudy, Holding
from case_record.record import CaseRecord, CaseRecordError
from dicom_listener.belonging import ACCEPTED, Binding
from dicom_listener.case_gate import recorded_binding
from dicom_slice.reasons import Reason
from service.room.alarm_list import Condition
from service.room.state import HeldState

_SHOWN_S = 600.0
_ARRIVING = {
    Reason.OTHER_PATIENT: "Slices of another patient are arriving",
    Reason.OTHER_STUDY: "Slices of another study are arriving",
    Reason.OTHER_CASE: "Slices of another case are arriving",
    Reason.OTHER_FRAME: "Slices of another frame of reference are arriving",
}
_WHAT_TO_DO = {
    Reason.OTHER_PATIENT: "They are held outside this case. Check who is on the table.",
    Reason.OTHER_STUDY: "They are held outside this case. If the technologist started a new "
    "study of this patient, add them to the case; earlier measurements and targets then "
    "become void.",
    Reason.OTHER_CASE: "They are held outside this case: they belong to an earlier case.",
    Reason.OTHER_FRAME: "They are set aside: the table or the patient was moved. To continue, "
    "accept the new frame of reference; earlier measurements and targets then become void.",
}


class HeldSlices:
    """Looks at the holding area again only when it has changed. Use it in one thread."""

    def __init__(self, cases: Cases) -> None:
        self._cases = cases
        self._holding: Holding | None = None
        self._change: tuple[int, int] | None = None
        self._studies: list[HeldStudy] = []

    def look(self, record: CaseRecord | None = None) -> list[HeldState]:
        """What waits; of another patient than the open case's no more than that it waits."""
        if self._cases.only is not None:
            return []
        with contextlib.suppress(sqlite3.Error, CaseRecordError):  # looked at again soon
            self._read()
        binding = None if record is None else recorded_binding(record)
        return [_state(one, binding, is_open=record is not None) for one in self._studies]

    def _read(self) -> None:
        if self._holding is None:
            self._holding = Holding(self._cases.home, read_only=True)
        change = self._holding.change()
        if change != self._change:
            self._studies = self._holding.studies()
            self._change = change


def _state(held: HeldStudy, binding: Binding | None, *, is_open: bool) -> HeldState:
    of_other = bool(
        binding and binding.patient and held.patient and held.patient != binding.patient
    )
    return HeldState(
        study="" if of_other else held.study,
        code=held.code,
        reason=held.reason,
        description="" if of_other else held.description,
        slices=held.slices,
        first_received_s=held.first_received_s,
        last_received_s=held.last_received_s,
        may_be_taken=is_open and bool(held.study) and not of_other,
    )


def arriving(record: CaseRecord) -> list[Condition]:
    """That slices come which are not this case's own, for a while after the last of them."""
    code = _held_lately(record) or _aside_lately(record)
    if code is None:
        return []
    return [Condition(code, "warning", _ARRIVING[code], _WHAT_TO_DO[code])]


def _held_lately(record: CaseRecord) -> Reason | None:
    held = record.last_event("slice_held")
    if held is None or not _is_late(held.wall_s) or held.body["code"] not in _ARRIVING:
        return None
    accepted = record.last_event(ACCEPTED)
    if accepted is not None and accepted.seq > held.seq:
        return None
    return Reason(held.body["code"])


def _aside_lately(record: CaseRecord) -> Reason | None:
    """The newest slice of the record was set aside because of whom, or where, it shows."""
    last = record.last_slice()
    if last is None or last.reason_code not in _ARRIVING or not _is_late(last.received_s):
        return None
    return Reason(last.reason_code)


def _is_late(wall_s: float) -> bool:
    return time.time() - wall_s < _SHOWN_S
