"""Report and export of every finished case, written into its folder by a thread of their own.

What could not be written (a full disk, a restart in between) is tried again, and is an alarm.
"""

from __future__ import annotations

import os
import queue
import shutil
import threading
from collections.abc import Sequence

import structlog

from case_record.cases import Cases
from case_record.record import CaseRecord, CaseRecordError
from service.room.alarm_list import Condition
from service.room.cases.life import is_finished
from service.web.documents import Documents
from service.web.problems import ProblemError

FOLDER = "papers"
_PAPERS = (("report", "report.html"), ("export", "case.zip"))
_AGAIN_S = 30.0
_LOOKED_AT = 5
log = structlog.get_logger()


class Papers:
    """`start` it, `close` it; `wanted` says that a case was finished."""

    def __init__(self, cases: Cases) -> None:
        self._cases = cases
        self._documents = Documents()
        self._queue: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="papers", daemon=True)
        self._problems: dict[str, str] = {}

    def start(self) -> None:
        if self._cases.only is None:
            self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._queue.put("")

    def wanted(self, folder: str) -> None:
        """The case in this folder was finished."""
        self._queue.put(folder)

    def conditions(self) -> Sequence[Condition]:
        """Whose papers could not be written, and why."""
        return [
            Condition(
                f"papers_{name}",
                "warning",
                f"Report or export of case {name} is missing: {why}",
                "Retrying. The record itself is complete.",
            )
            for name, why in list(self._problems.items())
        ]

    # In the thread of its own

    def _run(self) -> None:
        for name in self._without_papers():
            self._queue.put(name)
        while not self._closing.is_set():
            try:
                name = self._queue.get(timeout=_AGAIN_S if self._problems else None)
            except queue.Empty:
                for unwritten in list(self._problems):
                    self._write(unwritten)
                continue
            if name:
                self._write(name)

    def _without_papers(self) -> list[str]:
        """Of the newest finished cases, those that a crash left without."""
        found = []
        for folder in self._cases.folders()[-_LOOKED_AT:]:
            if folder == self._cases.open or (folder / FOLDER / _PAPERS[-1][1]).is_file():
                continue
            try:
                with CaseRecord(folder, read_only=True) as record:
                    if is_finished(record):
                        found.append(folder.name)
            except CaseRecordError:
                continue
        return found

    def _write(self, name: str) -> None:
        folder = self._cases.folder_of(name)
        try:
            (folder / FOLDER).mkdir(exist_ok=True, mode=0o700)
            for command, file in _PAPERS:
                made = self._documents.make(command, folder, file)
                part = folder / FOLDER / f"{file}.part"
                try:
                    shutil.copyfile(made, part)
                    os.replace(part, folder / FOLDER / file)
                finally:
                    shutil.rmtree(made.parent, ignore_errors=True)
        except (ProblemError, OSError) as error:
            self._problems[name] = str(error)
            log.warning("papers not written", case=name, why=str(error))
            return
        self._problems.pop(name, None)
