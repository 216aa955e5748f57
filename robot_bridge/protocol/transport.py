"""The one place that opens serial lines: bytes with bounded waits over a pyserial URL."""

import os
import select
import socket
from typing import Protocol

import serial

READ_MAX = 4096


class TransportError(Exception):
    """The line cannot be opened or is gone; the text names it."""


class Transport(Protocol):
    def read(self, wait_s: float) -> bytes:
        """What has arrived, waiting at most `wait_s` for the first byte. Raises TransportError."""

    def write(self, data: bytes) -> None:
        """Send now. Whole frames from several threads do not mix. Raises TransportError."""

    def close(self) -> None: ...


class SerialTransport:
    """A device, a pseudo-terminal or `socket://host:port`, opened by pyserial.

    A device is locked against other programs that lock it too: two readers would each get half of
    the bytes. `exclusive=False` is for one who only writes (STOP).
    """

    def __init__(
        self, url: str, baud: int, *, exclusive: bool = True, write_timeout_s: float = 0.3
    ) -> None:
        self.url = url
        is_device = "://" not in url
        try:
            self._serial = serial.serial_for_url(
                url,
                baudrate=baud,
                timeout=0,
                write_timeout=write_timeout_s,
                exclusive=True if exclusive and is_device else None,
            )
            if exclusive:
                self._serial.reset_input_buffer()
            if url.startswith("socket://"):
                # STOP must not wait for a full segment.
                self._serial._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except (serial.SerialException, OSError, ValueError) as error:
            raise TransportError(f"{url}: cannot be opened: {_reason(error)}") from error

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def read(self, wait_s: float) -> bytes:
        try:
            ready, _, _ = select.select([self.fileno()], [], [], max(0.0, wait_s))
            if not ready:
                return b""
            return bytes(self._serial.read(READ_MAX))
        except (serial.SerialException, OSError, ValueError, TypeError) as error:
            raise TransportError(f"{self.url}: disconnected: {_reason(error)}") from error

    def write(self, data: bytes) -> None:
        if not data:
            return
        try:
            self._serial.write(data)
        except (serial.SerialException, OSError, ValueError, TypeError) as error:
            raise TransportError(f"{self.url}: cannot be written: {_reason(error)}") from error

    def close(self) -> None:
        try:
            self._serial.close()
        except (serial.SerialException, OSError) as error:
            raise TransportError(f"{self.url}: cannot be closed: {_reason(error)}") from error


class DescriptorTransport:
    """An open socket or pipe of our own; what the engineer's direct commands talk through."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def fileno(self) -> int:
        return self._end.fileno()

    def read(self, wait_s: float) -> bytes:
        try:
            ready, _, _ = select.select([self._end], [], [], max(0.0, wait_s))
            data = self._end.recv(READ_MAX) if ready else None
        except (OSError, ValueError) as error:
            raise TransportError(f"the other end has disconnected: {_reason(error)}") from error
        if data == b"":
            raise TransportError("the other end has disconnected")
        return data or b""

    def write(self, data: bytes) -> None:
        try:
            self._end.sendall(data)
        except OSError as error:
            raise TransportError(f"the other end has disconnected: {_reason(error)}") from error

    def close(self) -> None:
        self._end.close()


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return str(error) or type(error).__name__
