"""A case to take along: its report as one page, its export as one zip."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask

from service.room.history import case_folder
from service.web.documents import Documents
from service.web.problems import responses

_ERRORS = responses(401, 404, 409, 422, 429, 503)
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_HTML = {"schema": {"type": "string"}}
# the report loads nothing; its own styles and its images stand in the page itself
_REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'; sandbox"
)
CaseName = Annotated[
    str | None,
    Query(
        alias="case",
        min_length=1,
        max_length=255,
        description="Name of a folder that /api/v1/cases lists; left out: the present case.",
    ),
]


def document_router(case_dir: Path) -> APIRouter:
    router = APIRouter(tags=["documents"])
    documents = Documents()

    @router.get(
        "/api/v1/report",
        response_class=FileResponse,
        responses={**_ERRORS, 200: {"description": "The page", "content": {"text/html": _HTML}}},
    )
    def report(case: CaseName = None) -> FileResponse:
        """One page of a case: images, tables, plots. It loads nothing from anywhere."""
        folder = case_folder(case_dir, case)
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
    def export(case: CaseName = None) -> FileResponse:
        """A case as one zip: every DICOM file as it was received, JSON lines, images."""
        folder = case_folder(case_dir, case)
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
