"""Orders: what changes something names who asked, and is carried out once."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Header, Request

from service.room.control import ControlLoop
from service.web.access import Identity
from service.web.idempotency import Once
from service.web.problems import responses
from service.web.schemas import Ask

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=128,
        description="A command sent again under the same key is not carried out again.",
    ),
]
REFUSALS = responses(400, 401, 403, 409, 413, 422, 429, 503)
REFUSALS_WITH_ID = responses(400, 401, 403, 404, 409, 413, 422, 429, 503)


def identity_of(request: Request) -> Identity:
    """Who asks, as the gate found out."""
    identity: Identity = request.state.identity
    return identity


Caller = Annotated[Identity, Depends(identity_of)]


class Orders:
    """Hands orders to the control loop under the name of whoever is logged in; one for a room."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop
        self._once = Once()

    def carry_out(
        self, caller: Identity, key: str | None, name: str, body: Ask, **path: Any
    ) -> Any:
        """Carry out a command of the control loop; `body` and `path` are its arguments."""
        arguments = {**body.model_dump(), **path, "by": who(caller, body.by)}
        what = f"{name} {body.model_dump_json()} {path}"
        return self._once.carry_out(
            caller.name, key, what, lambda: self._loop.call(name, arguments)
        )


def who(caller: Identity, claimed: str) -> str:
    """The name that is recorded: a token's own name wins over what the body says."""
    return caller.name or claimed
