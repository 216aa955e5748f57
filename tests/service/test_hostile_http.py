"""What a caller could do to the service: whatever it asks for, STOP gets through at once."""

import contextlib
import io
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import numpy as np
from attended_room import AttendedRoom, arm, calibrated, running_room, wait_for
from lone_service import running_service
from PIL import Image
from test_supervisor import wait_until

from service.client import RoomClient
from service.room.images import Rendering, png_of

STOP_LIMIT_S = 0.5
TRIES = 4


def address_of(url: str) -> tuple[str, int]:
    parts = httpx.URL(url)
    return parts.host, parts.port or 80


def service_of(url: str) -> int:
    """The process that listens there."""
    port = address_of(url)[1]
    listed = subprocess.run(["ss", "-ltnp"], capture_output=True, text=True, check=True).stdout
    line = next(line for line in listed.splitlines() if f":{port} " in line)
    return int(line.split("pid=")[1].split(",")[0])


SAID = (b"", b"GET /api/v1/st", b"POST /api/v1/stop HTTP/1.1\r\n")


def test_silent_connections_keep_nobody_out_and_readers_come_again(tmp_path: Path) -> None:
    with running_service(tmp_path) as url, contextlib.ExitStack() as stack:
        _read_in_another_process(url)
        few = 256  # descriptors: less than the usual 1024, and quicker to use up
        resource.prlimit(service_of(url), resource.RLIMIT_NOFILE, (few, few))
        for number in range(2 * few):
            one = stack.enter_context(socket.create_connection(address_of(url)))
            with contextlib.suppress(OSError):  # it had to make room already
                one.sendall(SAID[number % len(SAID)])
        assert httpx.post(f"{url}/api/v1/stop", json={}).status_code == 202
        assert httpx.get(f"{url}/healthz").status_code in (200, 503)


def _read_in_another_process(url: str) -> None:
    events = httpx.get(f"{url}/api/v1/events?limit=5")
    assert events.status_code == 200
    assert events.json()[0]["kind"] == "case_started"
    assert events.headers["x-frame-options"] == "DENY"
    assert httpx.get(f"{url}/api/v1/events?limit=0").status_code == 422
    assert httpx.get(f"{url}/api/v1/slices/7").status_code == 404
    readers = [pid for pid in children(service_of(url)) if "spawn_main" in words_of(pid)]
    assert len(readers) == 1
    os.kill(readers[0], signal.SIGKILL)
    wait_until(lambda: httpx.get(f"{url}/api/v1/events").status_code == 200)


def children(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()] + [
        int(p)
        for task in Path(f"/proc/{pid}/task").iterdir()
        if int(task.name) != pid
        for p in (task / "children").read_text().split()
    ]


def words_of(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")


def test_an_enlarged_image_has_a_largest_side() -> None:
    pixels = np.zeros((2048, 1024))

    def side(scale: int, shape: np.ndarray) -> int:
        return max(Image.open(io.BytesIO(png_of(shape, Rendering(scale=scale)))).size)

    assert side(8, pixels) == 4096
    assert side(8, pixels[:100, :100]) == 800
    assert side(8, np.zeros((5000, 10))) == 5000


VIEWERS = """
import asyncio, contextlib, itertools, sys
import httpx

async def look(client, number):
    for turn in itertools.count():
        with contextlib.suppress(httpx.HTTPError):
            await client.get("/api/v1/events", params={"limit": 1000})
            await client.get("/api/v1/slices", params={"limit": 1000})
            window = {"scale": 8, "window": 1000 * number + turn + 1}
            await client.get("/api/v1/slices/1/image.png", params=window)

async def main():
    async with httpx.AsyncClient(base_url=sys.argv[1], timeout=60) as client:
        await asyncio.gather(*(look(client, number) for number in range(40)))

asyncio.run(main())
"""


def test_stop_gets_through_whatever_viewers_ask_for(tmp_path: Path) -> None:
    with running_room(tmp_path) as room, RoomClient(room.url, by="tester") as client:
        calibrated(client)
        _stop_under_load(room, client)


def _stop_under_load(room: AttendedRoom, client: RoomClient) -> None:
    viewers = subprocess.Popen([sys.executable, "-c", VIEWERS, room.url])
    silent = [socket.create_connection(address_of(room.url)) for _ in range(200)]
    try:
        took_s = [stopped_after_s(room, client)]
        while min(took_s) >= STOP_LIMIT_S and len(took_s) < TRIES:
            took_s.append(stopped_after_s(room, client))
    finally:
        viewers.kill()
        viewers.wait()
        for one in silent:
            one.close()
    print("STOP to standstill", took_s)
    # a machine that is busy with other things may be late, but not every time
    assert min(took_s) < STOP_LIMIT_S
    assert client.state().robot.linked


def stopped_after_s(room: AttendedRoom, client: RoomClient) -> float:
    arm(client)
    client.start_calibration()
    # the second move of a calibration is 15 mm long: the stages are under way for seconds
    wait_for(client.state, lambda s: "2/4" in s.prompt and s.robot.positions_um["xt"] > 1000)
    pressed_s = time.time()
    httpx.post(f"{room.url}/api/v1/stop", json={}, timeout=60.0)
    wait_for(client.state, lambda s: s.robot.stopped and not s.robot.moving and not s.procedure)
    time.sleep(0.5)  # long enough to see a motion that goes on
    took_s = room.standstill_s(pressed_s - 1.0, time.time()) - pressed_s
    assert took_s > 0.0, "the stages stood already"
    return took_s
