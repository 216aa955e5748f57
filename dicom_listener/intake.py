"""From the inbox into the case record: header, duplicates, assignment, one row a frame.

Runs in the listener's process, one file after the other. A file whose rows are in the record is
done; any other in the inbox is taken, also one that was received just before a crash.
"""

import sqlite3
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import tzinfo
from pathlib import Path
from typing import Any

import structlog

from case_record.record import CaseRecord
from case_record.rows import Event, Hold, NewSlice, SliceRow
from dicom_listener.assign import (
    AssignRules,
    Decision,
    HoldWindow,
    Known,
    Pending,
    Quarantined,
    assign,
)
from dicom_listener.case_gate import CaseGate
from dicom_listener.clock_offset import ClockRules, Comparison
from dicom_listener.holding_area import INBOX, Arrival
from dicom_listener.inbox import Envelope, Inbox, NotFromInboxError, read_envelope
from dicom_listener.known_uid import what_it_is
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.plans import PLAN_RECEIVED, plan_event
from dicom_listener.scanner_clocks import CLOCK_DOUBTED, ScannerClocks
from dicom_listener.slice_rows import (
    outcome_of,
    row_of,
    row_without_header,
    slice_from_record,
)
from dicom_slice.decode_guard import DecodeGuard
from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.header import Slice, read_header
from dicom_slice.reasons import Reason, SetAside, UnusableError
from dicom_slice.times import TimeFrame

SOURCE = "listener"
_HOLDS_LOOKED_AT = 64
_EVENTS_AT_ONCE = 1000
_KNOWN_AT_MOST = 1500
_KNOWN_AFTER_PRUNING = 1000
_WAITING_AT_MOST = 200

log = structlog.get_logger("listener")


@dataclass(frozen=True)
class IntakeRules:
    """What is usable, where it belongs, and what is known of the scanners' clocks beforehand."""

    slices: SliceRules = field(default_factory=SliceRules)
    assign: AssignRules = field(default_factory=AssignRules)
    clock: ClockRules = field(default_factory=ClockRules)
    zone: tzinfo | None = None
    comparison: Comparison | None = None


class Intake:
    """Owns this process's connection to the record; use it in the thread that made it."""

    def __init__(
        self,
        record: CaseRecord,
        inbox: Inbox,
        rules: IntakeRules,
        metrics: ListenerMetrics,
        gate: CaseGate | None = None,
    ) -> None:
        """gate: what of all that arrives goes into this case; None: everything."""
        self._record = record
        self._gate = gate or CaseGate(record)
        self._inbox = inbox
        self._rules = rules
        self._metrics = metrics
        self._decoder = DecodeGuard()
        self._clocks = ScannerClocks(rules.clock, rules.comparison)
        self._known: dict[int, Known] = {}
        self._pending: dict[int, Slice] = {}
        self._clockless: set[int] = set()  # of those, the ones that wait for the clock to be known
        self._is_flooded = False
        self._confirmed: set[int] = set()
        self._done: set[str] = set()
        self._seen_event_id = 0
        self._unheeded: deque[Event] = deque()
        self._seen_version = -1
        self._remember()

    def close(self) -> None:
        self._decoder.close()

    def _remember(self) -> None:
        """Rebuild from the record what an earlier run knew, in the order in which it came."""
        for row in self._record.slices():
            self._done.add(row.path)
            self._read_events(replaying=True, until=row)
            slice_ = self._slice_of(row)
            if slice_ is None:
                continue
            is_fresh = row.header["envelope"].get("is_fresh", True)
            self._clocks.observe(slice_, row.received_s, is_fresh=is_fresh)
            if row.state == "pending":
                self._pending[row.slice_id] = slice_
                self._note_clockless(row.slice_id, row.reason_code)
            self._know(row.slice_id, slice_, row)
        self._read_events(replaying=True)
        self._tell_doubts()

    @property
    def clock_doubts(self) -> list[dict[str, Any]]:
        """What slices have shown against what is known of the scanners' clocks."""
        return self._clocks.doubts

    def recall_doubts(self, doubts: Iterable[Mapping[str, Any]]) -> None:
        """What was seen in the case before counts in this one."""
        self._clocks.recall(doubts)
        self._tell_doubts()

    def _tell_doubts(self) -> None:
        for body in self._clocks.take_doubts():
            self._event(CLOCK_DOUBTED, body)

    def _know(self, slice_id: int, slice_: Slice, row: NewSlice) -> None:
        """Keep a usable slice for the decisions to come.

        Of those that no decision can rest on any more, the oldest are forgotten.
        """
        if why_not_usable(slice_, self._rules.slices) is not None:
            return
        self._known[slice_id] = Known(slice_, row.received_s, row.hold_id, row.reason_code)
        if len(self._known) <= _KNOWN_AT_MOST:
            return
        too_many = len(self._known) - _KNOWN_AFTER_PRUNING
        idle = [id_ for id_, known in self._known.items() if not known.may_still_count]
        for id_ in idle[:too_many]:
            del self._known[id_]

    @staticmethod
    def _slice_of(row: SliceRow) -> Slice | None:
        return slice_from_record(row.header) if "sop_class_uid" in row.header else None

    # The loop's pieces

    def left_over(self) -> list[Path]:
        """Inbox files that the record does not have yet, oldest first."""
        for path in self._inbox.files():
            if self._named(path) in self._done:  # a power cut took the last move back
                self._gate.bring_in(path)
        folders = {self._inbox.folder, self._record.case_dir / INBOX}
        found = [path for folder in folders for path in folder.glob("*.dcm")]
        new = [path for path in found if self._named(path) not in self._done]
        return sorted(new, key=lambda path: path.name)

    def look_at_record(self) -> None:
        """Follow what the other processes wrote: holds, confirmations, syncs, re-assignments."""
        version = self._record.data_version()
        if version == self._seen_version:
            return
        self._seen_version = version
        self._read_events(replaying=False)
        self._let_go()
        self._decide_pending()

    def take(self, path: Path) -> None:
        """Record one inbox file. Raises nothing for what is in it, sqlite3.Error for the record."""
        name = self._named(path)
        if name in self._done or not path.exists():
            return
        try:
            envelope = self._envelope(path)
        except NotFromInboxError as error:
            self._done.add(name)
            self.alarm("foreign_file", str(error))
            return
        before = self._record.slices(sop_instance_uid=envelope.sop_instance_uid)
        if any(row.sha256 == envelope.sha256 for row in before):
            self._drop_duplicate(path, envelope)
            return
        # a sync or reset that was recorded before this slice came must count for it
        self._read_events(replaying=False)
        try:
            rows, slices = self._rows_of(path, name, envelope, before)
        except sqlite3.Error:
            raise
        except Exception as error:  # a fault of ours must not stop the slices behind this one
            log.exception("intake failed", path=name)
            reason = SetAside(Reason.UNREADABLE, f"internal error: {type(error).__name__}")
            rows, slices = [row_without_header(envelope, name, reason)], [None]
            self.alarm("intake_failed", f"{name}: {type(error).__name__}")
        arrival = Arrival.of_file(path, envelope, slices)
        elsewhere = self._gate.why_elsewhere(arrival, rows)
        if elsewhere is not None:
            self._gate.hold(arrival, elsewhere)
            return
        self._gate.bring_in(path)
        self._write(rows, slices, envelope)
        self._note_plan(path, rows, envelope)
        self._done.add(name)
        self._let_go()
        if self._clocks.has_news:
            self._decide_pending()
        self._metrics.intake_seconds.observe(max(0.0, time.time() - envelope.received_s))

    def set_aside(self, path: Path, text: str) -> None:
        """Record one inbox file that is not to be read; for the rest as `take`."""
        name = self._named(path)
        if name in self._done or not path.exists():
            return
        envelope = self._envelope(path)
        reason = SetAside(Reason.UNREADABLE, text)
        self._write([row_without_header(envelope, name, reason)], [None], envelope)
        self._done.add(name)
        self.alarm("intake_failed", f"{name}: {text}")

    def alarm(self, kind: str, text: str) -> None:
        """Count, log and record something that a person should know of."""
        self._metrics.alarms.labels(kind).inc()
        log.warning(kind, text=text)
        self.note_alarm(kind, text)

    def note_alarm(self, kind: str, text: str) -> None:
        """Record an alarm that was counted and logged where it arose."""
        self._event("alarm", {"alarm": kind, "text": text})

    # One file

    @staticmethod
    def _named(path: Path) -> str:
        """Under what name the record has a file, wherever it lies yet."""
        return f"{INBOX}/{path.name}"

    def _envelope(self, path: Path) -> Envelope:
        envelope, _ = read_envelope(path)
        if envelope.sop_instance_uid:
            return envelope
        return replace(envelope, sop_instance_uid=f"none-{envelope.sha256[:32]}")

    def _drop_duplicate(self, path: Path, envelope: Envelope) -> None:
        """The same instance again with the same bytes: nothing to do, and one file is enough."""
        kept = self._record.slices(
            sop_instance_uid=envelope.sop_instance_uid, sha256=envelope.sha256
        )[0]
        kept_path = self._record.case_dir / kept.path
        if kept_path != path and kept_path.exists():
            path.unlink()
        self._done.add(self._named(path))
        self._metrics.duplicates.inc()
        self._event("duplicate_slice", {"sop_instance_uid": envelope.sop_instance_uid})

    def _rows_of(
        self, path: Path, name: str, envelope: Envelope, before: Sequence[SliceRow]
    ) -> tuple[list[NewSlice], list[Slice | None]]:
        try:
            slices = self._read(path, envelope)
            usable = [s for s in slices if why_not_usable(s, self._rules.slices) is None]
            problems = self._decoder.check(path, usable) if usable else {}
        except UnusableError as error:
            reason = _without_path(error.reason, path)
            return [row_without_header(envelope, name, reason)], [None]
        for slice_ in slices:
            received_s, is_fresh = envelope.received_s, envelope.is_fresh
            for kind, text in self._clocks.observe(slice_, received_s, is_fresh=is_fresh):
                self.alarm(kind, text)
        self._tell_doubts()
        rows: list[NewSlice] = []
        known = None
        if before:
            known = what_it_is(self._record, self._decoder, path, slices, before)
        for slice_ in slices:
            against = known or self._against(slice_, envelope, problems)
            decision = against or self._assign(slice_, envelope.received_s, self._known_now(rows))
            arrival_mode = self._rules.assign.arrival_mode
            rows.append(row_of(slice_, envelope, name, decision, arrival_mode=arrival_mode))
        return rows, list(slices)

    def _read(self, path: Path, envelope: Envelope) -> list[Slice]:
        return read_header(path, TimeFrame(self._rules.zone, envelope.received_s))

    def _against(
        self,
        slice_: Slice,
        envelope: Envelope,
        problems: dict[int, UnusableError],
    ) -> SetAside | None:
        stated = slice_.sop_instance_uid
        if stated and stated != envelope.sop_instance_uid:
            return SetAside(
                Reason.UID_CONTRADICTION,
                "the data set's UID differs from the one it was sent under",
            )
        unusable = why_not_usable(slice_, self._rules.slices)
        if unusable is None and slice_.frame in problems:
            return problems[slice_.frame].reason
        return unusable

    def _known_now(self, rows: Sequence[NewSlice]) -> list[Known]:
        """Known slices, and the frames of the same file that were decided just now."""
        siblings = [
            Known(slice_from_record(row.header), row.received_s, row.hold_id, row.reason_code)
            for row in rows
            if row.state == "assigned"
        ]
        return [*self._known.values(), *siblings]

    def _assign(self, slice_: Slice, received_s: float, known: Sequence[Known]) -> Decision:
        wrong = self._clocks.wrong_duration(slice_, received_s)
        if wrong and not self._rules.assign.arrival_mode:
            return Quarantined(Reason.IMPLAUSIBLE_TIME, wrong)
        return assign(
            slice_,
            received_s,
            self._holds(),
            known,
            self._clocks.offset(slice_, received_s),
            self._rules.assign,
            self._gate.binding,
        )

    def _holds(self) -> list[HoldWindow]:
        holds = self._record.newest_holds(_HOLDS_LOOKED_AT)
        return [window_of(hold, hold.hold_id in self._confirmed) for hold in holds]

    def _write(self, rows: list[NewSlice], slices: list[Slice | None], envelope: Envelope) -> None:
        heeded = {"heeded_event": self._seen_event_id}
        rows = [replace(row, header={**row.header, **heeded}) for row in rows]
        with self._record.transaction():
            stored = [self._record.add_slice(row) for row in rows]
            self._event("slice_received", _event_body(rows, envelope))
        for row, slice_ in zip(stored, slices, strict=True):
            self._metrics.decided.labels(row.state, row.reason_code).inc()
            if slice_ is None:
                continue
            if row.state == "pending":
                self._pending[row.slice_id] = slice_
                self._note_clockless(row.slice_id, row.reason_code)
            self._know(row.slice_id, slice_, row)
            self._note_use(slice_, row.hold_id)
        if any(row.reason_code == Reason.UID_CONFLICT for row in rows):
            self.alarm("same_uid_other_bytes", f"{envelope.sop_instance_uid}: both are kept")

    def _note_plan(self, path: Path, rows: list[NewSlice], envelope: Envelope) -> None:
        """What is no image may be somebody's plan: the service puts it before the operator."""
        if rows[0].reason_code != Reason.NOT_MR:
            return
        here = self._record.case_dir / rows[0].path
        plan = plan_event(self._record, here if here.exists() else path, envelope)
        if plan is not None:
            self._event(PLAN_RECEIVED, plan)

    def _note_use(self, slice_: Slice, hold_id: int | None) -> None:
        if hold_id is not None:
            self._gate.used(slice_.identity)

    # What the other processes say

    def _read_events(self, *, replaying: bool, until: SliceRow | None = None) -> None:
        """Heed what was not heeded yet; or what had been when a slice was taken.

        Whatever the clocks said then: in the order of the record.
        """
        while self._unheeded or self._fetch_events():
            if until is not None and not _was_heeded_for(until, self._unheeded[0]):
                return
            event = self._unheeded.popleft()
            self._heed(event, replaying)

    def _fetch_events(self) -> bool:
        events = self._record.events(self._seen_event_id, _EVENTS_AT_ONCE)
        if events:
            self._seen_event_id = events[-1].event_id
            self._unheeded.extend(events)
        return bool(events)

    def _heed(self, event: Event, replaying: bool) -> None:
        kind, body = event.kind, event.body
        self._gate.heed(event, replaying=replaying)
        self._clocks.heed(kind, body, event.wall_s)
        if kind == "acquisition_confirmed":
            self._confirmed.add(int(body["hold_id"]))
        elif kind == "slice_reassigned" and not replaying:
            self._follow(self._record.slice(int(body["slice_id"])))

    def _follow(self, row: SliceRow) -> None:
        """Somebody else decided about a slice."""
        self._pending.pop(row.slice_id, None)
        slice_ = self._slice_of(row)
        if slice_ is not None:
            self._known[row.slice_id] = Known(slice_, row.received_s, row.hold_id, row.reason_code)
            self._note_use(slice_, row.hold_id)

    def _decide_pending(self) -> None:
        """Ask again for those that wait; for the clock's sake only when more is known of it."""
        clock_news = self._clocks.take_news()
        for slice_id, slice_ in list(self._pending.items()):
            if slice_id in self._clockless and not clock_news:
                continue
            row = self._record.slice(slice_id)
            if row.state != "pending":
                self._follow(row)
                continue
            earlier = [known for id_, known in self._known.items() if id_ < slice_id]
            later = [
                known
                for id_, known in self._known.items()
                if id_ > slice_id and known.hold_id is not None
            ]
            decision = self._assign(slice_, row.received_s, [*earlier, *later])
            state, hold_id, code, text = outcome_of(decision)
            self._note_clockless(slice_id, code)
            if (state, code, text) == (row.state, row.reason_code, row.reason):
                continue
            self._decide(row, decision, (state, hold_id, code, text))

    def _let_go(self) -> None:
        """Set aside what waits in vain, and the oldest of too many: a flood harms no other slice.

        A person may still say of each that it is of a hold.
        """
        oldest_s = time.time() - self._rules.clock.comparison_valid_s
        is_flood = len(self._pending) > _WAITING_AT_MOST
        if is_flood and not self._is_flooded:
            text = f"more than {_WAITING_AT_MOST} slices are pending: the oldest are set aside"
            self.alarm("many_slices_wait", text)
        self._is_flooded = is_flood or (self._is_flooded and bool(self._pending))
        for slice_id in list(self._pending):
            row = self._record.slice(slice_id)
            if row.state != "pending":
                self._follow(row)
                continue
            if len(self._pending) > _WAITING_AT_MOST:
                why = f"more than {_WAITING_AT_MOST} slices were pending"
            elif slice_id in self._clockless and row.received_s < oldest_s:
                why = "it was pending too long: the clocks were not compared"
            else:
                return
            text = f"{why} ({row.reason})"
            decision = Quarantined(Reason(row.reason_code), text)
            self._decide(row, decision, ("quarantined", None, row.reason_code, text))

    def _note_clockless(self, slice_id: int, code: str) -> None:
        waits = code == Reason.CLOCK_UNKNOWN
        (self._clockless.add if waits else self._clockless.discard)(slice_id)

    def _decide(
        self, row: SliceRow, decision: Decision, outcome: tuple[str, int | None, str, str]
    ) -> None:
        state, hold_id, code, text = outcome
        with self._record.transaction():
            self._record.decide_slice(
                row.slice_id,
                state=state,
                hold_id=hold_id,
                reason_code=code,
                reason=text,
                decided_by=SOURCE,
            )
            body = {"slice_id": row.slice_id, "state": state, "hold_id": hold_id, "reason": text}
            self._event("slice_decided", body)
        self._metrics.decided.labels(state, code).inc()
        if not isinstance(decision, Pending):
            slice_ = self._pending.pop(row.slice_id)
            self._clockless.discard(row.slice_id)
            self._known[row.slice_id] = Known(slice_, row.received_s, hold_id, code)
            self._note_use(slice_, hold_id)

    def _event(self, kind: str, body: dict[str, Any]) -> None:
        self._record.append_event(kind, body, source=SOURCE)


def _was_heeded_for(row: SliceRow, event: Event) -> bool:
    """Whether an event counted when a slice was taken; records of before do not say."""
    heeded = row.header.get("heeded_event")
    return event.seq < row.seq if heeded is None else event.event_id <= heeded


def window_of(hold: Hold, confirmed: bool) -> HoldWindow:
    return HoldWindow(
        hold.hold_id,
        hold.set_id,
        hold.settled_at_s,
        hold.ended_at_s,
        hold.expected_slices,
        confirmed,
    )


def _event_body(rows: Sequence[NewSlice], envelope: Envelope) -> dict[str, Any]:
    first = rows[0]
    return {
        "sop_instance_uid": first.sop_instance_uid,
        "path": first.path,
        "frames": len(rows),
        "assigned": sum(row.state == "assigned" for row in rows),
        "state": first.state,
        "hold_id": first.hold_id,
        "reason_code": first.reason_code,
        "reason": first.reason,
        "from": envelope.calling_ae_title,
        "received_s": envelope.received_s,
    }


def _without_path(reason: SetAside, path: Path) -> SetAside:
    return SetAside(reason.code, reason.text.removeprefix(f"{path}: "))
