"""Emulated controllers behind a real pseudo-terminal or TCP port, as a thread-free server.

One process-local loop: `EmulatorServer.serve_once` waits at most a few milliseconds, feeds the
bus and sends what is due. The command that runs it is in emulator.main.
"""

import contextlib
import os
import select
import socket
import time
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.line_server import LineServer

MOVING_WAIT_S = 0.004
IDLE_WAIT_S = 0.25


class Wire(Protocol):
    """The emulator's end of a serial line."""

    @property
    def url(self) -> str:
        """What a driver opens."""
        ...

    def descriptors(self) -> list[int]: ...

    def receive(self, ready: Sequence[int]) -> bytes: ...

    def send(self, data: bytes) -> None: ...

    def close(self) -> None: ...


class PseudoTerminal:
    """A pty whose slave side a driver opens like a serial port; `link` is made to point at it."""

    def __init__(self, link: Path | None = None) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        # Our own handle on the slave stays open, so that a driver may come and go.
        self._name = os.ttyname(self._slave)
        self._link = link
        if link is not None:
            self._make_link(link)

    def _make_link(self, link: Path) -> None:
        if link.exists() and not link.is_symlink():
            raise FileExistsError(f"{link} exists and is not a link to a pseudo-terminal")
        fresh = link.with_name(f".{link.name}.{os.getpid()}")
        fresh.symlink_to(self._name)
        fresh.replace(link)

    @property
    def url(self) -> str:
        return str(self._link or self._name)

    def descriptors(self) -> list[int]:
        return [self._master]

    def receive(self, ready: Sequence[int]) -> bytes:
        if self._master not in ready:
            return b""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, 4096)
        return b""

    def send(self, data: bytes) -> None:
        # Nobody reads: a real line loses the bytes as well.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def close(self) -> None:
        link = self._link
        if link is not None and link.is_symlink() and os.readlink(link) == self._name:
            link.unlink()
        os.close(self._master)
        os.close(self._slave)


class TcpPort:
    """A serial-to-Ethernet server on the loopback; one client at a time, the newest counts."""

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.setblocking(False)
        self._client: socket.socket | None = None

    @property
    def url(self) -> str:
        return f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def descriptors(self) -> list[int]:
        client = [self._client.fileno()] if self._client else []
        return [self._listener.fileno(), *client]

    def receive(self, ready: Sequence[int]) -> bytes:
        if self._listener.fileno() in ready:
            self._drop_client()
            self._client, _ = self._listener.accept()
            self._client.setblocking(False)
        if self._client is None or self._client.fileno() not in ready:
            return b""
        try:
            data = self._client.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop_client()
        return data

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def send(self, data: bytes) -> None:
        if self._client is not None:
            try:
                self._client.send(data)
            except BlockingIOError:
                pass
            except OSError:
                self._drop_client()

    def close(self) -> None:
        self._drop_client()
        self._listener.close()


class EmulatorServer:
    """One bus on one wire."""

    def __init__(self, bus: EmulatedBus, wire: Wire) -> None:
        self.bus, self.wire = bus, wire

    def wait_s(self, now_s: float) -> float:
        """How long the caller may wait for input before `serve` has to run again."""
        wait_s = MOVING_WAIT_S if self.bus.busy else IDLE_WAIT_S
        due_s = self.bus.next_output_s()
        return wait_s if due_s is None else max(0.0, min(wait_s, due_s - now_s))

    def serve(self, ready: Sequence[int]) -> None:
        """Take in what has come, move on in time, send out what is due."""
        data = self.wire.receive(ready)
        now_s = time.monotonic()
        if data:
            self.bus.receive(data, now_s)
        else:
            self.bus.advance(now_s)
        due = self.bus.take_output(now_s)
        if due:
            self.wire.send(due)

    def serve_once(self) -> None:
        ready, _, _ = select.select(self.wire.descriptors(), [], [], self.wait_s(time.monotonic()))
        self.serve(ready)

    def close(self) -> None:
        self.wire.close()


def serve_until(
    running: Callable[[], bool], server: EmulatorServer, others: Sequence[LineServer] = ()
) -> None:
    """One loop over the serial line and the control ports."""
    while running():
        control = [d for other in others for d in other.descriptors()]
        watched = [*server.wire.descriptors(), *control]
        ready, _, _ = select.select(watched, [], [], server.wait_s(time.monotonic()))
        server.serve(ready)
        for other in others:
            other.serve(ready)
