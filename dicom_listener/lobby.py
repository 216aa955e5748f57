"""Connections that have not asked for an association yet: few, for a short time, nobody's for ever.

Whoever connects waits here until a whole A-ASSOCIATE-RQ has come. The lobby is small: when it is
full, the oldest connection of whoever has the most of them makes room, so that a flood of silent
ones (or of half-spoken ones) keeps out nobody but itself.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
import time
from collections import Counter
from dataclasses import dataclass

from dicom_listener.network.conversation import ASSOCIATE_RQ, PDU_NAMES

_HEAD_BYTES = 6
_MOST_PEEKED_BYTES = 16 * 1024  # what the kernel keeps for us at the least; the rest comes later
_NAP_S = 0.02
_STRANGERS_SHARE = 8


class NoRequestError(OSError):
    """There will be no association on this connection; the text says why.

    is_dicom: whoever connected speaks the protocol; it is no health check that looks in and goes.
    """

    def __init__(self, why: str, *, is_dicom: bool = False) -> None:
        super().__init__(why)
        self.is_dicom = is_dicom


@dataclass(frozen=True, eq=False)
class _Waiting:
    peer: str
    is_known: bool
    connection: socket.socket


class Lobby:
    """Safe for any number of threads. Of it, strangers may have an eighth."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._most_strangers = max(1, most // _STRANGERS_SHARE)
        self._lock = threading.Lock()
        self._waiting: dict[int, _Waiting] = {}  # in the order in which they came

    def enter(self, connection: socket.socket, peer: str, *, is_known: bool) -> str | None:
        """Let it wait; return the peer whose oldest connection had to go for it, if one had."""
        with self._lock:
            gone = self._who_goes(is_known)
            if gone is not None:
                del self._waiting[id(gone.connection)]
            self._waiting[id(connection)] = _Waiting(peer, is_known, connection)
        if gone is None:
            return None
        with contextlib.suppress(OSError):  # the thread that waits on it finds its end
            gone.connection.shutdown(socket.SHUT_RDWR)
        return gone.peer

    def _who_goes(self, is_known: bool) -> _Waiting | None:
        strangers = [one for one in self._waiting.values() if not one.is_known]
        if not is_known and len(strangers) >= self._most_strangers:
            return strangers[0]
        if len(self._waiting) < self._most:
            return None
        if strangers:
            return strangers[0]
        crowd, _ = Counter(one.peer for one in self._waiting.values()).most_common(1)[0]
        return next(one for one in self._waiting.values() if one.peer == crowd)

    def leave(self, connection: socket.socket) -> None:
        with self._lock:
            self._waiting.pop(id(connection), None)


def await_request(connection: socket.socket, timeout_s: float) -> None:
    """Until a whole association request can be read. Raises NoRequestError; reads nothing."""
    until_s = time.monotonic() + timeout_s
    wanted = _HEAD_BYTES
    head = b""
    poll = select.poll()
    poll.register(connection, select.POLLIN | select.POLLRDHUP)
    while True:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, wanted)
        left_s = until_s - time.monotonic()
        ready = poll.poll(max(0.0, left_s) * 1000) if left_s > 0 else []
        if not ready:
            whole = "whole " if head else ""
            raise NoRequestError(
                f"no {whole}association request within {timeout_s:g} s", is_dicom=bool(head)
            )
        head = connection.recv(wanted, socket.MSG_PEEK)
        if not head:
            raise NoRequestError("closed without sending anything")
        if head[0] != ASSOCIATE_RQ:
            name = PDU_NAMES.get(head[0])
            if name is None:
                raise NoRequestError(f"not DICOM: first byte 0x{head[0]:02X}")
            raise NoRequestError(f"{name} before any association request", is_dicom=True)
        if len(head) >= wanted > _HEAD_BYTES:
            break
        if len(head) >= _HEAD_BYTES:
            whole = _HEAD_BYTES + struct.unpack_from(">L", head, 2)[0]
            wanted = min(max(whole, _HEAD_BYTES + 1), _MOST_PEEKED_BYTES)
        if ready[0][1] & (select.POLLRDHUP | select.POLLHUP) and len(head) < wanted:
            raise NoRequestError("closed within its association request", is_dicom=True)
        if len(head) < wanted:
            time.sleep(_NAP_S)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)
