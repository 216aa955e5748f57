"""The serial ports of a robot's controllers: opening, capturing, stopping, closing."""

import contextlib
import errno
import os
import select
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import serial

from robot_bridge.daemon.motors import MotorError
from robot_bridge.pmd.capture import CaptureWriter, CapturingPort
from robot_bridge.pmd.line import PmdLine, Port
from robot_bridge.pmd.protocol import emergency_stop_bytes

READ_WAIT_S, WRITE_WAIT_S = 0.002, 0.03

OpenPort = Callable[[str], Port]


class SerialPort:
    """A device, a pseudo-terminal or any other pyserial URL. Every failure is an OSError."""

    def __init__(self, url: str, baud: int, *, exclusive: bool = True) -> None:
        # pyserial's write timeout strikes after a whole write too, when the computer is busy, and
        # without one it may wait for ever: so it writes what it can, and waiting is done here.
        self._port = serial.serial_for_url(
            url,
            baudrate=baud,
            timeout=READ_WAIT_S,
            write_timeout=0,
            exclusive=True if exclusive else None,
        )
        # An FTDI adapter holds answers back for 16 ms unless it is told not to.
        with contextlib.suppress(AttributeError, OSError, ValueError, NotImplementedError):
            self._port.set_low_latency_mode(True)

    def read(self, size: int = 1, /) -> bytes:
        data: bytes = self._port.read(size)
        return data

    def write(self, data: bytes, /) -> int | None:
        left = data
        while left:
            _, ready, _ = select.select([], [self._port.fileno()], [], WRITE_WAIT_S)
            if not ready:
                raise OSError(f"accepts no more bytes; {len(left)} of {len(data)} are left")
            left = left[self._port.write(left) :]
        return len(data)

    def reset_input_buffer(self) -> None:
        try:
            self._port.reset_input_buffer()
        except termios.error as error:  # pyserial lets this one through
            raise OSError(*error.args) from error

    def close(self) -> None:
        self._port.close()


def _why(error: Exception) -> str:
    """pyserial says the port's name twice over."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number in (errno.ENOENT, errno.EACCES) else str(error)


class PmdPorts:
    """The lines by port URL, each with the addresses of the controllers on it."""

    def __init__(
        self,
        addresses: Mapping[str, Sequence[int]],
        *,
        timeout_s: float,
        capture_file: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
        open_port: OpenPort,
    ) -> None:
        self._addresses = {url: list(on_it) for url, on_it in addresses.items()}
        self._timeout_s, self._clock, self._open_port = timeout_s, clock, open_port
        self._capture_file = capture_file
        self._capture: CaptureWriter | None = None
        self._ports: list[Port] = []
        self.lines: dict[str, PmdLine] = {}

    def connect(self) -> None:
        """Open whatever is not open. Raises MotorError."""
        for url in self._addresses:
            if url in self.lines:
                continue
            try:
                port = self._captured(self._open_port(url), url)
                self._ports.append(port)
                # Whatever half line the controllers hold is cancelled.
                port.write(b"\x1b;")
            except (OSError, ValueError) as error:
                raise MotorError("no_port", f"controller port {url}: {_why(error)}") from error
            self.lines[url] = PmdLine(port, self._timeout_s, self._clock)

    def _captured(self, port: Port, url: str) -> Port:
        if self._capture_file is None:
            return port
        if self._capture is None:
            self._capture = CaptureWriter(self._capture_file)
        return CapturingPort(port, url, self._capture)

    def send_stop(self) -> list[str]:
        """The bytes that stop everything, at once, to every open line; returns what failed."""
        failures = []
        for url, line in self.lines.items():
            try:
                line.write_now(emergency_stop_bytes(self._addresses[url]))
            except OSError as error:
                failures.append(f"controller port {url}: {error}")
        return failures

    def give_up_tasks(self) -> None:
        for line in self.lines.values():
            line.cancel_all()

    def close(self) -> None:
        self.give_up_tasks()
        for port in self._ports:
            with contextlib.suppress(OSError):  # it may be gone
                port.close()
        self._ports, self.lines = [], {}
        if self._capture is not None:
            self._capture.close()
            self._capture = None
