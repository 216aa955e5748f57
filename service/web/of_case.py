"""Which case a question is about: the open one, or one of those before it, which is only read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import Depends, Query, Request

from case_record.cases import Cases
from case_record.record import CaseRecord


@dataclass(frozen=True)
class AskedCase:
    """A case folder, whether it is the open one, and whether it was asked for by its name."""

    folder: Path
    is_open: bool
    is_named: bool

    def record(self) -> CaseRecord:
        """The record; of a case that is not open, nothing is written, not even a migration."""
        return CaseRecord(self.folder, read_only=not self.is_open)


CaseName = Annotated[
    str | None,
    Query(
        alias="case",
        min_length=1,
        max_length=255,
        description="A folder name as listed by /api/v1/cases; omitted: the open case.",
    ),
]


def cases_of(request: Request) -> Cases:
    """The cases of the room that this app serves."""
    cases: Cases = request.app.state.cases
    return cases


def _asked_case(request: Request, case: CaseName = None) -> AskedCase:
    cases = cases_of(request)
    folder = cases.named(case)
    return AskedCase(folder, folder == cases.open, case is not None)


RoomCases = Annotated[Cases, Depends(cases_of)]
OfCase = Annotated[AskedCase, Depends(_asked_case)]
