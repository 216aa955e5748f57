"""TCP under the association: answers at once, waits for nobody for ever.

Senders write the head and the body of a message as two segments; with Nagle's algorithm on their
side and delayed acknowledgement on ours, every message would stall for 40 ms. So what arrives is
acknowledged at once (TCP_QUICKACK, which the kernel forgets after every receive).

A health check that connects and goes, a peer that says nothing, half a PDU, a TLS handshake that
never ends: each holds one thread for a bounded time, and their number is bounded too.
"""

import contextlib
import selectors
import socket
import ssl
import time
from collections import deque
from collections.abc import Callable
from socketserver import TCPServer
from typing import Any

import structlog
from pynetdicom import evt
from pynetdicom.association import Association
from pynetdicom.events import Event
from pynetdicom.pdu import A_ABORT_RQ, A_ASSOCIATE_RJ
from pynetdicom.timer import Timer
from pynetdicom.transport import AssociationSocket, RequestHandler, ThreadedAssociationServer

from dicom_listener.lobby import Lobby, NoRequestError, await_request
from dicom_listener.network.hearing import Hearing

log = structlog.get_logger("listener")

_QUICKACK = getattr(socket, "TCP_QUICKACK", None)
_CHUNK_BYTES = 256 * 1024
_MAY_BE_SILENT_S = 2.0


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
    remarks: tuple[str, ...] = ()  # what was put right in the association request
    on_refused: Callable[[str], None] = staticmethod(lambda why: None)

    def __init__(self, assoc: Association, client_socket: socket.socket) -> None:
        super().__init__(assoc, client_socket=client_socket)
        self.message_bytes = 0
        self.unfinished_bytes = 0
        self.message_began_s: float | None = None
        self._before_pdu: tuple[int, float | None] = (0, None)
        self._began_whole_s: deque[float | None] = deque()  # of messages not answered yet
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
        return len(self._began_whole_s)

    def pdu_begins(self) -> None:
        self._before_pdu = self.unfinished_bytes, self.message_began_s

    def pdu_is_no_message(self) -> None:
        """What has just been read is no part of a message, but beside or between messages."""
        self.unfinished_bytes, self.message_began_s = self._before_pdu
        if self.message_began_s is None:
            self.message_bytes = 0

    def message_whole(self) -> None:
        """With what has just been read a message is whole; start counting again."""
        self._began_whole_s.append(self.message_began_s)
        self.message_bytes = self.unfinished_bytes = 0
        self.message_began_s = None

    def message_done(self) -> float | None:
        """One is dealt with; return the monotonic instant of its first byte."""
        return self._began_whole_s.popleft() if self._began_whole_s else None

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


class SteadyTimer(Timer):
    """pynetdicom's timer by the clock that nobody sets.

    By the wall clock every association would end at once when that is set forward.
    """

    @property
    def remaining(self) -> float:
        if self.timeout is None:
            return 1  # as pynetdicom's: it never expires
        if self._start_time is None:
            return self.timeout
        now_s = time.monotonic() if self._end_time is None else self._end_time
        return self.timeout - (now_s - self._start_time)

    def start(self) -> None:
        self._start_time = time.monotonic()
        self._end_time: float | None = None

    def stop(self) -> None:
        self._end_time = time.monotonic()


class SharedContexts(list[Any]):
    """Presentation contexts that all associations share: nobody changes them once we serve.

    pynetdicom copies them deeply for every association, which takes longer than all the rest.
    """

    def __deepcopy__(self, memo: Any) -> "SharedContexts":
        return self


class PatienceTimer(SteadyTimer):
    """How long nothing may come: minutes between messages, much less in the middle of one."""

    def __init__(self, sock: BoundedSocket, between_s: float, within_s: float) -> None:
        super().__init__(between_s)
        self._sock, self._between_s, self._within_s = sock, between_s, within_s

    @property
    def timeout(self) -> float | None:
        if self._sock.message_began_s is None:
            return self._between_s
        return min(self._within_s, self._between_s)

    @timeout.setter
    def timeout(self, value: float | None) -> None:
        pass  # both are given

    @property
    def expired(self) -> bool:
        is_over = super().expired
        if is_over:
            self._sock.note_ending("idle", f"nothing arrived for {self.timeout:g} s")
        return is_over


class PromptRequestHandler(RequestHandler):
    server: "PromptServer"

    def _create_association(self) -> Association:
        association = super()._create_association()
        dul, server = association.dul, self.server
        # The plain socket has announced the connection (Evt5); ours announces it itself.
        dul.event_queue.get_nowait()
        bounded = server.socket_class(association, self.request)
        dul.socket = bounded
        dul._idle_timer = PatienceTimer(bounded, server.network_timeout_s, server.message_timeout_s)
        dul.artim_timer = SteadyTimer(association.acse_timeout)

        def account() -> None:
            server.on_ended(association)

        Hearing(association, bounded, account)
        dul.run = _caught(dul.run, bounded)
        association.run = _accounted(_caught(association.run, bounded), account)
        association.bind(evt.EVT_PDU_SENT, _stop_waiting)
        return association


def _stop_waiting(event: Event) -> None:
    """Where the request was answered by its end, the association need not wait for it any more."""
    if (
        isinstance(event.pdu, (A_ABORT_RQ, A_ASSOCIATE_RJ))
        and event.assoc.requestor.primitive is None
    ):
        event.assoc.dul.to_user_queue.put(None)


def _caught(run: Callable[[], None], sock: BoundedSocket) -> Callable[[], None]:
    """A thread of an association; what nobody has foreseen ends the association with a reason."""

    def run_to_the_end() -> None:
        try:
            run()
        except Exception as error:
            sock.note_ending("internal_error", f"ended by an error here ({error!r})")
            log.debug("the thread of an association", exc_info=True)

    return run_to_the_end


def _accounted(run: Callable[[], None], account: Callable[[], None]) -> Callable[[], None]:
    """The thread of an association, and the account of it when it ends, however it does."""

    def run_to_the_end() -> None:
        try:
            run()
        finally:
            account()

    return run_to_the_end


class PromptServer(ThreadedAssociationServer):
    """Accepts, prepares each connection in a thread of its own, then hands it to pynetdicom."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128
    socket_class: type[BoundedSocket] = BoundedSocket
    network_timeout_s = 900.0
    message_timeout_s = 30.0
    first_byte_timeout_s = 10.0
    most_unopened = 64
    most_associations = 16
    is_known: Callable[[str], bool] = staticmethod(lambda peer: True)
    on_dropped: Callable[[str, str], None] = staticmethod(lambda peer, why: None)
    on_no_request: Callable[[str, str], None] = staticmethod(lambda peer, why: None)
    on_ended: Callable[[Association], None] = staticmethod(lambda association: None)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._lobby = Lobby(self.most_unopened)
        kwargs["request_handler"] = PromptRequestHandler
        super().__init__(*args, **kwargs)
        self.contexts: SharedContexts = SharedContexts(self.contexts)

    def get_request(self) -> tuple[socket.socket, Any]:
        # No TLS here: a handshake in this thread would let one silent peer stop everyone.
        assert self.socket is not None
        return self.socket.accept()

    def process_request(self, request: Any, client_address: Any) -> None:
        peer = client_address[0]
        gone = self._lobby.enter(request, peer, is_known=self.is_known(peer))
        if gone is not None:
            self.on_dropped(gone, "too many silent connections")
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            opened = self._open(request, client_address[0])
        finally:
            self._lobby.leave(request)
        if opened is not None:
            self._make_room(client_address[0])
            super().process_request_thread(opened, client_address)

    def _open(self, request: socket.socket, peer: str) -> socket.socket | None:
        """The connection, ready for its first PDU; None where there will be none."""
        sock = request
        try:
            sock.settimeout(self.first_byte_timeout_s)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            acknowledge_at_once(sock)
            if self.ssl_context is not None:
                sock = self.ssl_context.wrap_socket(sock, server_side=True)
                _wait_readable(sock, self.first_byte_timeout_s)
            else:
                await_request(sock, self.first_byte_timeout_s)
            sock.settimeout(self.message_timeout_s)
        except NoRequestError as error:
            (self.on_no_request if error.is_dicom else self.on_dropped)(peer, str(error))
            self.shutdown_request(sock)
            return None
        except OSError as error:  # TLS errors and timeouts are OSErrors too
            self.on_dropped(peer, f"{type(error).__name__}: {error}")
            self.shutdown_request(sock)
            return None
        return sock

    def _make_room(self, peer: str) -> None:
        """Where all associations are taken, end the one that has been silent for longest."""
        taken = [a for a in self.active_associations if a.is_established]
        if len(taken) < self.most_associations:
            return
        silent = {a: _silent_s(a) for a in taken}
        longest = max(silent, key=lambda a: silent[a])
        if silent[longest] < _MAY_BE_SILENT_S:
            return  # all of them are at work: the new one is refused, and says so
        longest.dul.socket.note_ending("made_room", f"silent while {peer} is waiting")
        with contextlib.suppress(Exception):  # it may end by itself in this very moment
            longest.abort()

    def shutdown(self) -> None:
        """Stop listening. (pynetdicom's own would look for us in a list that it did not fill.)"""
        TCPServer.shutdown(self)
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        self.on_dropped(client_address[0], "failed to start an association")


def _silent_s(association: Association) -> float:
    heard_s = getattr(association.dul.socket, "heard_s", None)
    return 0.0 if heard_s is None else time.monotonic() - heard_s


def _wait_readable(sock: socket.socket, timeout_s: float) -> None:
    if isinstance(sock, ssl.SSLSocket) and sock.pending():
        return
    with selectors.DefaultSelector() as selector:
        selector.register(sock, selectors.EVENT_READ)
        if not selector.select(timeout_s):
            raise TimeoutError("no association request")
