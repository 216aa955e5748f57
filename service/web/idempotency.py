"""Idempotency keys: a command that is sent again under the same key is not carried out again."""

from __future__ import annotations

import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from service.web.problems import ProblemError

_KEPT_S = 24 * 3600.0
_MOST_KEPT = 2000
_PATIENCE_S = 40.0


@dataclass(frozen=True, eq=False)
class _Done:
    fingerprint: str
    answer: Future[Any]
    at_s: float


class IdempotencyKeys:
    """Remembers what was answered to each key, for a day, in this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._done: OrderedDict[tuple[str, str], _Done] = OrderedDict()

    def carry_out(self, who: str, key: str | None, what: str, run: Callable[[], Any]) -> Any:
        """Return what `run` returns or returned under this key before; errors likewise.

        Raises ProblemError 422 if the key was used for another command.
        """
        if key is None:
            return run()
        fingerprint = hashlib.sha256(what.encode()).hexdigest()
        with self._lock:
            self._forget()
            known = self._done.get((who, key))
            if known is None:
                mine = _Done(fingerprint, Future(), time.monotonic())
                self._done[(who, key)] = mine
        if known is None:
            return _run(run, mine.answer)
        if known.fingerprint != fingerprint:
            detail = "This Idempotency-Key was used for another command."
            raise ProblemError(422, "key_reused", detail)
        return known.answer.result(timeout=_PATIENCE_S)

    def _forget(self) -> None:
        oldest_s = time.monotonic() - _KEPT_S
        while self._done:
            first = next(iter(self._done))
            if len(self._done) <= _MOST_KEPT and self._done[first].at_s > oldest_s:
                return
            del self._done[first]


def _run(run: Callable[[], Any], answer: Future[Any]) -> Any:
    try:
        result = run()
    except BaseException as error:
        answer.set_exception(error)
        raise
    answer.set_result(result)
    return result
