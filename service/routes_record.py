"""What the record says: state, events, slices, measurements, cases, and their images."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import StreamingResponse
from numpy.typing import NDArray

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from service.bodies import CaseSummary, EventBody, KnownTarget, MeasurementBody, SliceBody
from service.control import ControlLoop
from service.images import (
    Rendering,
    png_of,
    raw_of,
    reconstruction_pixels,
    slice_file,
    slice_pixels,
)
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
Window = Annotated[float | None, Query(gt=0, le=1e9, allow_inf_nan=False)]
Level = Annotated[float | None, Query(ge=-1e9, le=1e9, allow_inf_nan=False)]
Scale = Annotated[int, Query(ge=1, le=8, description="Each pixel becomes this many squared.")]
Match = Annotated[str | None, Header(alias="If-None-Match")]
_ERRORS = responses(401, 422, 429)
_WITH_ID = responses(401, 404, 422, 429)
_PNG = {"image/png": {"schema": {"type": "string", "format": "binary"}}}
_RAW = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_DICOM = {"application/dicom": {"schema": {"type": "string", "format": "binary"}}}


def _image_responses(content: dict[str, Any]) -> dict[int | str, dict[str, Any]]:
    return {
        **_WITH_ID,
        200: {"description": "The image", "content": content},
        304: {"description": "The caller has it already"},
    }


def live_router(loop: ControlLoop, broadcast: Broadcast) -> APIRouter:
    router = APIRouter(tags=["live"])

    @router.get("/api/v1/state", responses=_ERRORS)
    async def state() -> RoomState:
        """What the room is doing now."""
        return loop.state

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


def image_router(case_dir: Path) -> APIRouter:
    router = APIRouter(tags=["images"])

    def answer(
        key: str, match: str | None, media_type: str, make: Callable[[], bytes], **headers: str
    ) -> Response:
        """The image, or 304 if the caller has it; what an ETag names never changes."""
        etag = f'"{hashlib.sha256(key.encode()).hexdigest()[:32]}"'
        cached = {"ETag": etag, "Cache-Control": "private, max-age=86400, immutable"}
        if match is not None and etag in match:
            return Response(status_code=304, headers=cached)
        return Response(make(), media_type=media_type, headers={**cached, **headers})

    def shape_of(pixels: NDArray[Any]) -> str:
        return ",".join(map(str, pixels.shape))

    @router.get(
        "/api/v1/slices/{slice_id}/image.png",
        response_class=Response,
        responses=_image_responses(_PNG),
    )
    def slice_image(
        slice_id: Id,
        window: Window = None,
        level: Level = None,
        scale: Scale = 1,
        match: Match = None,
    ) -> Response:
        """The slice as an 8-bit PNG; window and level in the units of its magnitudes."""
        with CaseRecord(case_dir) as record:
            key = f"png {record.slice(slice_id).sha256} {slice_id} {window} {level} {scale}"
            how = Rendering(window, level, scale)
            return answer(
                key, match, "image/png", lambda: png_of(slice_pixels(record, slice_id), how)
            )

    @router.get(
        "/api/v1/slices/{slice_id}/pixels",
        response_class=Response,
        responses=_image_responses(_RAW),
    )
    def raw_slice(slice_id: Id, match: Match = None) -> Response:
        """The magnitudes, row by row, little-endian 32-bit floats; `X-Shape: rows,cols`."""
        with CaseRecord(case_dir) as record:
            key = f"raw {record.slice(slice_id).sha256} {slice_id}"
            pixels = slice_pixels(record, slice_id)
        shape = {"X-Shape": shape_of(pixels)}
        return answer(key, match, "application/octet-stream", lambda: raw_of(pixels), **shape)

    @router.get(
        "/api/v1/slices/{slice_id}/image.dcm",
        response_class=Response,
        responses=_image_responses(_DICOM),
    )
    def dicom_file(slice_id: Id, match: Match = None) -> Response:
        """The DICOM file, bit for bit as it was received."""
        with CaseRecord(case_dir) as record:
            path = slice_file(record, slice_id)
            key = f"dcm {record.slice(slice_id).sha256}"
        name = {"Content-Disposition": f'attachment; filename="slice-{slice_id}.dcm"'}
        return answer(key, match, "application/dicom", path.read_bytes, **name)

    @router.get(
        "/api/v1/measurements/{measurement_id}/image.png",
        response_class=Response,
        responses=_image_responses(_PNG),
    )
    def measurement_image(
        measurement_id: Id,
        window: Window = None,
        level: Level = None,
        scale: Scale = 1,
        match: Match = None,
    ) -> Response:
        """The super-resolution reconstruction of a measurement as an 8-bit PNG."""
        with CaseRecord(case_dir) as record:
            pixels = reconstruction_pixels(record, measurement_id)
        key = f"png {case_dir} measurement {measurement_id} {window} {level} {scale}"
        how = Rendering(window, level, scale)
        return answer(key, match, "image/png", lambda: png_of(pixels, how))

    @router.get(
        "/api/v1/measurements/{measurement_id}/pixels",
        response_class=Response,
        responses=_image_responses(_RAW),
    )
    def raw_measurement(measurement_id: Id, match: Match = None) -> Response:
        """The reconstruction as little-endian 32-bit floats; `X-Shape: rows,cols`."""
        with CaseRecord(case_dir) as record:
            pixels = reconstruction_pixels(record, measurement_id)
        key = f"raw {case_dir} measurement {measurement_id}"
        shape = {"X-Shape": shape_of(pixels)}
        return answer(key, match, "application/octet-stream", lambda: raw_of(pixels), **shape)

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
