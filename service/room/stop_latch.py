"""STOP as the service knows it: from the press until somebody re-arms, whatever the link does."""

from __future__ import annotations

import threading
import time

_ANSWER_S = 2.0


class StopLatch:
    """Pressed from any thread. Nothing that was asked for before a STOP was answered is done.

    A STOP that nobody answers (it came another way than by HTTP) counts as answered after 2 s.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pressed = 0
        self._answered = 0
        self._released = 0
        self._until_s = float("-inf")

    def press(self) -> int:
        """Return the number of this STOP."""
        with self._lock:
            self._pressed += 1
            self._until_s = time.monotonic() + _ANSWER_S
            return self._pressed

    def answer(self, number: int) -> None:
        """Whoever pressed is told what became of it: orders from now on may count again."""
        with self._lock:
            self._answered = max(self._answered, number)
            if self._answered == self._pressed:
                self._until_s = time.monotonic()

    @property
    def pressed(self) -> int:
        """How often STOP was pressed."""
        return self._pressed

    @property
    def standing(self) -> bool:
        """True from a press until the re-arming that follows it."""
        return self._released < self._pressed

    def voids(self, asked_s: float) -> bool:
        """True of an order that was asked for (monotonic clock) before a STOP was answered."""
        with self._lock:
            return asked_s <= self._until_s

    def release(self, pressed: int) -> None:
        """The robot was re-armed by somebody who knew of so many presses."""
        with self._lock:
            self._released = max(self._released, pressed)
