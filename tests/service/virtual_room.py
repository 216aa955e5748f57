"""The processes of the virtual room for tests: nobody operates it but the test."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from simulator.demo_room import DemoOptions, DemoRoom


@contextmanager
def running_room(folder: Path, **settings: str) -> Iterator[DemoRoom]:
    """A whole room that asks before it moves; `settings` are keys of `[service]`."""
    wanted = {"confirm_moves": "true", **settings}
    names = {f"AUTOSPINE_SERVICE__{key.upper()}": value for key, value in wanted.items()}
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(names)
    room = DemoRoom(DemoOptions(folder, seed=3))
    try:
        room.start()
        yield room
    finally:
        room.end()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def wait_for(
    look: Callable[[], Mapping[str, Any]],
    wanted: Callable[[Mapping[str, Any]], bool],
    timeout_s: float = 30.0,
) -> Mapping[str, Any]:
    """Look until it is as wanted; the last look is in the error."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        seen = look()
        if wanted(seen):
            return seen
        assert time.monotonic() < deadline_s, f"after {timeout_s:.0f} s still {seen}"
        time.sleep(0.02)


def state_of(room: DemoRoom) -> dict[str, Any]:
    state: dict[str, Any] = httpx.get(f"{room.url}/api/v1/state").json()
    return state
