"""The service's end of the wire: opened again and again, and always ready for a STOP."""

import contextlib
from collections.abc import Callable

from robot_bridge.protocol.transport import Transport, TransportError


class Line:
    """`write_stop` may be called from any thread; everything else is the control thread's."""

    def __init__(
        self,
        url: str,
        open_transport: Callable[[], Transport],
        open_for_stop: Callable[[], Transport],
    ) -> None:
        self.url = url
        self._open_transport = open_transport
        self._open_for_stop = open_for_stop
        self._transport: Transport | None = None

    @property
    def is_open(self) -> bool:
        return self._transport is not None

    def open(self) -> None:
        """Raises TransportError."""
        self._transport = self._open_transport()

    def read(self, wait_s: float) -> bytes:
        """Raises TransportError; the line is closed then."""
        assert self._transport is not None
        try:
            return self._transport.read(wait_s)
        except TransportError:
            self.drop()
            raise

    def write(self, data: bytes) -> None:
        """A closed line takes nothing. Raises TransportError; the line is closed then."""
        if not data or self._transport is None:
            return
        try:
            self._transport.write(data)
        except TransportError:
            self.drop()
            raise

    def write_stop(self, encoded: bytes) -> None:
        """Called by the stopper's threads; must not touch anything but the transport."""
        transport = self._transport
        if transport is not None:
            transport.write(encoded)
            return
        transport = self._open_for_stop()
        try:
            transport.write(encoded)
        finally:
            transport.close()

    def drop(self) -> None:
        transport, self._transport = self._transport, None
        if transport is not None:
            # It may be gone already; then nothing is left to release.
            with contextlib.suppress(TransportError):
                transport.close()
