"""Errors of the API: RFC 9457 problem details, one table from exception to status.

`title` is a code for programs, `detail` says in words what is wrong and what to do.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from concurrent.futures import TimeoutError as CommandTimeoutError
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from case_record.cases import CasesError, NoCaseError
from case_record.record import CaseRecordError, RecordUnavailableError
from case_record.seal_chain import TamperedError
from service.room.images import ImageMissingError
from service.room.refusal import ConflictError

PROBLEM_TYPE = "application/problem+json"
_CODES = {404: "not_found", 405: "method_not_allowed", 415: "unsupported_media_type"}


class Problem(BaseModel):
    """RFC 9457. `title` is a code for programs, `detail` a sentence for people."""

    type: str = Field(examples=["urn:autospine:stale_plan"])
    title: str = Field(examples=["stale_plan"])
    status: int = Field(examples=[409])
    detail: str = Field(examples=["The robot has moved since this plan was made: measure again."])
    errors: list[dict[str, Any]] | None = None


class ProblemError(Exception):
    """Raise it anywhere in a handler; the answer is the problem document."""

    def __init__(
        self, status: int, code: str, detail: str, headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.headers = dict(headers or {})


def problem(
    status: int,
    code: str,
    detail: str,
    *,
    headers: Mapping[str, str] | None = None,
    errors: list[dict[str, Any]] | None = None,
) -> JSONResponse:
    """Return the response that carries a problem document."""
    body: dict[str, Any] = {
        "type": f"urn:autospine:{code}",
        "title": code,
        "status": status,
        "detail": detail,
    }
    if errors is not None:
        body["errors"] = errors
    return JSONResponse(body, status, headers=dict(headers or {}), media_type=PROBLEM_TYPE)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI: the problems that an operation may answer with."""
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "model": Problem,
            "content": {PROBLEM_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for status in statuses
    }


def add_problems(app: FastAPI) -> None:
    """Make every error of the app a problem document."""

    @app.exception_handler(ProblemError)
    async def told(_: Request, error: ProblemError) -> JSONResponse:
        return problem(error.status, error.code, error.detail, headers=error.headers)

    @app.exception_handler(ConflictError)
    async def conflict(_: Request, error: ConflictError) -> JSONResponse:
        return problem(409, error.code, str(error))

    @app.exception_handler(NoCaseError)
    async def no_case(_: Request, error: NoCaseError) -> JSONResponse:
        return problem(409, "no_case", str(error))

    @app.exception_handler(CasesError)
    async def cases(_: Request, error: CasesError) -> JSONResponse:
        return problem(409, "cases", str(error))

    @app.exception_handler(CaseRecordError)
    async def unknown(_: Request, error: CaseRecordError) -> JSONResponse:
        return problem(404, "not_found", str(error))

    @app.exception_handler(TamperedError)
    async def changed(_: Request, error: TamperedError) -> JSONResponse:
        return problem(409, "record_changed", str(error))

    @app.exception_handler(RecordUnavailableError)
    @app.exception_handler(sqlite3.OperationalError)
    async def unusable(_: Request, error: Exception) -> JSONResponse:
        detail = f"The case record cannot be used now ({error}): try again."
        return problem(503, "record_unusable", detail)

    @app.exception_handler(ImageMissingError)
    async def no_image(_: Request, error: ImageMissingError) -> JSONResponse:
        return problem(404, "no_image", str(error))

    @app.exception_handler(CommandTimeoutError)
    async def late(_: Request, __: CommandTimeoutError) -> JSONResponse:
        detail = "The control loop did not answer in time; check the state before trying again."
        return problem(503, "no_answer", detail)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        return _invalid(error)

    @app.exception_handler(HTTPException)
    async def http(_: Request, error: HTTPException) -> JSONResponse:
        code = _CODES.get(error.status_code, "http_error")
        return problem(error.status_code, code, str(error.detail), headers=error.headers)

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        structlog.get_logger().error("request failed", path=request.url.path, exc_info=error)
        return problem(500, "internal_error", "Internal error; see the service's log.")


def _invalid(error: RequestValidationError) -> JSONResponse:
    faults = [
        {"where": ".".join(str(part) for part in fault["loc"]), "what": fault["msg"]}
        for fault in error.errors()
    ]
    if any(fault["type"] == "json_invalid" for fault in error.errors()):
        return problem(400, "malformed_json", "The body is not JSON.", errors=faults)
    first = faults[0]
    detail = f"{first['where']}: {first['what']}"
    return problem(422, "invalid_request", detail, errors=faults)
