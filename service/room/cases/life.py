"""How a case begins, ends, and is found again at a start.

A case is begun and finished by a person; a crash in between changes nothing, the next start goes on
with it. One that was left open on another day is asked about first: the patient on the table may be
another one.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from case_record.cases import Cases
from case_record.connection import FILE_NAME
from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Event
from dicom_listener.scanner_clocks import CLOCK_COMPARED, CLOCK_DOUBTED, CLOCK_FORGOTTEN
from service.procedure.scan_frame import CASE_REOPENED

FINISHED, REOPENED, CONTINUED = "case_finished", CASE_REOPENED, "case_continued"
DESCRIBED = "case_described"
_STILL_COUNTS_S = 3600.0
_LOOKED_AT_CASES = 20
QUESTION = (
    "This case was left open on another day. Is this the patient on the table? Continue the "
    "case, or finish it."
)
_SOURCE = "service"
# who went on with a case past midnight is not asked after a crash in the middle of it
_LATELY_S = 3600.0
_LOOKED_AT = 200


class CaseLife:
    """Of the open case, for as long as this service works on it. `asks`: go on with it at all?"""

    def __init__(self, cases: Cases, record: CaseRecord, now_s: float) -> None:
        self.cases = cases
        self.asks = cases.only is None and is_of_another_day(record, now_s)


def is_finished(record: CaseRecord) -> bool:
    """Whether it was finished, and not opened again since."""
    finished, reopened = record.last_event(FINISHED), record.last_event(REOPENED)
    return finished is not None and (reopened is None or reopened.seq < finished.seq)


def is_of_another_day(record: CaseRecord, now_s: float) -> bool:
    """Whether the last thing that anybody did in this case was on another day, not just now."""
    last = _last_deed(record)
    if last is None:
        return False
    same_day = datetime.fromtimestamp(last.wall_s).date() == datetime.fromtimestamp(now_s).date()
    return not same_day and not 0 <= now_s - last.wall_s < _LATELY_S


def _last_deed(record: CaseRecord) -> Event | None:
    """The newest event that does not come by itself (slices do, also when nobody is there)."""
    before = None
    while batch := record.newest_events(_LOOKED_AT, before):
        for event in batch:
            if event.source in ("record", "operator") or event.source == _SOURCE:
                return event
        before = batch[-1].event_id
    return None


def set_at_rest(record: CaseRecord) -> None:
    """Nothing that was under way in a case of another day goes on: end procedure and hold."""
    running = record.running_procedure()
    with record.transaction():
        record.end_open_hold(time.time())
        if running is None:
            return
        reason = "the room was restarted on another day"
        record.end_procedure(running.procedure_id, "aborted", {"reason": reason})
        body = {"procedure_id": running.procedure_id, "name": running.name, "reason": reason}
        record.append_event("procedure_aborted", body, source="record")


def begin(cases: Cases, room: str, by: str, words: Mapping[str, str]) -> Path:
    """Begin a case and open it; return its folder. CaseRecordError where that cannot be.

    What is known of the scanner's clock is the room's, not the case's: it comes along.
    """
    known = _known_of_clocks(cases)
    folder = cases.make_folder()
    with CaseRecord(folder, create=True) as record, record.transaction():
        record.start_case(room, seed=0)
        record.append_event(DESCRIBED, dict(words), source=_SOURCE, who=by)
        _bring(known, record)
    cases.set_open(folder)
    return folder


def _known_of_clocks(cases: Cases) -> list[Event]:
    """What the room knows of the scanner's clock, oldest first, from the case that heard last.

    Since it was compared or set last, and of the last hour in any case: of two comparisons that do
    not agree, the later one says nothing of slices that were acquired before it. That this computer
    was set back is told in any case: what the room's file says may seem newer than it is.
    """
    newest: list[Event] = []
    by_use = sorted(cases.folders(), key=_changed_s)
    for folder in by_use[-_LOOKED_AT_CASES:]:
        try:
            with CaseRecord(folder, read_only=True) as record:
                found = _clock_events(record)
        except CaseRecordError:
            continue
        if found and (not newest or found[-1].wall_s >= newest[-1].wall_s):
            newest = found
    told = [event for event in newest if event.kind != CLOCK_DOUBTED]
    if not told:
        return newest
    late = [event for event in newest if event.wall_s >= newest[-1].wall_s - _STILL_COUNTS_S]
    kept = min(newest[newest.index(told[-1]) :], late, key=lambda events: events[0].event_id)
    set_back = [event for event in told if event.body.get("step_s", 0.0) < 0.0][-1:]
    return [event for event in set_back if event not in kept] + kept


def _changed_s(folder: Path) -> float:
    try:
        return (folder / FILE_NAME).stat().st_mtime
    except OSError:  # an open case that is not there
        return 0.0


def _clock_events(record: CaseRecord) -> list[Event]:
    kinds = (CLOCK_COMPARED, CLOCK_FORGOTTEN, CLOCK_DOUBTED)
    found = [event for kind in kinds for event in record.events_of_kind(kind)]
    return sorted(found, key=lambda event: event.event_id)


def _bring(known: list[Event], record: CaseRecord) -> None:
    """Into another case, each with the instants at which it was said first."""
    for event in known:
        body = {"monotonic_s": event.monotonic_s, "at_s": event.wall_s, **event.body}
        record.append_event(event.kind, body, source=_SOURCE, who=event.who)


def reopen(cases: Cases, name: str, by: str) -> Path:
    """Open a finished case again; CaseRecordError where there is none, or it cannot be written.

    Where the robot stands, and what it is calibrated to, is as good as unknown then.
    """
    folder = cases.named(name)
    known = _known_of_clocks(cases)
    with CaseRecord(folder) as record, record.transaction():
        record.append_event(REOPENED, {}, source=_SOURCE, who=by)
        if known != _clock_events(record)[-len(known) :]:
            _bring(known, record)
    cases.set_open(folder)
    return folder
