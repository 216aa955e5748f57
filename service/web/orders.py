"""Orders: what changes something names who asked, and is carried out once."""

from __future__ import annotations

import time
from contextvars import ContextVar
from typing import Annotated, Any

from fastapi import Depends, Header, Request

from service.room.control import ControlLoop
from service.web.access import Identity
from service.web.idempotency import IdempotencyKeys
from service.web.problems import responses
from service.web.schemas import Ask

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=128,
        description="A command sent again with the same key is not carried out again.",
    ),
]
REFUSALS = responses(400, 401, 403, 409, 413, 422, 429, 503)
REFUSALS_WITH_ID = responses(400, 401, 403, 404, 409, 413, 422, 429, 503)


ASKED_AT = "X-Asked-At"
_asked_s: ContextVar[float | None] = ContextVar("asked_s", default=None)


async def identity_of(request: Request) -> Identity:
    """Who asks, as the gate found out; notes when it was asked."""
    _asked_s.set(when_asked(request.headers.get(ASKED_AT), time.monotonic()))
    identity: Identity = request.state.identity
    return identity


def when_asked(told: str | None, now_s: float) -> float:
    """When an order was given, by our clock that nobody sets.

    told: by whoever asks (the header X-Asked-At: `clock_s` of a beat, and the time since); it can
    only make an order older than its arrival.
    """
    try:
        asked_s = float(told or "")
    except ValueError:
        return now_s
    return asked_s if asked_s <= now_s else now_s


Caller = Annotated[Identity, Depends(identity_of)]


class Orders:
    """Hands orders to the control loop under the name of whoever is logged in; one for a room."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop
        self._once = IdempotencyKeys()

    def carry_out(
        self, caller: Identity, key: str | None, name: str, body: Ask, **path: Any
    ) -> Any:
        """Carry out a command of the control loop; `body` and `path` are its arguments."""
        arguments = {**body.model_dump(), **path, "by": who(caller, body.by)}
        asked_s = _asked_s.get()
        what = f"{name} {body.model_dump_json()} {path}"
        return self._once.carry_out(
            caller.name, key, what, lambda: self._loop.call(name, arguments, asked_s)
        )


def who(caller: Identity, claimed: str) -> str:
    """The name that is recorded: a token's own name wins over what the body says."""
    return caller.name or claimed
