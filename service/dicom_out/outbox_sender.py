"""One thread a destination: sends what waits, and after a failure again, later and later.

How long to wait lives in memory: after a restart everything that is open is due at once.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path

import structlog

from case_record.record import CaseRecord
from room_config.outputs import Destination, OutputsConfig
from service.dicom_out.make import output_of
from service.dicom_out.outbox_send import Attempt, Outcome, UnreachableError, send
from service.dicom_out.outbox_store import Delivery, OutboxStore

_LOOK_S = 0.2
_MOST_AT_ONCE = 50
log = structlog.get_logger()


class Backoff:
    """When something may be tried again: twice the wait after each failure, up to the longest."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._wait_s = 0.0
        self._due_s = 0.0

    def is_due(self) -> bool:
        return time.monotonic() >= self._due_s

    def failed(self) -> None:
        self._wait_s = min(max(self._first_s, 2 * self._wait_s), self._longest_s)
        self._due_s = time.monotonic() + self._wait_s

    def refused(self) -> None:
        """It was understood: asking often does not help."""
        self._wait_s = self._longest_s
        self._due_s = time.monotonic() + self._wait_s

    def succeeded(self) -> None:
        self._wait_s = self._due_s = 0.0


class Sender:
    """Owns the thread of one destination; `start` it, `stop` it, nothing else."""

    def __init__(self, case_dir: Path, destination: Destination, config: OutputsConfig) -> None:
        self._case_dir = case_dir
        self._destination = destination
        self._config = config
        self._line = self._backoff()
        self._each: dict[str, Backoff] = {}
        self._stopping = threading.Event()
        name = f"to {destination.name}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        self._stopping.set()
        self._thread.join(timeout_s)

    def is_alive(self) -> bool:
        return self._thread.is_alive()

    def _backoff(self) -> Backoff:
        return Backoff(self._config.retry_s, self._config.longest_retry_s)

    def _run(self) -> None:
        with OutboxStore(self._case_dir) as store, CaseRecord(self._case_dir) as record:
            while not self._stopping.is_set():
                due = self._due(store) if self._line.is_due() else []
                if due:
                    self._send(store, record, due)
                else:
                    self._stopping.wait(_LOOK_S)

    def _due(self, store: OutboxStore) -> list[Delivery]:
        """What was tried least goes first: one that breaks every association stops no other."""
        waiting = store.open_deliveries(self._destination.name)
        due = [one for one in waiting if self._may_go(one.name)]
        return sorted(due, key=lambda one: one.attempts)[:_MOST_AT_ONCE]

    def _may_go(self, name: str) -> bool:
        return name not in self._each or self._each[name].is_due()

    def _send(self, store: OutboxStore, record: CaseRecord, due: list[Delivery]) -> None:
        before = {one.name: one for one in due}
        files = [(one.name, output_of(one.name).path(self._case_dir)) for one in due]
        outcomes = set()
        try:
            for attempt in send(self._destination, self._config.timeout_s, files):
                self._note(store, record, before[attempt.name], attempt)
                outcomes.add(attempt.outcome)
                if self._stopping.is_set():
                    return
        except UnreachableError as error:
            self._line_failed(store, str(error))
            return
        # who only gives no answer, or has no room, is left in peace for a while
        if outcomes == {Outcome.LATER}:
            self._line.failed()
        else:
            self._line.succeeded()

    def _line_failed(self, store: OutboxStore, reason: str) -> None:
        self._line.failed()
        store.note_line(self._destination.name, reason)
        log.warning("destination unreachable", destination=self._destination.name, reason=reason)

    def _note(
        self, store: OutboxStore, record: CaseRecord, before: Delivery, attempt: Attempt
    ) -> None:
        """The event first: whoever is killed in between sends it again and says so again."""
        name, destination = attempt.name, self._destination.name
        body = {
            "output": name,
            "destination": destination,
            "sop_instance_uid": before.sop_instance_uid,
        }
        if attempt.outcome is Outcome.STORED:
            record.append_event("output_sent", body, source="outbox")
            store.tried(name, destination, "sent")
            store.note_line(destination)
            self._each.pop(name, None)
            return
        again = self._each.setdefault(name, self._backoff())
        if attempt.outcome is Outcome.LATER:
            again.failed()
            store.tried(name, destination, "waiting", attempt.reason)
            store.note_line(destination, attempt.reason)
        else:
            again.refused()
            if before.state != "refused":
                refusal = {**body, "reason": attempt.reason}
                record.append_event("output_refused", refusal, source="outbox")
            store.tried(name, destination, "refused", attempt.reason)
            store.note_line(destination)
        log.warning("output not stored", **body, reason=attempt.reason)
