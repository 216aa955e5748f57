"""What the record says: events, slices, measurements, targets, cases."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from dicom_listener.operator_actions import offered_hold
from service.room.history import known_targets, past_cases, targets_over_time
from service.room.summaries import CaseSummary, KnownTarget, MeasurementBody
from service.web.of_case import OfCase, RoomCases
from service.web.pagination import ERRORS, ERRORS_WITH_ID, After, Id, Limit, Newest, link_onward
from service.web.schemas import EventBody, SliceBody


def event_router() -> APIRouter:
    """What happened, in this case and in those before it."""
    router = APIRouter(prefix="/api/v1", tags=["record"])

    @router.get("/events", responses=ERRORS)
    def events(
        request: Request,
        response: Response,
        case: OfCase,
        after: After = 0,
        limit: Limit = 200,
        newest: Newest = False,
    ) -> list[EventBody]:
        """Everything that happened; `Link: rel="next"` leads on."""
        with case.record() as record:
            found = (
                record.newest_events(limit, after or None)
                if newest
                else record.events(after, limit)
            )
        link_onward(request, response, [e.event_id for e in found], limit)
        return [
            EventBody(
                event_id=e.event_id,
                wall_s=e.wall_s,
                source=e.source,
                who=e.who,
                kind=e.kind,
                body=dict(e.body),
            )
            for e in found
        ]

    @router.get("/cases", responses=ERRORS)
    def cases(of_room: RoomCases) -> list[CaseSummary]:
        """Every case of this room, newest first."""
        return past_cases(of_room)

    return router


def slice_router() -> APIRouter:
    """The slices that were received."""
    router = APIRouter(prefix="/api/v1", tags=["record"])

    @router.get("/slices", responses=ERRORS)
    def slices(
        request: Request,
        response: Response,
        case: OfCase,
        state: Annotated[str | None, Query(pattern="^(assigned|pending|quarantined)$")] = None,
        after: After = 0,
        limit: Limit = 100,
        newest: Newest = False,
    ) -> list[SliceBody]:
        """Every slice that was received, with what was decided about it and by whom."""
        with case.record() as record:
            rows = record.page_of_slices(after_id=after, limit=limit, newest=newest, state=state)
            bodies = [_slice_body(row, _offered(record, row)) for row in rows]
        link_onward(request, response, [row.slice_id for row in rows], limit)
        return bodies

    @router.get("/slices/{slice_id}", responses=ERRORS_WITH_ID)
    def one_slice(slice_id: Id, case: OfCase) -> SliceBody:
        """One slice."""
        with case.record() as record:
            row = record.slice(slice_id)
            return _slice_body(row, _offered(record, row))

    return router


def measurement_router() -> APIRouter:
    """What was measured, and how far that was from which target."""
    router = APIRouter(prefix="/api/v1", tags=["record"])

    @router.get("/measurements", responses=ERRORS)
    def measurements(
        request: Request,
        response: Response,
        case: OfCase,
        after: After = 0,
        limit: Limit = 100,
        newest: Newest = False,
    ) -> list[MeasurementBody]:
        """Every measurement, with its error to the target that was set at that time."""
        with case.record() as record:
            rows = record.page_of_measurements(after_id=after, limit=limit, newest=newest)
            targets = targets_over_time(record)
        link_onward(request, response, [row.measurement_id for row in rows], limit)
        return [targets.body_of(row) for row in rows]

    @router.get("/targets", responses=ERRORS)
    def targets(case: OfCase) -> list[KnownTarget]:
        """Every target of the case in the order in which they were set, with its approaches."""
        with case.record() as record:
            return known_targets(record)

    return router


def _offered(record: CaseRecord, row: SliceRow) -> int | None:
    hold = offered_hold(record, row)
    return None if hold is None else hold.hold_id


def _slice_body(row: SliceRow, offered_hold_id: int | None) -> SliceBody:
    names = set(SliceBody.model_fields) - {"series_description", "geometry", "offered_hold_id"}
    return SliceBody(
        offered_hold_id=offered_hold_id,
        series_description=str(row.header.get("series_description") or ""),
        geometry=row.header.get("geometry") or None,
        **{name: getattr(row, name) for name in names},
    )
