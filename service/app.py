"""The HTTP face of the room: REST under /api/v1, live events, the page.

Handlers never touch the robot themselves: they ask the control loop and wait for its answer. STOP
is the exception and goes onto the line at once. Errors are RFC 9457 problem details.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

import structlog
from fastapi import FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry, generate_latest
from pydantic import BaseModel, ConfigDict, Field

from case_record.record import CaseRecord, CaseRecordError
from robot_bridge.client import BridgeClient
from room_config.load import Config
from service.commands import ConflictError
from service.control import ControlLoop
from service.images import ImageMissingError, render_reconstruction, render_slice
from service.metrics import RoomMetrics
from service.room_link import RoomLink
from service.state import RoomState

PAGE = Path(__file__).parent / "page"
_SSE_POLL_S = 0.05
_SSE_KEEP_ALIVE_S = 5.0


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Ask(_Body):
    """Who asks; recorded with the event."""

    by: str = Field(default="operator", min_length=1, max_length=80)


class TargetBody(Ask):
    patient_mm: tuple[float, float, float] = Field(examples=[[12.0, -40.0, 7.5]])


class AnswerBody(Ask):
    question_id: str
    choice: str = Field(examples=["confirm"])


class PunctureBody(Ask):
    insertion_depth_mm: float | None = Field(default=None, ge=0, le=500)


class StopBody(Ask):
    emergency: bool = False


class Started(BaseModel):
    procedure_id: int


class EventBody(BaseModel):
    event_id: int
    wall_s: float
    source: str
    who: str
    kind: str
    body: dict[str, Any]


def create_app(config: Config, announce: Callable[[], None] = lambda: None) -> FastAPI:
    """Wire the service of one room; `announce` is called when it is ready to serve."""
    client = BridgeClient(
        config.service.bridge_link, name="service", heartbeat_s=config.service.heartbeat_s
    )
    link = RoomLink(client, _log_link)
    loop = ControlLoop(config, link)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        loop.start()
        announce()
        try:
            yield
        finally:
            await asyncio.to_thread(loop.close)

    app = FastAPI(
        title="AutoSPINe Navigator",
        description="Research software, not a medical device.",
        version="1",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
    )
    _add_problems(app)
    _add_reads(app, config, loop)
    _add_commands(app, loop)
    _add_health(app, loop, link)
    _add_page(app)
    return app


def problem(status: int, code: str, detail: str) -> JSONResponse:
    """RFC 9457: `code` is for programs, `detail` says what to do."""
    body = {"type": f"urn:autospine:{code}", "title": code, "status": status, "detail": detail}
    return JSONResponse(body, status, media_type="application/problem+json")


def _add_problems(app: FastAPI) -> None:
    @app.exception_handler(ConflictError)
    async def conflict(_: Request, error: ConflictError) -> JSONResponse:
        return problem(409, error.code, str(error))

    @app.exception_handler(CaseRecordError)
    async def unknown(_: Request, error: CaseRecordError) -> JSONResponse:
        return problem(404, "not_found", str(error))

    @app.exception_handler(ImageMissingError)
    async def no_image(_: Request, error: ImageMissingError) -> JSONResponse:
        return problem(404, "no_image", str(error))


def _add_reads(app: FastAPI, config: Config, loop: ControlLoop) -> None:
    def record() -> CaseRecord:
        return CaseRecord(config.room.case_dir)

    @app.get("/api/v1/state", tags=["live"])
    async def state() -> RoomState:
        """What the room is doing now."""
        return loop.state

    @app.get("/api/v1/events/live", tags=["live"])
    async def live() -> StreamingResponse:
        """Server-sent events: the state, again whenever it changes."""
        return StreamingResponse(
            _live(loop), media_type="text/event-stream", headers={"Cache-Control": "no-store"}
        )

    @app.get("/api/v1/events", tags=["record"])
    def events(
        after: Annotated[int, Query(ge=0)] = 0, limit: Annotated[int, Query(ge=1, le=1000)] = 200
    ) -> list[EventBody]:
        """Everything that happened, oldest first."""
        with record() as opened:
            return [
                EventBody(
                    event_id=e.event_id,
                    wall_s=e.wall_s,
                    source=e.source,
                    who=e.who,
                    kind=e.kind,
                    body=dict(e.body),
                )
                for e in opened.events(after, limit)
            ]

    @app.get("/api/v1/slices/{slice_id}/image.png", tags=["images"])
    def slice_image(slice_id: int) -> Response:
        """The slice as a PNG, one image pixel a slice pixel."""
        with record() as opened:
            png = render_slice(opened, slice_id)
        return Response(png, media_type="image/png", headers={"Cache-Control": "max-age=86400"})

    @app.get("/api/v1/measurements/{measurement_id}/image.png", tags=["images"])
    def measurement_image(measurement_id: int) -> Response:
        """The super-resolution reconstruction of a measurement as a PNG."""
        with record() as opened:
            png = render_reconstruction(opened, measurement_id)
        return Response(png, media_type="image/png", headers={"Cache-Control": "max-age=86400"})


def _add_commands(app: FastAPI, loop: ControlLoop) -> None:
    @app.post("/api/v1/stop", tags=["robot"], status_code=202)
    def stop(body: StopBody) -> Response:
        """Stop the robot at once; latched until re-armed."""
        loop.stop(body.by, emergency=body.emergency)
        return Response(status_code=202)

    @app.post("/api/v1/reset", tags=["robot"], status_code=204)
    def reset(body: Ask) -> None:
        """Clear a latched stop and arm."""
        loop.call("reset", {"by": body.by})

    @app.post("/api/v1/calibration", tags=["procedure"], status_code=202)
    def calibration(body: Ask) -> Started:
        """Start the calibration."""
        return Started(procedure_id=loop.call("start_calibration", {"by": body.by}))

    @app.put("/api/v1/target", tags=["procedure"], status_code=204)
    def target(body: TargetBody) -> None:
        """Set where the fiducial is to be, patient mm (LPS)."""
        loop.call("set_target", {"patient_mm": body.patient_mm, "by": body.by})

    @app.post("/api/v1/approach", tags=["procedure"], status_code=202)
    def approach(body: Ask) -> Started:
        """Start the approach to the target."""
        return Started(procedure_id=loop.call("start_approach", {"by": body.by}))

    @app.post("/api/v1/answer", tags=["procedure"], status_code=204)
    def answer(body: AnswerBody) -> None:
        """Answer the open question, for instance CONFIRM MOVE."""
        arguments = {"question_id": body.question_id, "choice": body.choice, "by": body.by}
        loop.call("answer", arguments)

    @app.post("/api/v1/abort", tags=["procedure"], status_code=204)
    def abort(body: Ask) -> None:
        """End the running procedure; the robot stays where it is."""
        loop.call("abort", {"by": body.by})

    @app.post("/api/v1/puncture", tags=["procedure"], status_code=204)
    def puncture(body: PunctureBody) -> None:
        """Record the puncture."""
        arguments = {"by": body.by, "insertion_depth_mm": body.insertion_depth_mm}
        loop.call("puncture", arguments)

    @app.post("/api/v1/needle-out", tags=["procedure"], status_code=204)
    def needle_out(body: Ask) -> None:
        """The needle is out: unlock motion."""
        loop.call("needle_out", {"by": body.by})


def _add_health(app: FastAPI, loop: ControlLoop, link: RoomLink) -> None:
    registry = CollectorRegistry()
    registry.register(RoomMetrics(loop, link))

    @app.get("/healthz", tags=["health"])
    async def health() -> JSONResponse:
        """200 while the control loop runs and the robot is linked, else 503 and what is wrong."""
        state = loop.state
        if loop.failure is not None:
            return problem(503, "control_loop", f"the control loop ended: {loop.failure}")
        if not state.robot.linked:
            return problem(503, "no_link", f"no link to the robot: {state.robot.problem}")
        return JSONResponse({"control_loop": "running", "robot": "linked"})

    @app.get("/metrics", tags=["health"])
    def metrics() -> Response:
        """Counters for Prometheus."""
        return Response(generate_latest(registry), media_type="text/plain; version=0.0.4")


def _add_page(app: FastAPI) -> None:
    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html", headers={"Cache-Control": "no-cache"})

    app.mount("/page", StaticFiles(directory=PAGE), name="page")


async def _live(loop: ControlLoop) -> AsyncIterator[str]:
    shown = -1
    silent_s = 0.0
    while True:
        state = loop.state
        if state.revision != shown:
            shown, silent_s = state.revision, 0.0
            yield f"id: {state.revision}\nevent: state\ndata: {state.model_dump_json()}\n\n"
        elif silent_s >= _SSE_KEEP_ALIVE_S:
            silent_s = 0.0
            yield ": still here\n\n"
        await asyncio.sleep(_SSE_POLL_S)
        silent_s += _SSE_POLL_S


def _log_link(text: str) -> None:
    structlog.get_logger().info("robot link", what=text)
