"""TCP under the association: answers at once, waits for nobody for ever.

A health check that connects and goes, a peer that says nothing, half a PDU, a TLS handshake that
never ends: each holds one thread for a bounded time, and their number is bounded too.
"""

import contextlib
import logging
import selectors
import socket
import ssl
import sys
import time
from collections.abc import Callable
from socketserver import TCPServer
from typing import Any

import structlog
from pynetdicom import evt
from pynetdicom.association import Association
from pynetdicom.events import Event
from pynetdicom.fsm import InvalidEventError
from pynetdicom.pdu import A_ABORT_RQ, A_ASSOCIATE_RJ
from pynetdicom.timer import Timer
from pynetdicom.transport import RequestHandler, ThreadedAssociationServer

from dicom_listener.lobby import Lobby, NoRequestError, await_request
from dicom_listener.network.bounded_socket import BoundedSocket, acknowledge_at_once
from dicom_listener.network.hearing import Hearing
from dicom_listener.network.services import Refusal
from dicom_listener.network.speaking import Speaking

log = structlog.get_logger("listener")

_MAY_BE_SILENT_S = 2.0


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
        if self._sock.unanswered:  # it waits for us, and may not even be read
            self.restart()
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

        def end() -> None:
            bounded.speaking.over()
            account()

        def refused(message: Any, refusal: Refusal) -> None:
            server.on_not_offered(association, message, refusal)

        Hearing(association, bounded, account)
        bounded.speaking = Speaking(association, server.message_timeout_s, refused)
        dul.run = _caught(dul.run, bounded)
        association.run = _accounted(_caught(association.run, bounded, association.abort), end)
        association.bind(evt.EVT_PDU_SENT, _stop_waiting)
        return association


def _stop_waiting(event: Event) -> None:
    """Where the request was answered by its end, the association need not wait for it any more."""
    if (
        isinstance(event.pdu, (A_ABORT_RQ, A_ASSOCIATE_RJ))
        and event.assoc.requestor.primitive is None
    ):
        event.assoc.dul.to_user_queue.put(None)


def _caught(
    run: Callable[[], None], sock: BoundedSocket, end: Callable[[], None] = lambda: None
) -> Callable[[], None]:
    """A thread of an association; what nobody has foreseen ends the association with a reason.

    end: ends what does not end by itself with this thread.
    """

    def run_to_the_end() -> None:
        try:
            run()
        except Exception as error:
            # what was just being said when the connection ended comes out of turn for pynetdicom
            is_foreseen = isinstance(error, InvalidEventError) and sock.why_ended is not None
            sock.note_ending("internal_error", f"ended by an error here ({error!r})")
            (log.debug if is_foreseen else log.error)("thread of an association", exc_info=True)
            with contextlib.suppress(Exception):
                end()

    return run_to_the_end


class _Tracebacks(logging.Handler):
    """Errors that pynetdicom catches by itself: they are in our log, with their tracebacks."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if error is not None and not isinstance(error, (OSError, InvalidEventError)):
            log.error("pynetdicom", text=record.getMessage(), exc_info=error)


def keep_tracebacks() -> None:
    logging.getLogger("pynetdicom").addHandler(_Tracebacks(logging.ERROR))


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
    on_not_offered: Callable[[Association, Any, Refusal], None] = staticmethod(lambda *what: None)

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
        if not isinstance(sys.exception(), OSError):
            log.error("start of an association", peer=client_address[0], exc_info=True)
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
