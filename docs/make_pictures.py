"""Takes the pictures of the page in docs/pictures: `python docs/make_pictures.py`.

A real Chromium on the page of a whole virtual room; needs the development packages and Chromium.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Page

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "service"))

from attended_room import AttendedRoom, arm, running_room, wait_for
from browser import running_browser

from service.client import RoomClient

HERE = Path(__file__).parent / "pictures"
SIZE = {"width": 1280, "height": 800}
_SETTLE_MS = 900


def main() -> None:
    HERE.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        running_room(Path(folder)) as room,
        running_browser() as browser,
        RoomClient(room.url, by="Olga") as client,
    ):
        page = browser.new_page(viewport=SIZE)
        page.goto(room.url)
        take_all(page, room, client)


def take_all(page: Page, room: AttendedRoom, client: RoomClient) -> None:
    """Drive a case and take a picture of each main state."""
    client.describe_case("Phantom, two targets", "Olga")
    arm(client)
    take(page, "1-start")
    client.start_calibration()
    wait_for(client.state, lambda s: s.acquisition_request and "3/4" in _last_move(client))
    take(page, "2-calibration")
    state = wait_for(client.state, lambda s: s.calibrated and s.procedure is None, 120.0)
    assert state.measurement is not None
    assert state.measurement.patient_mm is not None
    x, y, z = state.measurement.patient_mm
    client.set_entry((x + 2.0, y - 35.0, z + 6.0))
    client.set_target((x + 6.0, y, z - 4.0))
    client.start_approach()
    wait_for(client.state, lambda s: s.question is not None)
    page.get_by_role("button", name="Fiducial").click()
    take(page, "3-confirm")
    take(page, "3-confirm", "light")
    page.set_viewport_size({"width": 820, "height": 1180})
    take(page, "3-confirm-tablet")
    page.set_viewport_size({"width": 3840, "height": 2160})
    take(page, "3-confirm-4k")
    page.set_viewport_size(SIZE)
    confirm_until_ready(client)
    take(page, "4-ready")
    take(page, "4-ready", "light")
    page.locator("#look").evaluate("(look) => { look.scrollTop = look.scrollHeight; }")
    take(page, "5-record")
    take(page, "5-record", "light")
    page.locator("#look").evaluate("(look) => { look.scrollTop = 0; }")
    client.needle_out()
    client.stop()
    wait_for(client.state, lambda s: s.robot.stopped)
    take(page, "6-stopped")
    client.stop(emergency=True)
    wait_for(client.state, lambda s: s.robot.phase == "EMERGENCY")
    take(page, "6-emergency")
    take(page, "6-emergency", "light")
    room.kill("service")
    time.sleep(3.0)
    take(page, "7-lost")


def confirm_until_ready(client: RoomClient) -> None:
    for _ in range(9):
        state = wait_for(client.state, lambda s: s.question or s.ready)
        if state.ready:
            wait_for(client.state, lambda s: s.robot.insertion_locked)
            return
        assert state.question is not None
        client.answer(state.question.question_id, "confirm")
        asked = state.question.question_id
        wait_for(client.state, _another(asked))


def _another(asked: str) -> Callable[..., bool]:
    return lambda s: s.question is None or s.question.question_id != asked


def _last_move(client: RoomClient) -> str:
    state = client.state()
    return "3/4" if state.robot.positions_um.get("yt", 0) > 10_000 else ""


def take(page: Page, name: str, theme: str = "dark") -> None:
    page.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
    page.wait_for_timeout(_SETTLE_MS)
    ending = "" if theme == "dark" else f"-{theme}"
    page.screenshot(path=HERE / f"{name}{ending}.png")
    page.evaluate("document.documentElement.dataset.theme = 'dark'")


if __name__ == "__main__":
    main()
