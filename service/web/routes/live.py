"""What the room is doing now: the state, and everything that happens as it happens."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Response
from fastapi.responses import StreamingResponse

from service.room.control import STALE_S, ControlLoop
from service.room.state import RoomState
from service.web.event_stream import MOST_VIEWERS, Broadcast
from service.web.pagination import (
    ERRORS,
    MOST_ID,
    After,
)
from service.web.problems import ProblemError, responses


def live_router(loop: ControlLoop, broadcast: Broadcast) -> APIRouter:
    router = APIRouter(tags=["live"])

    @router.get("/api/v1/state", response_model=RoomState, responses={**ERRORS, **responses(503)})
    async def state() -> Response:
        """What the room is doing now; 503 while the control loop does not say."""
        if loop.state_age_s > STALE_S:
            detail = f"The control loop has been silent for {loop.state_age_s:.1f} s."
            raise ProblemError(503, "stale_state", detail)
        # the state was checked when it was made; many ask for it often
        return Response(loop.state.model_dump_json(), media_type="application/json")

    @router.get(
        "/api/v1/events/live",
        response_class=StreamingResponse,
        responses={
            **ERRORS,
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
        if broadcast.viewers >= MOST_VIEWERS:
            wait = {"Retry-After": "5"}
            raise ProblemError(
                429, "busy", f"{MOST_VIEWERS} screens are already open: close one.", wait
            )
        if last_event_id is not None and last_event_id.isdecimal():
            after = min(int(last_event_id), MOST_ID)
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(
            broadcast.follow(after), media_type="text/event-stream", headers=headers
        )

    return router
