"""Logging in and out on the page."""

from __future__ import annotations

import time

from fastapi import APIRouter, Request, Response

from service.web.access import Access, Identity
from service.web.orders import Caller
from service.web.origins import came_over_tls
from service.web.problems import ProblemError, responses
from service.web.request_guard import COOKIE, check_token, session_secret, unauthorized
from service.web.schemas import LoginBody, SessionBody


def access_router(access: Access, *, cookie_path: str = "/") -> APIRouter:
    """cookie_path: the path prefix below which the browser sees the page."""
    router = APIRouter(tags=["access"])

    @router.get("/api/v1/session", responses=responses(401, 429))
    async def session(caller: Caller) -> SessionBody:
        """Who the caller is."""
        return _body(access, caller)

    @router.post("/api/v1/session", responses=responses(400, 401, 409, 413, 422, 429))
    async def log_in(request: Request, response: Response, body: LoginBody) -> SessionBody:
        """Log in with a token; the session is kept in an HttpOnly cookie."""
        if not access.rules.needs_token:
            raise ProblemError(409, "no_tokens", "This room uses no tokens: no login is needed.")
        try:
            identity = check_token(access, request.scope, body.token)
        except PermissionError as error:
            raise unauthorized(str(error)) from None
        secret, identity = access.open_session(identity, time.monotonic())
        response.set_cookie(
            COOKIE,
            secret,
            max_age=int(access.rules.session_s),
            httponly=True,
            samesite="strict",
            path=cookie_path,
            secure=came_over_tls(request.headers, request.url.scheme),
        )
        return _body(access, identity)

    @router.delete("/api/v1/session", status_code=204, responses=responses(401, 403, 429))
    async def log_out(request: Request, response: Response) -> None:
        """Log out."""
        access.close_session(session_secret(request.headers))
        response.delete_cookie(
            COOKIE,
            path=cookie_path,
            httponly=True,
            samesite="strict",
            secure=came_over_tls(request.headers, request.url.scheme),
        )

    return router


def _body(access: Access, caller: Identity) -> SessionBody:
    return SessionBody(
        name=caller.name or "operator",
        role=caller.role,
        csrf=caller.csrf,
        needs_token=access.rules.needs_token,
    )
