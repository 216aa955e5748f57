"""How PDUs come from the socket to pynetdicom: read, judged, and only then acted upon.

It takes the place of pynetdicom's own reading, which ends associations without a word.
"""

import struct
from collections.abc import Callable
from typing import Any

from pynetdicom import evt
from pynetdicom.events import Event

from dicom_listener.network.association_request import mended_request, speaks_our_version
from dicom_listener.network.conversation import (
    ABORT,
    ASSOCIATE_RQ,
    N_EVENT_REPORT,
    P_DATA,
    BreachError,
    Command,
    Conversation,
    Phase,
    check_turn,
)
from dicom_listener.network.services import accepted_by, refusal_of

_HEAD_BYTES = 6
# the state machine's names: of a connection that is gone, of a PDU that may not be, of states
_CLOSED, _INVALID = "Evt17", "Evt19"
_PHASES = {
    "Sta1": Phase.SILENT,
    "Sta2": Phase.SILENT,
    "Sta3": Phase.ASKED,
    "Sta6": Phase.OPEN,
    "Sta8": Phase.RELEASING,
}


class Hearing:
    """Of one association. sock: its BoundedSocket.

    account: gives the account of the ending; it is given at once, for the association's thread may
    wait for a while until the peer has gone.
    """

    def __init__(self, association: Any, sock: Any, account: Callable[[], None]) -> None:
        self._association, self._sock, self._account = association, sock, account
        self._conversation = Conversation(self._why_not_served)
        self._reports_out: set[int] = set()  # their message IDs
        self._is_asked = False
        self._is_over = False  # what comes after its end is not looked at
        association.bind(evt.EVT_DIMSE_SENT, self._on_sent)
        association.dul._read_pdu_data = self.read

    def read(self) -> None:
        """Read one PDU, and tell the state machine what came."""
        dul = self._association.dul
        try:
            if self._is_over:
                self._sock.discard()
                return
            pdu, event = self._next_pdu(self._phase)
        except OSError:  # the socket has noted why
            dul.event_queue.put(_CLOSED)
        except BreachError as breach:
            self._end(breach.kind, str(breach))
        except Exception as error:
            self._end("unreadable", f"an unreadable PDU: {error}")
        else:
            dul.event_queue.put(event)
            dul._recv_pdu.put(pdu)

    @property
    def _phase(self) -> Phase:
        phase = _PHASES.get(self._association.dul.state_machine.current_state, Phase.OVER)
        # the state machine has not heard yet of what was read just before
        return Phase.ASKED if phase is Phase.SILENT and self._is_asked else phase

    def _end(self, kind: str, why: str) -> None:
        self._is_over = True
        self._sock.note_ending(kind, why)
        self._account()
        self._association.dul.event_queue.put(_INVALID)

    def _next_pdu(self, phase: Phase) -> tuple[Any, str]:
        sock = self._sock
        sock.pdu_begins()
        head = self._whole(_HEAD_BYTES)
        kind, size = struct.unpack(">BxL", head)
        is_message = kind == P_DATA and phase is Phase.OPEN
        try:
            check_turn(kind, phase)
            self._is_asked |= kind == ASSOCIATE_RQ
            body = self._whole(size)
            if is_message and self._conversation.take(memoryview(body)):
                sock.message_whole()
        except BreachError:
            sock.pdu_is_no_message()
            raise
        if not is_message:
            sock.pdu_is_no_message()
        return self._decoded(kind, head + body)

    def _whole(self, size: int) -> bytearray:
        received: bytearray = self._sock.recv(size)
        if len(received) < size:
            raise ConnectionError("closed")
        return received

    def _decoded(self, kind: int, pdu: bytearray) -> tuple[Any, str]:
        """As pynetdicom decodes it. What cannot be converted would end its thread later."""
        if kind == ABORT:
            self._sock.note_ending("aborted", "aborted by the sender")
        if kind != ASSOCIATE_RQ:
            decoded: tuple[Any, str] = self._association.dul._decode_pdu(pdu)
            return decoded
        mended = mended_request(bytes(pdu))
        self._sock.remarks = tuple(mended.remarks)
        if not speaks_our_version(mended.pdu):  # pynetdicom rejects it
            self._sock.note_ending("not_offered", "an association by another protocol version")
        request, event = self._association.dul._decode_pdu(bytearray(mended.pdu))
        request.to_primitive()
        return request, event

    def _on_sent(self, event: Event) -> None:
        command = event.message.command_set
        if command.CommandField == N_EVENT_REPORT:
            self._reports_out.add(command.MessageID)

    def _why_not_served(self, command: Command) -> str:
        if command.is_report_response and command.answers in self._reports_out:
            self._reports_out.discard(command.answers)
            return ""
        refusal = refusal_of(command, accepted_by(self._association))
        return refusal.why if refusal is not None and refusal.status is None else ""
