"""What viewers read of the record and its images is made in a process of its own.

In the service's process it would compete with the control loop for the interpreter: forty lists at
once would keep a STOP waiting. The reading process answers the same routes by the same code, at low
priority and in bounded memory; it is started when it is first needed, and again when it died.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import re
import resource
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import structlog
from fastapi import FastAPI
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from case_record.cases import Cases
from room_config.load import Config
from service.web.problems import add_problems, problem
from service.web.routes.images import measurement_image_router, slice_image_router
from service.web.routes.record import event_router, measurement_router, slice_router

_READ = re.compile(
    r"/api/v1/(events|cases|targets|measurements|slices(/[^/]+)?"
    r"|(measurements|slices)/[^/]+/(image\.png|pixels|residual))"
)
_MOST_WAITING = 200
_PATIENCE_S = 20.0
_MOST_MEMORY_BYTES = 4 * 2**30
_NICE = 5
_LOOK_FOR_PARENT_S = 1.0


@dataclass(frozen=True)
class Question:
    """A GET request, as far as the routes look at it; prefix: of the page's public address."""

    path: str
    query: bytes
    headers: list[tuple[bytes, bytes]]
    scheme: str
    root_path: str
    server: tuple[str, int] | None
    prefix: str


@dataclass(frozen=True)
class Answer:
    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes


class Readers:
    """Middleware: hands reading requests to the other process; all else goes on to the app."""

    def __init__(self, app: ASGIApp, config: Config, stopping: list[Callable[[], None]]) -> None:
        """stopping: gets what ends the reading process; call it when the service ends."""
        self._app = app
        self._config = config
        self._pool: ProcessPoolExecutor | None = None
        self._waiting = 0
        stopping.append(self.close)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_read = scope["type"] == "http" and scope["method"] == "GET"
        if not is_read or not _READ.fullmatch(_route_path(scope)):
            await self._app(scope, receive, send)
            return
        answer = await self._answer(_question(scope))
        await answer(scope, receive, send)

    async def _answer(self, question: Question) -> Response:
        if self._waiting >= _MOST_WAITING:
            return _busy("Too many requests at once")
        self._waiting += 1
        pool = self._pool = self._pool or _new_pool(self._config)
        try:
            future = asyncio.wrap_future(pool.submit(_answer_here, question))
            made: Answer = await asyncio.wait_for(future, _PATIENCE_S)
        except (BrokenProcessPool, TimeoutError, RuntimeError) as error:
            structlog.get_logger().warning("reading", path=question.path, error=repr(error))
            if self._pool is pool:
                self.close()
            return _busy("Reading took too long")
        finally:
            self._waiting -= 1
        response = Response(made.body, made.status)
        response.raw_headers = made.headers
        return response

    def close(self) -> None:
        """End the reading process, whatever it does."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        processes = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            with contextlib.suppress(OSError, ValueError):
                process.kill()


def _route_path(scope: Scope) -> str:
    path, root = str(scope["path"]), str(scope.get("root_path", ""))
    return path.removeprefix(root) if root and path.startswith(root) else path


def _question(scope: Scope) -> Question:
    return Question(
        scope["path"],
        scope["query_string"],
        list(scope["headers"]),
        scope["scheme"],
        scope.get("root_path", ""),
        scope.get("server"),
        scope.get("state", {}).get("prefix", ""),
    )


def _busy(what: str) -> Response:
    return problem(429, "busy", f"{what}: try again.", headers={"Retry-After": "1"})


def _new_pool(config: Config) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        1, multiprocessing.get_context("spawn"), initializer=_begin, initargs=(config,)
    )


# In the reading process


def _begin(config: Config) -> None:
    os.nice(_NICE)
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY_BYTES, _MOST_MEMORY_BYTES))
    parent = os.getppid()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    global _reading
    _reading = _Reading(config)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK_FOR_PARENT_S)
    os._exit(0)


def _answer_here(question: Question) -> Answer:
    assert _reading is not None
    return _reading.answer(question)


class _Reading:
    """The reading routes as an app, asked without a network."""

    def __init__(self, config: Config) -> None:
        self._loop = asyncio.new_event_loop()
        self._app = FastAPI(openapi_url=None)
        self._app.state.cases = Cases(*config.room.folders)
        add_problems(self._app)
        for router in (
            event_router(),
            slice_router(),
            measurement_router(),
            slice_image_router(),
            measurement_image_router(),
        ):
            self._app.include_router(router)

    def answer(self, question: Question) -> Answer:
        return self._loop.run_until_complete(self._asked(question))

    async def _asked(self, question: Question) -> Answer:
        messages: list[Message] = []

        async def receive() -> Message:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Message) -> None:
            messages.append(message)

        with contextlib.suppress(Exception):  # it was answered with 500 and logged before
            await self._app(_scope(question), receive, send)
        body = b"".join(message.get("body", b"") for message in messages[1:])
        return Answer(messages[0]["status"], list(messages[0]["headers"]), body)


_reading: _Reading | None = None


def _scope(question: Question) -> Scope:
    return {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "GET",
        "scheme": question.scheme,
        "path": question.path,
        "raw_path": question.path.encode(),
        "query_string": question.query,
        "state": {"prefix": question.prefix},
        "root_path": question.root_path,
        "headers": question.headers,
        "server": question.server,
        "client": None,
    }
