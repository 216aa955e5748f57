"""Repeats STOP until it is acknowledged, whatever the rest of the program is doing."""

import contextlib
import threading
from collections.abc import Callable

from robot_bridge.protocol import framing
from robot_bridge.protocol.transport import TransportError

STOP_REPEAT_S = 0.02


class Stopper:
    """Repeats STOP until it is acknowledged.

    The control thread repeats it as it pumps; a thread of the stopper's own does when the control
    thread does not, whatever keeps it.
    """

    def __init__(
        self,
        write: Callable[[bytes], None],
        clock: Callable[[], float],
        random_bits: Callable[[int], int],
        *,
        threaded: bool,
    ) -> None:
        self.sent = 0
        self._write = write
        self._clock = clock
        self._random_bits = random_bits
        self._threaded = threaded
        self._changed = threading.Condition()
        self._pending: tuple[int, bool] | None = None
        self._sent_s = 0.0
        self._closed = False
        self._thread: threading.Thread | None = None

    @property
    def pending(self) -> bool:
        return self._pending is not None

    def request(self, emergency: bool, nonce: int | None = None) -> None:
        """nonce: of a STOP that was sent already by another way, and is to be seen through."""
        with self._changed:
            if self._pending is not None:
                emergency = emergency or self._pending[1]
            nonce = self._random_bits(32) if nonce is None else nonce
            self._pending = (nonce, emergency)
            self._sent_s = -1e9
            if self._thread is None and self._threaded:
                self._thread = threading.Thread(target=self._watch, name="stop", daemon=True)
                self._thread.start()
            self._changed.notify()
        self.repeat_if_due()

    def acknowledged(self, nonce: int) -> None:
        with self._changed:
            if self._pending is not None and self._pending[0] == nonce:
                self._pending = None

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()

    def repeat_if_due(self) -> None:
        if self._pending is None:
            return
        with self._changed:
            pending, now_s = self._pending, self._clock()
            if pending is None or now_s - self._sent_s < STOP_REPEAT_S:
                return
            self._sent_s = now_s
            self.sent += 1
        # A line that is gone: the control loop finds out and opens it again; we keep trying.
        with contextlib.suppress(TransportError):
            self._write(framing.encode_stop(*pending))

    def _watch(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._pending is not None)
                self._changed.wait_for(lambda: self._closed, timeout=STOP_REPEAT_S)
                if self._closed:
                    return
            self.repeat_if_due()
