"""What the record says: state, events, slices, measurements, cases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import StreamingResponse

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from service.bodies import CaseSummary, EventBody, KnownTarget, MeasurementBody, SliceBody
from service.control import ControlLoop
from service.live import Broadcast
from service.past import known_targets, past_cases, targets_over_time
from service.problems import responses
from service.state import RoomState

_MOST_ID = 2**53
Id = Annotated[int, PathParameter(ge=1, le=_MOST_ID)]
After = Annotated[
    int, Query(ge=0, le=_MOST_ID, description="Begin after this id (before it with `newest`).")
]
Limit = Annotated[int, Query(ge=1, le=1000)]
Newest = Annotated[bool, Query(description="The newest first instead of the oldest first.")]
_ERRORS = responses(401, 422, 429)
_WITH_ID = responses(401, 404, 422, 429)


def live_router(loop: ControlLoop, broadcast: Broadcast) -> APIRouter:
    router = APIRouter(tags=["live"])

    @router.get("/api/v1/state", response_model=RoomState, responses=_ERRORS)
    async def state() -> Response:
        """What the room is doing now."""
        # the state was checked when it was made; many ask for it often
        return Response(loop.state.model_dump_json(), media_type="application/json")

    @router.get(
        "/api/v1/events/live",
        response_class=StreamingResponse,
        responses={
            **_ERRORS,
            200: {
                "description": "Server-sent events: `state`, `record` (id: event id), `beat`",
                "content": {"text/event-stream": {"schema": {"type": "string"}}},
            },
        },
    )
    async def live(
        after: After = 0,
        last_event_id: Annotated[str | None, Header(alias="Last-Event-ID")] = None,
    ) -> StreamingResponse:
        """The state whenever it changes, every event of the record after the given one."""
        if last_event_id is not None and last_event_id.isdecimal():
            after = min(int(last_event_id), _MOST_ID)
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(
            broadcast.follow(after), media_type="text/event-stream", headers=headers
        )

    return router


def record_router(case_dir: Path) -> APIRouter:
    router = APIRouter(tags=["record"])

    @router.get("/api/v1/events", responses=_ERRORS)
    def events(
        request: Request,
        response: Response,
        after: After = 0,
        limit: Limit = 200,
        newest: Newest = False,
    ) -> list[EventBody]:
        """Everything that happened; `Link: rel="next"` leads on."""
        with CaseRecord(case_dir) as record:
            found = (
                record.newest_events(limit, after or None)
                if newest
                else record.events(after, limit)
            )
        _link(request, response, [e.event_id for e in found], limit)
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

    @router.get("/api/v1/slices", responses=_ERRORS)
    def slices(
        request: Request,
        response: Response,
        state: Annotated[str | None, Query(pattern="^(assigned|pending|quarantined)$")] = None,
        after: After = 0,
        limit: Limit = 100,
        newest: Newest = False,
    ) -> list[SliceBody]:
        """Every slice that was received, with what was decided about it and by whom."""
        with CaseRecord(case_dir) as record:
            rows = record.page_of_slices(after_id=after, limit=limit, newest=newest, state=state)
        _link(request, response, [row.slice_id for row in rows], limit)
        return [_slice_body(row) for row in rows]

    @router.get("/api/v1/slices/{slice_id}", responses=_WITH_ID)
    def one_slice(slice_id: Id) -> SliceBody:
        """One slice."""
        with CaseRecord(case_dir) as record:
            return _slice_body(record.slice(slice_id))

    @router.get("/api/v1/measurements", responses=_ERRORS)
    def measurements(
        request: Request,
        response: Response,
        after: After = 0,
        limit: Limit = 100,
        newest: Newest = False,
    ) -> list[MeasurementBody]:
        """Every measurement, with its error to the target that was set at that time."""
        with CaseRecord(case_dir) as record:
            rows = record.page_of_measurements(after_id=after, limit=limit, newest=newest)
            targets = targets_over_time(record)
        _link(request, response, [row.measurement_id for row in rows], limit)
        return [targets.body_of(row) for row in rows]

    @router.get("/api/v1/targets", responses=_ERRORS)
    def targets() -> list[KnownTarget]:
        """Every target of the case in the order in which they were set, with its approaches."""
        with CaseRecord(case_dir) as record:
            return known_targets(record)

    @router.get("/api/v1/cases", responses=_ERRORS)
    def cases() -> list[CaseSummary]:
        """The case folders beside the present one, newest first."""
        return past_cases(case_dir)

    return router


def _link(request: Request, response: Response, ids: list[int], limit: int) -> None:
    if len(ids) == limit:
        onward = request.url.include_query_params(after=ids[-1])
        response.headers["Link"] = f'<{onward.path}?{onward.query}>; rel="next"'


def _slice_body(row: SliceRow) -> SliceBody:
    names = set(SliceBody.model_fields) - {"series_description", "geometry"}
    return SliceBody(
        series_description=str(row.header.get("series_description") or ""),
        geometry=row.header.get("geometry") or None,
        **{name: getattr(row, name) for name in names},
    )
