"""`autospine token NAME`: a new token, and what goes into the room's file."""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Annotated

import typer
from pydantic import ValidationError

from room_config.load import ConfigError
from room_config.service import AccessToken
from service.web.access import new_token, token_hash


def token(
    name: Annotated[str, typer.Argument(help="Name; recorded with every action.")],
    role: Annotated[str, typer.Option(help="viewer or operator")] = "viewer",
    expires: Annotated[str, typer.Option(help="Last day, YYYY-MM-DD (UTC).")] = "",
) -> None:
    """Make a token. It is shown once; the room's file gets its hash only."""
    secret = new_token()
    known = _checked(name, role, expires, token_hash(secret))
    print(f"# The token of {known.name}. Hand it over privately; it is not stored anywhere:")
    print(secret)
    print("# For the room's file:")
    print("[[service.token]]")
    print(f"name = {_quoted(known.name)}")
    print(f'role = "{known.role}"')
    print(f'sha256 = "{known.sha256}"')
    if known.expires is not None:
        print(f"expires = {known.expires.isoformat()}")


def _checked(name: str, role: str, expires: str, sha256: str) -> AccessToken:
    values = {"name": name, "role": role, "sha256": sha256, "expires": expires or None}
    try:
        known = AccessToken.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"token: {first['loc'][0]}: {first['msg']}") from None
    if known.expires is not None and known.expires < _today():
        raise ConfigError(f"token: expires: {known.expires} is in the past")
    return known


def _today() -> date:
    return datetime.now(UTC).date()


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
