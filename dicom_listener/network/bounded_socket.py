"""The connection under an association: large reads, acknowledged at once, and limits.

Senders write the head and the body of a message as two segments; with Nagle's algorithm on their
side and delayed acknowledgement on ours, every message would stall for 40 ms. So what arrives is
acknowledged at once (TCP_QUICKACK, which the kernel forgets after every receive).
"""

import contextlib
import socket
import time
from collections import deque
from collections.abc import Callable

from pynetdicom.association import Association
from pynetdicom.transport import AssociationSocket

from dicom_listener.network.speaking import Speaking

_QUICKACK = getattr(socket, "TCP_QUICKACK", None)
_CHUNK_BYTES = 256 * 1024
# the state machine's names: of an open association, of a connection that is gone
_OPEN, _CLOSED = "Sta6", "Evt17"


def acknowledge_at_once(sock: socket.socket) -> None:
    """Where the option does not exist (not Linux) it is simply not set."""
    if _QUICKACK is not None:
        sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)


class BoundedSocket(AssociationSocket):
    """pynetdicom's socket with large reads, prompt acknowledgement, and limits.

    A PDU or a message over its limit, or a PDU that takes too long, ends the connection.
    """

    max_pdu_bytes = 2**20
    max_message_bytes = 2**30
    pdu_deadline_s = 60.0
    most_unanswered = 16  # messages that were received whole
    most_unanswered_bytes = 64 * 2**20
    remarks: tuple[str, ...] = ()  # what was put right in the association request
    speaking: Speaking
    on_sends_ahead: Callable[[Association], None] = staticmethod(lambda association: None)
    on_refused: Callable[[str], None] = staticmethod(lambda why: None)

    def __init__(self, assoc: Association, client_socket: socket.socket) -> None:
        super().__init__(assoc, client_socket=client_socket)
        self.message_bytes = 0
        self.unfinished_bytes = 0
        self.message_began_s: float | None = None
        self._before_pdu: tuple[int, float | None] = (0, None)
        # of messages not answered yet: when they began, and their bytes
        self._whole: deque[tuple[float | None, int]] = deque()
        self._sends_ahead = False
        self.heard_s = time.monotonic()
        self.why_ended: tuple[str, str] | None = None  # (kind, in words)
        self.is_accounted_for = False

    def note_ending(self, kind: str, why: str) -> None:
        """Say why the association is about to end; what was seen first is the cause."""
        if self.why_ended is None:
            self.why_ended = kind, why

    @property
    def unanswered(self) -> int:
        """How many messages were received whole and are not dealt with yet."""
        return len(self._whole)

    @property
    def is_full(self) -> bool:
        """Whether as much waits for answers as is kept in memory: no more is read meanwhile.

        A sender need not wait for one answer before it sends on, whatever was negotiated.
        """
        waiting_bytes = sum(size for _, size in tuple(self._whole))
        much = self.unanswered >= self.most_unanswered or waiting_bytes > self.most_unanswered_bytes
        return much and self.assoc.dul.state_machine.current_state == _OPEN

    @property
    def ready(self) -> bool:
        if not self.is_full:
            return super().ready
        if not self._sends_ahead:
            self._sends_ahead = True
            self.on_sends_ahead(self.assoc)
        return False

    def pdu_begins(self) -> None:
        self._before_pdu = self.unfinished_bytes, self.message_began_s

    def pdu_is_no_message(self) -> None:
        """What has just been read is no part of a message, but beside or between messages."""
        self.unfinished_bytes, self.message_began_s = self._before_pdu
        if self.message_began_s is None:
            self.message_bytes = 0

    def message_whole(self) -> None:
        """With what has just been read a message is whole; start counting again."""
        self._whole.append((self.message_began_s, self.message_bytes))
        self.message_bytes = self.unfinished_bytes = 0
        self.message_began_s = None

    def message_done(self) -> float | None:
        """One is dealt with; return the monotonic instant of its first byte."""
        return self._whole.popleft()[0] if self._whole else None

    def recv(self, nr_bytes: int) -> bytearray:
        sock = self.socket
        if sock is None:
            raise OSError("the connection is closed")
        if self.message_began_s is None:
            self.message_began_s = time.monotonic()
        self._check_size(nr_bytes)
        received = bytearray()
        deadline_s = time.monotonic() + self.pdu_deadline_s
        while len(received) < nr_bytes:
            piece = self._next_piece(sock, nr_bytes - len(received))
            if not piece:
                self.note_ending("closed", "the sender closed the connection without a release")
                break
            acknowledge_at_once(sock)
            self.unfinished_bytes += len(piece)
            self.heard_s = time.monotonic()
            received += piece
            if len(received) < nr_bytes and time.monotonic() > deadline_s:
                self._refuse(f"a PDU took longer than {self.pdu_deadline_s:g} s")
        return received

    def send(self, bytestream: bytes) -> None:
        """As pynetdicom's, and the reason is noted where that fails."""
        try:
            if self.socket is None:
                raise OSError("the connection is closed")
            self.socket.sendall(bytestream)
        except TimeoutError:
            self.note_ending("stalled", f"it took no answer for {self.socket.gettimeout():g} s")
            self.event_queue.put(_CLOSED)
        except OSError as error:
            self.note_ending("broken", f"the connection was broken ({error.strerror or error})")
            self.event_queue.put(_CLOSED)

    def discard(self) -> None:
        """Read what is there, and drop it. Raises OSError where the peer is gone."""
        if self.socket is None or not self.socket.recv(_CHUNK_BYTES):
            raise ConnectionError("the connection is closed")

    def _next_piece(self, sock: socket.socket, nr_bytes: int) -> bytes:
        try:
            return sock.recv(min(_CHUNK_BYTES, nr_bytes))
        except TimeoutError:
            self.note_ending("stalled", f"no more of a PDU arrived for {sock.gettimeout():g} s")
            raise
        except OSError as error:
            self.note_ending("broken", f"the connection was broken ({error.strerror or error})")
            raise

    def _shutdown_socket(self) -> None:
        """Close in any case. (pynetdicom's own leaves it open where the peer is gone already.)"""
        if self.socket is not None:
            with contextlib.suppress(OSError):
                self.socket.shutdown(socket.SHUT_RDWR)
            self.socket.close()

    def _check_size(self, nr_bytes: int) -> None:
        self.message_bytes += nr_bytes
        if nr_bytes > self.max_pdu_bytes:
            self._refuse(f"a PDU of {nr_bytes} bytes ({self.max_pdu_bytes} allowed)")
        if self.message_bytes > self.max_message_bytes:
            self._refuse(f"a message of more than {self.max_message_bytes} bytes")

    def _refuse(self, why: str) -> None:
        self.note_ending("over_limit", why)
        self.on_refused(why)
        raise OSError(why)
