"""Follows the open case: every received file goes into it, or waits in the holding area.

One intake at a time, made anew with each case; receiving itself never stops for it.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import structlog

from case_record.cases import Cases
from case_record.record import CaseRecord, CaseRecordError
from dicom_listener.case_gate import CaseGate, recorded_binding
from dicom_listener.holding_area import INBOX, NO_CASE, Arrival, HoldingArea
from dicom_listener.inbox import Inbox, NotFromInboxError, read_envelope
from dicom_listener.intake import Intake, IntakeRules
from dicom_listener.metrics import ListenerMetrics
from dicom_slice.patient import Identity
from dicom_slice.reasons import Reason, SetAside

_AGAIN_S = 1.0
_LEFT_OVER_CASES = 3
log = structlog.get_logger("listener")


class Reception:
    """`inbox` is the room's: what was received and has not found its place yet."""

    def __init__(
        self, cases: Cases, inbox: Inbox, rules: IntakeRules, metrics: ListenerMetrics
    ) -> None:
        self._cases = cases
        self._inbox = inbox
        self._rules = rules
        self._metrics = metrics
        self._area = None if cases.only is not None else HoldingArea(cases)
        self._folder: Path | None = None
        self._unusable: Path | None = None
        self._again_s = 0.0
        self._gate: CaseGate | None = None
        # a new case has what the service brought into it; not what came in the meantime
        self._doubts: list[dict[str, Any]] = []
        self.record: CaseRecord | None = None
        self.intake: Intake | None = None
        if self._area is not None:
            self._learn(self._area)

    def close(self) -> None:
        self._leave()
        if self._area is not None:
            self._area.close()

    def _learn(self, area: HoldingArea) -> None:
        """From the cases of before: whose studies are whose, and what a crash left in them."""
        knows = area.holding.knows_studies()
        folders = self._cases.folders()
        for folder in folders[-_LEFT_OVER_CASES:] if knows else folders:
            try:
                with CaseRecord(folder, read_only=True) as record:
                    binding = recorded_binding(record)
                    known = {row.path for row in record.slices()}
            except CaseRecordError:
                continue
            for study in binding.studies if binding and not knows else ():
                area.holding.bind(study, folder.name)
            if folder == self._cases.open:
                continue
            for path in sorted((folder / INBOX).glob("*.dcm")):
                if f"{INBOX}/{path.name}" not in known:
                    area.give(path, self._inbox.folder)

    # Following

    def follow(self) -> bool:
        """Turn to the case that is open now; True if it is another one than before."""
        folder = self._cases.open
        waits = folder is not None and folder == self._unusable
        if folder == self._folder or (waits and time.monotonic() < self._again_s):
            return False
        self._leave()
        self._folder = folder
        if folder is not None:
            self._enter(folder)
        return True

    def _enter(self, folder: Path) -> None:
        try:
            self.record = CaseRecord(folder, create=self._cases.only is not None)
        except CaseRecordError as error:
            # what comes is held: the service says what is wrong with the case, and what to do
            log.error("the open case cannot be used", error=str(error))
            self._folder, self._unusable = None, folder
            self._again_s = time.monotonic() + _AGAIN_S
            return
        self._unusable = None
        self._gate = CaseGate(self.record, self._area)
        self.intake = Intake(self.record, self._inbox, self._rules, self._metrics, self._gate)
        self.intake.recall_doubts(self._doubts)
        log.info("case", folder=str(folder))

    def _leave(self) -> None:
        if self.intake is not None:
            self._doubts = self.intake.clock_doubts
            self.intake.close()
        if self.record is not None:
            self.record.close()
        self.intake = self.record = self._gate = self._folder = None

    # What comes

    def left_over(self) -> list[Path]:
        """Files that have not found their place yet, oldest first."""
        if self.intake is not None:
            return self.intake.left_over()
        return [] if self._cases.only is not None else self._inbox.files()

    def take(self, path: Path) -> None:
        """Record one file in the open case, or let it wait. Raises sqlite3.Error, OSError."""
        if self.intake is not None:
            self.intake.take(path)
            return
        if self._area is None or not path.exists():
            return
        try:
            envelope, _ = read_envelope(path)
        except NotFromInboxError as error:
            log.warning("foreign_file", text=str(error))
            return
        self._area.keep(Arrival.of_file(path, envelope), NO_CASE)

    def set_aside(self, path: Path, text: str) -> None:
        """As `take`, of a file that is not to be read: nobody can say whose it is."""
        if self._area is None:
            if self.intake is not None:
                self.intake.set_aside(path, text)
        elif path.exists():
            why = SetAside(Reason.UNREADABLE, text)
            self._area.keep(Arrival(path, read_envelope(path)[0], Identity()), why)
            self.alarm("intake_failed", f"{path.name}: {text}")

    def turn(self) -> None:
        """Follow what other processes wrote, and take what turned out to be this case's own."""
        if self.intake is None:
            return
        self.intake.look_at_record()
        if self._gate is None or self._area is None:
            return
        while self._gate.to_take:
            for path in self._area.paths_of(self._gate.to_take[0]):
                self.intake.take(path)
            del self._gate.to_take[0]

    def alarm(self, kind: str, text: str) -> None:
        """Count, log and, where a case is open, record something that a person should know."""
        if self.intake is not None:
            self.intake.alarm(kind, text)
            return
        self._metrics.alarms.labels(kind).inc()
        log.warning(kind, text=text)

    def note_alarm(self, kind: str, text: str) -> None:
        """Record an alarm that was counted and logged where it arose."""
        if self.intake is not None:
            self.intake.note_alarm(kind, text)
