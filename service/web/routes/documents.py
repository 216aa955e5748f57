"""A case to take along: its report as one page, its export as one zip."""

from __future__ import annotations

import shutil
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask

from service.web.documents import Documents
from service.web.of_case import OfCase
from service.web.problems import responses

_ERRORS = responses(401, 404, 409, 422, 429, 503)
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_HTML = {"schema": {"type": "string"}}
# the report loads nothing; its own styles and its images stand in the page itself
_REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'; sandbox"
)


def document_router() -> APIRouter:
    router = APIRouter(tags=["documents"])
    documents = Documents()

    @router.get(
        "/api/v1/report",
        response_class=FileResponse,
        responses={**_ERRORS, 200: {"description": "The page", "content": {"text/html": _HTML}}},
    )
    def report(case: OfCase) -> FileResponse:
        """One page of a case: images, tables, plots. It loads nothing from anywhere."""
        folder = case.folder
        path = documents.make("report", folder, f"{folder.name}-report.html")
        headers = {"Content-Security-Policy": _REPORT_POLICY, "Cache-Control": "no-store"}
        return FileResponse(
            path, media_type="text/html", headers=headers, background=_removal(path)
        )

    @router.get(
        "/api/v1/export",
        response_class=FileResponse,
        responses={
            **_ERRORS,
            200: {"description": "The zip", "content": {"application/zip": _BINARY}},
        },
    )
    def export(case: OfCase) -> FileResponse:
        """A case as one zip: every DICOM file as it was received, JSON lines, images."""
        folder = case.folder
        name = f"{folder.name}.zip"
        path = documents.make("export", folder, name)
        return FileResponse(
            path,
            media_type="application/zip",
            filename=name,
            headers={"Cache-Control": "no-store"},
            background=_removal(path),
        )

    return router


def _removal(path: Path) -> BackgroundTask:
    return BackgroundTask(shutil.rmtree, path.parent, ignore_errors=True)
