"""pynetdicom as a sender, without the race in which it takes its own peer's answer away.

An association's reactor thread must stand still while the caller waits for an answer, or it takes
the answer as if it were a request, and the caller waits for nothing until its DIMSE timeout.
pynetdicom 3.0 asks for the pause with an event and reads `_is_paused` for the reply; but a reactor
that has just passed the event still says that it is paused. On a busy machine about one C-STORE in
some hundreds to thousands is lost so, whoever the receiver is.
"""

import threading
import time

from pynetdicom.association import Association

_ROUND_S = 0.0001


class Checkpoint:
    """Stands in for the event: `clear` returns only when the reactor really waits, or is no more.

    Whether it may pass is decided under the same lock as whether it stands.
    """

    def __init__(self, reactor: threading.Thread) -> None:
        self._reactor = reactor
        self._changed = threading.Condition()
        self._open = True
        self._standing = False

    def is_set(self) -> bool:
        return self._open

    def set(self) -> None:
        with self._changed:
            self._open = True
            self._changed.notify_all()

    def clear(self) -> None:
        with self._changed:
            self._open = False
        # An aborted association opens the checkpoint again and ends its reactor.
        while not (self._standing or self._open) and self._reactor.is_alive():
            time.sleep(_ROUND_S)

    def wait(self, timeout: float | None = None) -> bool:
        with self._changed:
            self._standing = True
            passed = self._changed.wait_for(lambda: self._open, timeout)
            self._standing = False
        return passed


def mended(association: Association) -> Association:
    """Return an association that was just requested, its checkpoint replaced by a sure one."""
    association._reactor_checkpoint = Checkpoint(association)
    return association
