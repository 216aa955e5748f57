"""Connections that say nothing: few, for a short time, and never in the way of a STOP.

Whoever connects and does not ask waits here. When many do, the oldest of whoever has the most of
them is let go; each of them is after a while. Nobody has to be known for that, and nobody is.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any, ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_SILENT = 128
PATIENCE_S = 10.0


class PatientProtocol(H11Protocol):
    """uvicorn's protocol, which itself waits for ever for the first request."""

    _silent: ClassVar[dict[PatientProtocol, str]] = {}  # in the order in which they came

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._silent[self] = self.client[0] if self.client else ""
        self._until: asyncio.TimerHandle | None = self.loop.call_later(PATIENCE_S, self._let_go)
        if len(self._silent) > MOST_SILENT:
            crowd, _ = Counter(self._silent.values()).most_common(1)[0]
            next(one for one, peer in self._silent.items() if peer == crowd)._let_go()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.cycle is not None:  # a whole head of a request has come
            self._is_heard()

    def connection_lost(self, exc: Exception | None) -> None:
        self._is_heard()
        super().connection_lost(exc)

    def _is_heard(self) -> None:
        self._silent.pop(self, None)
        if self._until is not None:
            self._until.cancel()
            self._until = None

    def _let_go(self) -> None:
        self._is_heard()
        self.transport.abort()

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: Any) -> bool:
        return self is other
