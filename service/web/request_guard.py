"""What every request passes first: size, origin, who asks, what that role may do; and what every
response carries: the security headers.

Plain ASGI, so that the event stream is not buffered. A STOP is let through whatever can be let
through: from viewers, without CSRF token, during a lock-out; only a caller that is nobody is not.
"""

from __future__ import annotations

import asyncio
import time
from http.cookies import CookieError, SimpleCookie

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from room_config.networks import address_of
from service.web.access import ANYBODY, Access, Identity, LockedOutError
from service.web.origins import OriginRules, is_foreign_site
from service.web.problems import ProblemError, problem

COOKIE = "autospine_session"
STOP_PATH = "/api/v1/stop"
SESSION_PATH = "/api/v1/session"
_MOST_BODY_BYTES = 64 * 1024
_BODY_PATIENCE_S = 10.0
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_PUBLIC = frozenset({"/", "/healthz"})

SECURITY_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}


class RequestGuard:
    """Wraps the application; puts the caller's `identity` and public_url's path (`prefix`) into
    `scope["state"]`.
    """

    def __init__(
        self, app: ASGIApp, access: Access, *, uses_tls: bool, public_url: str = ""
    ) -> None:
        self._app = app
        self._access = access
        self._uses_tls = uses_tls
        self._origins = OriginRules(public_url, needs_token=access.rules.needs_token)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        send = self._with_headers(send)
        if scope["path"] == self._origins.path and self._origins.path:
            # the page's own addresses are relative: they need the slash
            await RedirectResponse(f"{self._origins.path}/", 308)(scope, receive, send)
            return
        scope = self._below_prefix(scope)
        try:
            self._let_in(scope)
            if scope["method"] not in _SAFE:
                async with asyncio.timeout(_BODY_PATIENCE_S):
                    receive = await _bounded(Headers(scope=scope), receive)
        except TimeoutError:
            text = f"The body did not arrive within {_BODY_PATIENCE_S:.0f} s."
            await problem(408, "slow_body", text)(scope, receive, send)
            return
        except ProblemError as error:
            answer: Response = problem(
                error.status, error.code, error.detail, headers=error.headers
            )
            await answer(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _below_prefix(self, scope: Scope) -> Scope:
        """A proxy that does not strip the path prefix of public_url: it is stripped here."""
        prefix = self._origins.path
        if not prefix or not scope["path"].startswith(f"{prefix}/"):
            return scope
        path = scope["path"].removeprefix(prefix)
        return {**scope, "path": path, "raw_path": path.encode()}

    def _with_headers(self, send: Send) -> Send:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if self._uses_tls:
                    headers["strict-transport-security"] = "max-age=31536000"
            await send(message)

        return sending

    def _let_in(self, scope: Scope) -> None:
        headers = Headers(scope=scope)
        path, method = scope["path"], scope["method"]
        self._check_origin(headers, method, path)
        scope.setdefault("state", {}).update(identity=ANYBODY, prefix=self._origins.path)
        if not self._access.rules.needs_token or _is_public(path, method):
            return
        identity = self._who(scope, headers, path)
        scope["state"]["identity"] = identity
        if method in _SAFE or path == STOP_PATH:
            return
        if identity.uses_cookie and headers.get("x-csrf-token") != identity.csrf:
            raise ProblemError(
                403, "csrf", "The X-CSRF-Token is missing or out of date: reload the page."
            )
        if identity.role != "operator" and path != SESSION_PATH:
            detail = f"{identity.name} is a viewer: viewers may look and press STOP only."
            raise ProblemError(403, "wrong_role", detail)

    def _check_origin(self, headers: Headers, method: str, path: str) -> None:
        """No other web page may use this browser's way to us; a STOP only not if it says so."""
        if path == STOP_PATH and not is_foreign_site(headers):
            return
        why = self._origins.why_not_host(headers)
        if why is not None:
            raise ProblemError(403, "wrong_host", why)
        why = None if method in _SAFE else self._origins.why_not_origin(headers)
        if why is not None:
            raise ProblemError(403, "cross_origin", why)

    def _who(self, scope: Scope, headers: Headers, path: str) -> Identity:
        """The caller, by bearer token or by session cookie; raises ProblemError."""
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and token:
            return self._by_token(scope, token.strip(), path)
        secret = _cookie(headers)
        if secret:
            known = self._access.session(secret, time.monotonic(), time.time())
            if known is not None:
                return known
        raise unauthorized("Log in with your token, or send it as a bearer token.")

    def _by_token(self, scope: Scope, token: str, path: str) -> Identity:
        try:
            if path == STOP_PATH:
                return self._access.check_token_for_stop(token, wall_s=time.time())
            return check_token(self._access, scope, token)
        except PermissionError as error:
            raise unauthorized(str(error)) from None


def check_token(access: Access, scope: Scope, token: str) -> Identity:
    """Return the token's owner; raises PermissionError, or ProblemError 429 during a lock-out."""
    address = _caller_address(scope)
    try:
        return access.check_token(token, address, now_s=time.monotonic(), wall_s=time.time())
    except PermissionError:
        structlog.get_logger().warning("wrong token", address=address)
        raise
    except LockedOutError as error:
        wait = {"Retry-After": str(int(error.wait_s) + 1)}
        raise ProblemError(429, "locked_out", str(error), wait) from None


def _caller_address(scope: Scope) -> str:
    """Who is locked out after wrong tokens; what a proxy says of it need not be an address."""
    client = scope.get("client")
    if not client:
        return "unknown"
    try:
        return str(address_of(client[0]))
    except ValueError:
        return str(client[0])


def unauthorized(detail: str) -> ProblemError:
    return ProblemError(401, "unauthorized", detail, {"WWW-Authenticate": "Bearer"})


def _is_public(path: str, method: str) -> bool:
    if path in _PUBLIC or path.startswith("/page/"):
        return method in _SAFE
    return path == SESSION_PATH and method == "POST"


def _cookie(headers: Headers) -> str:
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel else ""


def session_secret(headers: Headers) -> str:
    """Return the secret of the caller's session cookie, or an empty text."""
    return _cookie(headers)


async def _bounded(headers: Headers, receive: Receive) -> Receive:
    """Return a `receive` of a body that is known to be small; ProblemError 413 if it is not."""
    length = headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > _MOST_BODY_BYTES:
        raise too_large()
    read = 0
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return _once_more(message)
        body += message.get("body", b"")
        read = len(body)
        if read > _MOST_BODY_BYTES:
            raise too_large()
        if not message.get("more_body", False):
            return _replayed(bytes(body), receive)


def too_large() -> ProblemError:
    return ProblemError(413, "too_large", f"A body may have at most {_MOST_BODY_BYTES} bytes.")


def _once_more(message: Message) -> Receive:
    async def receive() -> Message:
        return message

    return receive


def _replayed(body: bytes, rest: Receive) -> Receive:
    sent = False

    async def receive() -> Message:
        nonlocal sent
        if sent:
            return await rest()
        sent = True
        return {"type": "http.request", "body": body, "more_body": False}

    return receive
