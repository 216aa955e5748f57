"""A second process that stops the motors when the daemon cannot: killed, crashed hard, frozen.

It is forked before any port is opened and knows the ports by name. The daemon's loop writes a byte
into a pipe twenty times a second; when the pipe closes without a farewell, or stays silent, the
guardian opens the ports itself and sends the stop bytes. It ignores terminal signals and has its
own session, so what kills the daemon's group by mistake spares it.
"""

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import serial

_BEAT, _FAREWELL = b"b", b"x"
_PAUSE_S = 0.004  # a controller answers within 2 ms; never talk into its answer
_ROUNDS = 2
BEAT_S = 0.05


@dataclass(frozen=True)
class StopOrder:
    """What to write to which port, piece by piece, so that every motor on it stops."""

    url: str
    baud: int
    pieces: tuple[bytes, ...]


class Guardian:
    """The daemon's handle on its guardian process."""

    def __init__(self, orders: Sequence[StopOrder], silent_s: float) -> None:
        """Fork now. Call before ports, threads or journals exist."""
        read_end, self._write_end = os.pipe()
        os.set_blocking(self._write_end, False)
        self.pid = os.fork()
        if self.pid == 0:
            os.close(self._write_end)
            _guard(read_end, orders, silent_s)
            os._exit(0)
        os.close(read_end)
        self._lost = False
        self._beaten_s = 0.0

    def beat(self) -> None:
        """Call every turn of the loop."""
        now_s = time.monotonic()
        if now_s - self._beaten_s < BEAT_S:
            return
        self._beaten_s = now_s
        with contextlib.suppress(OSError):
            os.write(self._write_end, _BEAT)

    @property
    def lost(self) -> bool:
        """Whether the guardian has died before its time."""
        if not self._lost:
            with contextlib.suppress(ChildProcessError):
                self._lost = os.waitpid(self.pid, os.WNOHANG)[0] == self.pid
        return self._lost

    def dismiss(self) -> None:
        """The motors stand and the ports are closed: nothing is left to guard."""
        with contextlib.suppress(OSError):
            os.write(self._write_end, _FAREWELL)
        with contextlib.suppress(OSError):
            os.close(self._write_end)
        if not self._lost:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, 0)
            self._lost = True


def _guard(read_end: int, orders: Sequence[StopOrder], silent_s: float) -> None:
    """The guardian's whole life. Must never raise: there is nobody to catch it."""
    with contextlib.suppress(OSError):
        os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    beaten = stopped = False
    while True:
        ready, _, _ = select.select([read_end], [], [], silent_s if beaten else None)
        if not ready:
            if not stopped:  # frozen; once is enough, it will latch a stop when it thaws
                send_stop_orders(orders)
            stopped = True
            continue
        data = os.read(read_end, 4096)
        if _FAREWELL in data:
            return
        if not data:
            send_stop_orders(orders)
            return
        beaten, stopped = True, False


def send_stop_orders(orders: Sequence[StopOrder]) -> None:
    """Write every order, each port shielded from the failure of the others."""
    for _ in range(_ROUNDS):
        for order in orders:
            try:
                _send(order)
            except Exception as error:  # whatever it is, the next port must get its stop
                sys.stderr.write(f"guardian: {order.url}: could not send a stop: {error}\n")


def _send(order: StopOrder) -> None:
    port = serial.serial_for_url(order.url, baudrate=order.baud, timeout=0, write_timeout=0.2)
    try:
        for piece in order.pieces:
            port.write(piece)
            port.flush()
            time.sleep(_PAUSE_S)
    finally:
        port.close()
