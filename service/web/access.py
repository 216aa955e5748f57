"""Who may do what: tokens (kept as hashes), sessions of browsers, lock-out after failures.

Without tokens the service listens on loopback only and whoever reaches it is an operator. With
tokens every request names one; the token's name is what the record says. No I/O in here.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from room_config.service import AccessToken

Role = Literal["viewer", "operator"]
_TOKEN_BYTES = 32
_MOST_SESSIONS = 200


@dataclass(frozen=True)
class Identity:
    """The caller. `name` empty: no tokens in use, the request's own `by` is recorded."""

    name: str
    role: Role
    csrf: str = ""

    @property
    def uses_cookie(self) -> bool:
        return bool(self.csrf)


ANYBODY = Identity("", "operator")


class LockedOutError(Exception):
    """Too many wrong tokens from one address."""

    def __init__(self, wait_s: float) -> None:
        super().__init__(f"Too many wrong tokens: wait {wait_s:.0f} s.")
        self.wait_s = wait_s


@dataclass(frozen=True)
class AccessRules:
    tokens: Sequence[AccessToken]
    session_s: float
    lock_out_after: int
    lock_out_s: float

    @property
    def needs_token(self) -> bool:
        return bool(self.tokens)


@dataclass
class _Session:
    identity: Identity
    ends_s: float


@dataclass
class _Failures:
    times_s: list[float] = field(default_factory=list)


def new_token() -> str:
    """Return a fresh token: 256 random bits, so that a plain hash of it is enough."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def token_hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


class Access:
    """Tokens, sessions and failures of one service; `now_s` is any steady clock, wall_s UTC."""

    def __init__(self, rules: AccessRules) -> None:
        self.rules = rules
        self._sessions: dict[str, _Session] = {}
        self._failures: dict[str, _Failures] = {}

    def check_token(self, token: str, address: str, *, now_s: float, wall_s: float) -> Identity:
        """Return whose token it is; PermissionError if nobody's, LockedOutError after too many."""
        wait_s = self._locked_for_s(address, now_s)
        if wait_s > 0:
            raise LockedOutError(wait_s)
        identity = self._owner(token, wall_s)
        if identity is None:
            self._failures.setdefault(address, _Failures()).times_s.append(now_s)
            raise PermissionError("Unknown or expired token.")
        self._failures.pop(address, None)
        return identity

    def check_token_for_stop(self, token: str, *, wall_s: float) -> Identity:
        """As `check_token`, but a STOP with a good token gets through a lock-out."""
        identity = self._owner(token, wall_s)
        if identity is None:
            raise PermissionError("Unknown or expired token.")
        return identity

    def _owner(self, token: str, wall_s: float) -> Identity | None:
        digest = token_hash(token)
        found = None
        for known in self.rules.tokens:
            # every hash is compared, in constant time: the time taken tells nothing
            if hmac.compare_digest(digest, known.sha256) and not known.has_expired(wall_s):
                found = known
        return None if found is None else Identity(found.name, found.role)

    def _locked_for_s(self, address: str, now_s: float) -> float:
        failures = self._failures.get(address)
        if failures is None:
            return 0.0
        since_s = now_s - self.rules.lock_out_s
        failures.times_s = [t for t in failures.times_s if t > since_s]
        if not failures.times_s:
            del self._failures[address]
            return 0.0
        if len(failures.times_s) < self.rules.lock_out_after:
            return 0.0
        return failures.times_s[-1] - since_s

    def open_session(self, identity: Identity, now_s: float) -> tuple[str, Identity]:
        """Return the session's secret (for the cookie) and the identity with its CSRF token."""
        self._sessions = {k: s for k, s in self._sessions.items() if s.ends_s > now_s}
        while len(self._sessions) >= _MOST_SESSIONS:
            del self._sessions[next(iter(self._sessions))]
        with_csrf = Identity(identity.name, identity.role, secrets.token_urlsafe(18))
        secret = secrets.token_urlsafe(_TOKEN_BYTES)
        self._sessions[token_hash(secret)] = _Session(with_csrf, now_s + self.rules.session_s)
        return secret, with_csrf

    def session(self, secret: str, now_s: float, wall_s: float) -> Identity | None:
        """Return whose session it is, or None; ends with its token."""
        session = self._sessions.get(token_hash(secret))
        if session is None or session.ends_s <= now_s:
            return None
        alive = any(
            t.name == session.identity.name and not t.has_expired(wall_s) for t in self.rules.tokens
        )
        return session.identity if alive else None

    def close_session(self, secret: str) -> None:
        self._sessions.pop(token_hash(secret), None)
