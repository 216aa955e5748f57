"""What goes from us to a sender: by the association's own thread alone, one message after another.

pynetdicom queues a message part by part: what two threads send at once would arrive mixed, and what
another one sends while the association is released would follow its end. And its own way to send a
report takes whatever comes next for the answer, a slice included.
"""

import contextlib
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

from pydicom.dataset import Dataset
from pydicom.uid import UID
from pynetdicom.dimse_primitives import N_EVENT_REPORT
from pynetdicom.dsutils import encode
from pynetdicom.presentation import PresentationContextTuple
from pynetdicom.sop_class import StorageCommitmentPushModel, StorageCommitmentPushModelInstance

from dicom_listener.network.services import Refusal, refused_request

SUCCESS = 0x0000
_COMMENT_CHARACTERS = 64  # Error Comment (0000,0902) is an LO


@dataclass(eq=False)
class _Report:
    """One that is to be sent, or was. why_not: why it was not taken; empty where it was."""

    request: N_EVENT_REPORT
    context_id: int
    give_up_s: float = float("inf")
    why_not: str = ""
    is_over: threading.Event = field(default_factory=threading.Event)

    def end(self, why_not: str) -> None:
        self.why_not = why_not
        self.is_over.set()


class Speaking:
    """Of one association. answer_timeout_s: how long a report may stay unanswered.

    on_refused(message, refusal): of each request that was answered with a refusal.
    """

    def __init__(
        self, association: Any, answer_timeout_s: float, on_refused: Callable[[Any, Refusal], None]
    ) -> None:
        self._association, self._on_refused = association, on_refused
        self._answer_timeout_s = answer_timeout_s
        self._numbers = itertools.cycle(range(1, 2**16))
        self._to_send: deque[_Report] = deque()
        self._sent: _Report | None = None  # that waits for its answer
        self._is_over = False
        self._get, self._serve = association.dimse.get_msg, association._serve_request
        association.dimse.get_msg = self._next
        association._serve_request = self._answer

    def report(self, event: int, information: Dataset, context: PresentationContextTuple) -> str:
        """Send a report of Storage Commitment, and wait; why it was not taken, empty where it was.

        From any thread but the association's own.
        """
        request = N_EVENT_REPORT()
        request.MessageID = next(self._numbers)
        request.AffectedSOPClassUID = StorageCommitmentPushModel
        request.AffectedSOPInstanceUID = StorageCommitmentPushModelInstance
        request.EventTypeID = event
        syntax = UID(context.transfer_syntax)
        flags = syntax.is_implicit_VR, syntax.is_little_endian, syntax.is_deflated
        request.EventInformation = BytesIO(encode(information, *flags) or b"")
        report = _Report(request, context.context_id)
        self._to_send.append(report)
        if self._is_over:
            self._end_all("the association was over before it was sent")
        report.is_over.wait()
        return report.why_not

    def heard(self, answer: Any) -> None:
        """Take note of a response; late ones are no news."""
        sent = self._sent
        if sent is None or sent.request.MessageID != answer.MessageIDBeingRespondedTo:
            return
        self._sent = None
        sent.end("" if answer.Status == SUCCESS else f"it answered 0x{answer.Status:04X}")

    def over(self) -> None:
        """The association has ended."""
        self._is_over = True
        sent, self._sent = self._sent, None
        if sent is not None:
            sent.end("the association ended before it was answered")
        self._end_all("the association was over before it was sent")

    def _end_all(self, why: str) -> None:
        with contextlib.suppress(IndexError):
            while True:
                self._to_send.popleft().end(why)

    # In the association's own thread

    def _next(self, block: bool = False) -> Any:
        self._send_next()
        return self._get(block)

    def _send_next(self) -> None:
        sent = self._sent
        if sent is not None and time.monotonic() > sent.give_up_s:
            self._sent = None
            sent.end(f"no answer within {self._answer_timeout_s:g} s")
        if self._sent is not None or not self._to_send:
            return
        if self._association.dul.peek_next_pdu() is not None:
            return  # a release, or an abort: nobody would answer
        self._sent = report = self._to_send.popleft()
        report.give_up_s = time.monotonic() + self._answer_timeout_s
        self._association.dimse.send_msg(report.request, report.context_id)

    def _answer(self, message: Any, context_id: int) -> None:
        if threading.current_thread().ident != self._association.ident:
            # pynetdicom serves a peer's N-EVENT-REPORT in a thread of its own
            self._association.dimse.msg_queue.put((context_id, message))
            return
        if message.MessageIDBeingRespondedTo is not None:
            return  # it was taken note of when it arrived
        refusal = refused_request(self._association, message, context_id)
        if refusal is None:
            self._serve(message, context_id)
            return
        self._association.dul.socket.message_done()
        self._on_refused(message, refusal)
        self._association.dimse.send_msg(_response(message, refusal), context_id)


def _response(message: Any, refusal: Refusal) -> Any:
    response = type(message)()
    response.MessageIDBeingRespondedTo = message.MessageID
    for name in ("AffectedSOPClassUID", "RequestedSOPClassUID"):
        if getattr(message, name, None) is not None:
            response.AffectedSOPClassUID = getattr(message, name)
    response.Status = refusal.status
    if hasattr(response, "ErrorComment"):
        response.ErrorComment = refusal.why[:_COMMENT_CHARACTERS]
    return response
