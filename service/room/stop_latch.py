"""STOP as the service knows it: from the press until somebody re-arms, whatever the link does."""

from __future__ import annotations

import threading
import time


class StopLatch:
    """Pressed from any thread. Nothing that was asked for before a STOP was answered is done."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pressed = 0
        self._answered = 0
        self._released = 0
        self._answered_s = -1.0

    def press(self) -> int:
        """Return the number of this STOP."""
        with self._lock:
            self._pressed += 1
            return self._pressed

    def answer(self, number: int) -> None:
        """Whoever pressed is told what became of it: orders from now on may count again."""
        with self._lock:
            self._answered = max(self._answered, number)
            self._answered_s = time.monotonic()

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
            return self._answered < self._pressed or asked_s <= self._answered_s

    def release(self, pressed: int) -> None:
        """The robot was re-armed by somebody who knew of so many presses."""
        with self._lock:
            self._released = max(self._released, pressed)
