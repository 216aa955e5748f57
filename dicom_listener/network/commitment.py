"""Storage Commitment (push model, SCP): consoles ask whether what they sent is safe here.

PS3.4 annex J. An instance is committed to if its file lies in an inbox, whole by its hash. The
report goes out on the same association where that still stands, else (or where it is not answered
there) on a new one to where the configuration says that the asking AE listens.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog
from pydicom.dataset import Dataset
from pynetdicom import AE, build_role
from pynetdicom.sop_class import (
    StorageCommitmentPushModel,
    StorageCommitmentPushModelInstance,
)

from dicom_listener.association_fix import mended
from dicom_listener.inbox import NotFromInboxError, is_whole, read_envelope

REQUEST = 1
_ALL_SAFE, _SOME_FAILED = 1, 2
_NO_SUCH_INSTANCE, _CLASS_CONFLICT = 0x0112, 0x0119
_NO_SUCH_ACTION, _INVALID, _RESOURCE_LIMITATION = 0x0123, 0x0115, 0x0213
_MOST_UNREPORTED = 32
_LOOK_AGAIN_S = 0.5
_REPORT_AFTER_S = 0.1  # a console may still be busy with the answer to its request

log = structlog.get_logger("listener")


class KeptInstances:
    """What lies in the folders, by SOP Instance UID; only files that are new are looked into.

    An instance may lie in several files: one that was sent twice does, until it is decided. Files
    are moved from folder to folder; `folders` names those first from which they come.
    """

    def __init__(self, folders: Callable[[], Sequence[Path]]) -> None:
        self._folders = folders
        self._classes: dict[str, dict[Path, str]] = {}  # UID: file: SOP class
        self._known: set[Path] = set()
        self._lock = threading.Lock()

    def problem(self, sop_class: str, uid: str) -> int | None:
        """The failure reason (PS3.3 C.14) of an instance that is not safe here; None: it is."""
        with self._lock:
            self._look()
            kept = list(self._classes.get(uid, {}).items())
        problem = _NO_SUCH_INSTANCE
        for path, kind in kept:
            try:
                if not is_whole(path):
                    continue
            except FileNotFoundError:
                self._forget(uid, path)
                continue
            except (OSError, NotFromInboxError):
                continue
            if kind == sop_class:
                return None
            problem = _CLASS_CONFLICT
        return problem

    def _look(self) -> None:
        for folder in self._folders():
            for path in folder.glob("*.dcm"):
                if path in self._known:
                    continue
                self._known.add(path)
                try:
                    envelope, _ = read_envelope(path)
                except NotFromInboxError:
                    continue
                except OSError:  # moved, or not to be read just now: it is looked at again
                    self._known.discard(path)
                else:
                    classes = self._classes.setdefault(envelope.sop_instance_uid, {})
                    classes[path] = envelope.sop_class_uid

    def _forget(self, uid: str, path: Path) -> None:
        with self._lock:
            self._classes.get(uid, {}).pop(path, None)
            self._known.discard(path)


@dataclass
class Commitment:
    """Answers requests for one listener. reports_to: AE title -> (host, port)."""

    kept: KeptInstances
    ae_title: str
    reports_to: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    on_unreported: Callable[[str], None] = lambda text: None
    _places: threading.Semaphore = field(
        default_factory=lambda: threading.Semaphore(_MOST_UNREPORTED)
    )

    def answer(
        self, who: str, action: int, asked: Dataset, tell: Callable[[int, Dataset], str]
    ) -> int:
        """The status of an N-ACTION; the report follows by itself.

        who: the AE title that asks. tell: sends (event type, event information) on its association,
        waits, and returns why that was not taken; empty where it was.
        """
        if action != REQUEST:
            return _NO_SUCH_ACTION
        if not asked.get("TransactionUID") or not asked.get("ReferencedSOPSequence"):
            return _INVALID
        if not self._places.acquire(blocking=False):
            return _RESOURCE_LIMITATION  # a console that answers no report asks on and on
        name = f"commitment {asked.TransactionUID}"
        threading.Thread(
            target=self._report, args=(who, asked, tell), name=name, daemon=True
        ).start()
        return 0x0000

    def report_on(self, asked: Dataset) -> tuple[int, Dataset]:
        """(event type, event information): which of the instances are safe, which are not."""
        report = Dataset()
        report.TransactionUID = asked.TransactionUID
        named = [
            (
                str(item.get("ReferencedSOPClassUID", "")),
                str(item.get("ReferencedSOPInstanceUID", "")),
            )
            for item in asked.ReferencedSOPSequence
        ]
        problems = [self.kept.problem(*names) for names in named]
        if any(problems):  # a file that was just being moved is found at the second look
            time.sleep(_LOOK_AGAIN_S)
        safe, failed = [], []
        for names, found in zip(named, problems, strict=True):
            one = Dataset()
            one.ReferencedSOPClassUID, one.ReferencedSOPInstanceUID = names
            problem = found and self.kept.problem(*names)
            if problem is None:
                safe.append(one)
            else:
                one.FailureReason = problem
                failed.append(one)
        if safe:
            report.ReferencedSOPSequence = safe
        if failed:
            report.FailedSOPSequence = failed
        return (_SOME_FAILED if failed else _ALL_SAFE), report

    def _report(self, who: str, asked: Dataset, tell: Callable[[int, Dataset], str]) -> None:
        try:
            event, report = self.report_on(asked)
            time.sleep(_REPORT_AFTER_S)
            why_not = tell(event, report)
            if not why_not or (who in self.reports_to and self._on_a_new_one(who, event, report)):
                return
            text = f"{who} could not be informed of transaction {asked.TransactionUID}: {why_not}"
        except Exception as error:  # whatever the peer does: it is told of it, or we say so
            text = f"{who} could not be informed of what is stored safely: {error}"
        finally:
            self._places.release()
        self.on_unreported(text)

    def _on_a_new_one(self, who: str, event: int, report: Dataset) -> bool:
        entity = AE(self.ae_title)
        entity.add_requested_context(StorageCommitmentPushModel)
        host, port = self.reports_to[who]
        role = build_role(StorageCommitmentPushModel, scp_role=True)
        association = mended(entity.associate(host, port, ae_title=who, ext_neg=[role]))
        if not association.is_established:
            return False
        answer: Any
        try:
            answer, _ = association.send_n_event_report(
                report, event, StorageCommitmentPushModel, StorageCommitmentPushModelInstance
            )
            return "Status" in answer and answer.Status == 0x0000
        finally:
            association.release()
