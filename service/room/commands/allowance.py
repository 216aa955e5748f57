"""How often one machine may ask for what is recorded and put before the operator.

By machine, not by connection: who connects again has another port and is the same sender.
"""

from __future__ import annotations

import time
from collections.abc import Callable

_AT_ONCE, _PER_S = 10.0, 1.0
_AGAIN_S = 60.0


class Allowance:
    """Ten at once, then one per second."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._left, self._at_s = _AT_ONCE, now_s()

    def take(self) -> bool:
        """Whether one more may be asked now; it is then counted."""
        self._refill()
        if self._left < 1:
            return False
        self._left -= 1
        return True

    @property
    def is_whole(self) -> bool:
        self._refill()
        return self._left >= _AT_ONCE

    def _refill(self) -> None:
        now_s = self._now_s()
        self._left = min(_AT_ONCE, self._left + (now_s - self._at_s) * _PER_S)
        self._at_s = now_s


class Allowances:
    """One of each kind for every machine that asked lately."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str], Allowance] = {}

    def of(self, host: str, kind: str) -> Allowance:
        for key in [key for key, one in self._known.items() if one.is_whole]:
            del self._known[key]
        return self._known.setdefault((host, kind), Allowance())


class Said:
    """What was said within the last minute is not said again."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._at_s: dict[str, float] = {}

    def is_news(self, text: str) -> bool:
        now_s = self._now_s()
        self._at_s = {one: at_s for one, at_s in self._at_s.items() if now_s - at_s < _AGAIN_S}
        if text in self._at_s:
            return False
        self._at_s[text] = now_s
        return True
