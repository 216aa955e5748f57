"""The scanner's outbox: sends instances by C-STORE when they are due, and tries again.

While one is to be tried again the others wait behind it, so what could not be sent arrives in the
order in which it was due. One thread of its own, so that a slow or dead receiver never keeps the
scanner from scanning.
"""

import heapq
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Protocol

from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
from pynetdicom import AE
from pynetdicom.association import Association
from pynetdicom.sop_class import EnhancedMRImageStorage, MRImageStorage

from dicom_listener.association_fix import mended

_TRANSFER_SYNTAXES = [ExplicitVRLittleEndian, ImplicitVRLittleEndian]


@dataclass(frozen=True, order=True)
class Push:
    """One instance that waits to be sent; ordered by when it is due (time.monotonic)."""

    due_s: float
    sequence: int
    dataset: Dataset = field(compare=False)
    attempts: int = field(default=0, compare=False)


@dataclass(frozen=True)
class Delivery:
    """What became of one push: status is the DIMSE status, or None if nobody answered."""

    sop_instance_uid: str
    sent: bool
    attempts: int
    status: int | None
    reason: str


class Route(Protocol):
    """From whom to whom, and how often it is tried."""

    @property
    def ae_title(self) -> str: ...

    @property
    def listener_host(self) -> str: ...

    @property
    def listener_port(self) -> int: ...

    @property
    def listener_ae_title(self) -> str: ...

    @property
    def retry_s(self) -> float: ...

    @property
    def retries(self) -> int: ...


class Outbox:
    """Owns the sending thread. `report` is called from it, once for each push that has ended."""

    def __init__(
        self,
        settings: Route,
        report: Callable[[Delivery], None],
        sop_classes: Sequence[str] = (MRImageStorage, EnhancedMRImageStorage),
    ) -> None:
        self._settings = settings
        self._sop_classes = sop_classes
        self._report = report
        self._waiting: list[Push] = []
        self._resume_s = 0.0  # nothing is sent before (time.monotonic)
        self._sequence = 0
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)

    def __enter__(self) -> "Outbox":
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(timeout=10)

    def push(self, dataset: Dataset, due_s: float) -> None:
        """Send `dataset` as soon as time.monotonic() has reached `due_s`."""
        with self._changed:
            self._sequence += 1
            heapq.heappush(self._waiting, Push(due_s, self._sequence, dataset))
            self._changed.notify()

    def _run(self) -> None:
        while batch := self._next_batch():
            if again := self._send(batch):
                with self._changed:
                    self._resume_s = time.monotonic() + self._settings.retry_s
                    for push in again:
                        heapq.heappush(self._waiting, push)

    def _next_batch(self) -> list[Push]:
        """Wait until something is due; everything due, in order. Empty when stopped."""
        with self._changed:
            while not self._stopped:
                now = time.monotonic()
                next_s = max(self._waiting[0].due_s, self._resume_s) if self._waiting else None
                if next_s is not None and next_s <= now:
                    return self._take_due(now)
                self._changed.wait(None if next_s is None else next_s - now)
            return []

    def _take_due(self, now_s: float) -> list[Push]:
        due = []
        while self._waiting and self._waiting[0].due_s <= now_s:
            due.append(heapq.heappop(self._waiting))
        return due

    def _send(self, batch: list[Push]) -> list[Push]:
        """Send in one association; the pushes that are to be tried again."""
        association = _associate(self._settings, self._sop_classes)
        again = []
        for push in batch:
            status, reason = _store(association, push)
            if status is not None and _is_stored(status):
                self._report(self._delivery(push, True, status, "stored"))
            elif _is_final(status) or push.attempts >= self._settings.retries:
                self._report(self._delivery(push, False, status, reason))
            else:
                again.append(replace(push, attempts=push.attempts + 1))
        if association.is_established:
            association.release()
        return again

    @staticmethod
    def _delivery(push: Push, sent: bool, status: int | None, reason: str) -> Delivery:
        uid = str(push.dataset.SOPInstanceUID)
        return Delivery(uid, sent, push.attempts + 1, status, reason)


def _is_stored(status: int) -> bool:
    """Success, or a warning with which the instance was stored all the same."""
    return status == 0x0000 or status & 0xF000 == 0xB000


def _is_final(status: int | None) -> bool:
    """The receiver has understood and will not take it: wrong SOP class, cannot understand."""
    return status is not None and (status & 0xFF00 == 0xA900 or status & 0xF000 == 0xC000)


def _associate(settings: Route, sop_classes: Sequence[str]) -> Association:
    entity = AE(ae_title=settings.ae_title)
    entity.acse_timeout = entity.dimse_timeout = entity.network_timeout = 10
    for sop_class in sop_classes:
        entity.add_requested_context(sop_class, _TRANSFER_SYNTAXES)
    return mended(
        entity.associate(
            settings.listener_host, settings.listener_port, ae_title=settings.listener_ae_title
        )
    )


def _store(association: Association, push: Push) -> tuple[int | None, str]:
    if not association.is_established:
        return None, "no association: refused, aborted or no response"
    try:
        status = association.send_c_store(push.dataset)
    except (ValueError, RuntimeError) as error:
        return None, str(error)
    if "Status" not in status:
        return None, "the receiver did not answer"
    comment = status.get("ErrorComment", "")
    return int(status.Status), f"status 0x{int(status.Status):04X} {comment}".strip()
