"""The HTTP face of the room: REST under /api/v1, live events, the page.

Handlers never touch the robot themselves: they ask the control loop and wait for its answer. STOP
is the exception and goes onto the line at once. Errors are RFC 9457 problem details.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import structlog
from fastapi import FastAPI, Response
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.registry import Collector

from case_record.cases import Cases
from room_config.load import Config
from service.dicom_out.outbox_watch import OutboxWatch
from service.room.control import STALE_S, ControlLoop
from service.room.link import PumpedClient, RoomLink
from service.web.access import Access, AccessRules
from service.web.event_stream import Broadcast
from service.web.metrics import Receivers, RoomMetrics
from service.web.orders import Orders
from service.web.papers import Papers
from service.web.problems import Problem, add_problems, problem, responses
from service.web.readers import Readers
from service.web.request_guard import RequestGuard
from service.web.routes.access import access_router
from service.web.routes.cases import case_router
from service.web.routes.documents import document_router
from service.web.routes.images import measurement_image_router, slice_image_router
from service.web.routes.live import live_router
from service.web.routes.outputs import outbox_router, output_router
from service.web.routes.procedure import procedure_router
from service.web.routes.proposals import proposal_router
from service.web.routes.record import event_router, measurement_router, slice_router
from service.web.routes.record_edits import clerk_router
from service.web.routes.robot import robot_router, stop_router
from service.web.routes.settings import settings_router
from service.web.routes.target import target_router
from service.web.schemas import Health

PAGE = Path(__file__).parents[1] / "page"
_HOUR_S = 3600.0


class Scene(Receivers, Protocol):
    """A server at which others follow the case."""

    async def start(self) -> None: ...

    async def close(self) -> None: ...


def create_app(
    config: Config,
    announce: Callable[[], None] = lambda: None,
    scene: Callable[[ControlLoop], Scene] | None = None,
    on_failure: Callable[[], None] = lambda: None,
) -> FastAPI:
    """Wire the service of one room; `announce` is called when it is ready to serve.

    on_failure: called when the control loop has ended by itself: the process is of no use then.
    scene: makes the server at which others follow the case, from the control loop.
    """
    service = config.service
    client = PumpedClient(service.bridge_link, name="service", heartbeat_s=service.heartbeat_s)
    link = RoomLink(client, _log_link)
    outbox = OutboxWatch(config)
    cases = Cases(*config.room.folders)
    papers = Papers(cases)
    loop = ControlLoop(
        config, link, lambda: [*outbox.conditions(), *papers.conditions()], on_failure
    )
    broadcast = Broadcast(config, loop)
    receivers = None if scene is None else scene(loop)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        loop.start()
        broadcast.start()
        outbox.start()
        papers.start()
        if receivers is not None:
            await receivers.start()
        announce()
        try:
            yield
        finally:
            if receivers is not None:
                await receivers.close()
            await asyncio.to_thread(broadcast.close)
            await asyncio.to_thread(loop.close)
            await asyncio.to_thread(outbox.close)
            papers.close()
            for end in ending:
                end()

    app = FastAPI(
        title="AutoSPINe Navigator",
        description="Research software, not a medical device.",
        version="1",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
    )
    uses_tls = service.tls_certificate is not None
    access = Access(access_rules(config))
    ending: list[Callable[[], None]] = []
    app.add_middleware(Readers, config=config, stopping=ending)
    app.add_middleware(
        RequestGuard, access=access, uses_tls=uses_tls, public_url=service.public_url
    )
    add_problems(app)
    app.state.cases = cases
    orders = Orders(loop)
    for router in (
        stop_router(loop),
        live_router(loop, broadcast),
        event_router(),
        slice_router(),
        measurement_router(),
        slice_image_router(),
        measurement_image_router(),
        output_router(),
        outbox_router(config),
        document_router(),
        robot_router(orders),
        target_router(orders),
        settings_router(orders),
        proposal_router(orders),
        procedure_router(orders),
        clerk_router(orders),
        case_router(loop, orders, papers),
        access_router(access, cookie_path=urlsplit(service.public_url).path or "/"),
    ):
        app.include_router(router)
    _add_health(app, loop, RoomMetrics(loop, link, broadcast, receivers), outbox)
    _add_page(app)
    _describe_api(app)
    return app


def access_rules(config: Config) -> AccessRules:
    service = config.service
    return AccessRules(
        tokens=tuple(service.token),
        session_s=service.session_hours * _HOUR_S,
        lock_out_after=service.lock_out_after,
        lock_out_s=service.lock_out_s,
    )


def _add_health(app: FastAPI, loop: ControlLoop, *collectors: Collector) -> None:
    registry = CollectorRegistry()
    for collector in collectors:
        registry.register(collector)

    @app.get("/healthz", tags=["health"], responses=responses(503))
    async def health() -> Health:
        """200 while the control loop runs and the robot is linked; every part with its state."""
        parts = parts_of(loop)
        broken = {name: text for name, text in parts.items() if text != "ok"}
        for name in ("control_loop", "robot"):
            if name in broken:
                return problem(503, name, f"{name}: {broken[name]}")  # type: ignore[return-value]
        return Health(status="degraded" if broken else "ok", parts=parts)

    @app.get(
        "/metrics",
        tags=["health"],
        response_class=Response,
        responses={
            **responses(401, 429),
            200: {"description": "Prometheus", "content": {"text/plain": {}}},
        },
    )
    def metrics() -> Response:
        """Counters for Prometheus."""
        return Response(generate_latest(registry), media_type="text/plain; version=0.0.4")


def parts_of(loop: ControlLoop) -> dict[str, str]:
    """Every part of the room: `ok`, or what is wrong with it."""
    state = loop.state
    parts = {
        "control_loop": _loop_health(loop),
        "robot": "ok" if state.robot.linked else state.robot.problem,
    }
    for process in state.processes:
        parts[process.name] = "ok" if process.condition == "up" else process.detail
    return parts


def _loop_health(loop: ControlLoop) -> str:
    if loop.failure is not None:
        return f"ended: {loop.failure}"
    age_s = loop.state_age_s
    return "ok" if age_s < STALE_S else f"has been silent for {age_s:.0f} s"


def _add_page(app: FastAPI) -> None:
    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html", headers={"Cache-Control": "no-cache"})

    app.mount("/page", StaticFiles(directory=PAGE), name="page")


def _describe_api(app: FastAPI) -> None:
    """The OpenAPI document: problems as they really are, and how to log in."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            made = get_openapi(
                title=app.title,
                version=app.version,
                description=app.description,
                routes=app.routes,
            )
            schemas = made["components"]["schemas"]
            schemas.setdefault("Problem", Problem.model_json_schema())
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            made["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
            made["security"] = [{"token": []}, {}]
            _only_problem_json(made)
            app.openapi_schema = made
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]


def _only_problem_json(made: dict[str, Any]) -> None:
    """Errors are application/problem+json, never application/json."""
    for operations in made["paths"].values():
        for operation in operations.values():
            for status, answer in operation["responses"].items():
                if status >= "400":
                    answer["content"].pop("application/json", None)


def _log_link(text: str) -> None:
    structlog.get_logger().info("robot link", what=text)
