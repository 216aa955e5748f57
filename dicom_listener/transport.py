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
from collections.abc import Callable
from socketserver import TCPServer
from typing import Any

from pynetdicom.association import Association
from pynetdicom.timer import Timer
from pynetdicom.transport import AssociationSocket, RequestHandler, ThreadedAssociationServer

from dicom_listener.lobby import Lobby, NoRequestError, await_request

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
    on_refused: Callable[[str], None] = staticmethod(lambda why: None)

    def __init__(self, assoc: Association, client_socket: socket.socket) -> None:
        super().__init__(assoc, client_socket=client_socket)
        self.message_bytes = 0
        self.message_began_s: float | None = None
        self.heard_s = time.monotonic()

    def message_done(self) -> float | None:
        """Start counting anew; return the monotonic instant of the message's first byte."""
        began_s, self.message_began_s = self.message_began_s, None
        self.message_bytes = 0
        return began_s

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
            piece = sock.recv(min(_CHUNK_BYTES, nr_bytes - len(received)))
            if not piece:
                break
            acknowledge_at_once(sock)
            self.heard_s = time.monotonic()
            received += piece
            if len(received) < nr_bytes and time.monotonic() > deadline_s:
                self._refuse(f"a PDU took longer than {self.pdu_deadline_s:g} s")
        return received

    def _shutdown_socket(self) -> None:
        """Close in any case. (pynetdicom's own leaves it open where the peer is gone already.)"""
        if self.socket is not None:
            with contextlib.suppress(OSError):
                self.socket.shutdown(socket.SHUT_RDWR)
            self.socket.close()

    def _check_size(self, nr_bytes: int) -> None:
        self.message_bytes += nr_bytes
        if nr_bytes > self.max_pdu_bytes:
            self._refuse(f"a PDU of {nr_bytes} bytes, {self.max_pdu_bytes} are allowed")
        if self.message_bytes > self.max_message_bytes:
            self._refuse(f"a message of more than {self.max_message_bytes} bytes")

    def _refuse(self, why: str) -> None:
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


class PromptRequestHandler(RequestHandler):
    server: "PromptServer"

    def _create_association(self) -> Association:
        association = super()._create_association()
        # The plain socket has announced the connection (Evt5); ours announces it itself.
        association.dul.event_queue.get_nowait()
        bounded = self.server.socket_class(association, self.request)
        association.dul.socket = bounded
        association.dul._idle_timer = SteadyTimer(association.network_timeout)
        association.dul.artim_timer = SteadyTimer(association.acse_timeout)
        return association


class PromptServer(ThreadedAssociationServer):
    """Accepts, prepares each connection in a thread of its own, then hands it to pynetdicom."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128
    socket_class: type[BoundedSocket] = BoundedSocket
    network_timeout_s = 60.0
    first_byte_timeout_s = 10.0
    most_unopened = 64
    most_associations = 16
    is_known: Callable[[str], bool] = staticmethod(lambda peer: True)
    on_dropped: Callable[[str, str], None] = staticmethod(lambda peer, why: None)

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
            self.on_dropped(gone, "too many connections that say nothing")
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
            sock.settimeout(self.network_timeout_s)
        except NoRequestError as error:
            self.on_dropped(peer, str(error))
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
        self.on_dropped(longest.requestor.address, f"silent, and {peer} wants in")
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
