"""Takes the pictures of the page: `python docs/make_pictures.py [--states DIR] [--animation]`.

Without an option: the pictures of its main states in docs/pictures. --states: every state at five
sizes, light and dark, into a folder of their own. --animation: a whole case, clicked on the page,
as docs/pictures/case.webp. A real Chromium on the page of a whole virtual room; needs the
development packages and Chromium.
"""

from __future__ import annotations

import argparse
import io
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, expect

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "service"))

from attended_room import AttendedRoom, arm, running_room, wait_for
from browser import running_browser, set_theme
from page_states import SIZES, THEMES, confirm_until_ready, layout_faults, states

from service.client import RoomClient

HERE = Path(__file__).parent / "pictures"
SIZE = {"width": 1280, "height": 800}
_SETTLE_MS = 900
_ANIMATION_S = 30.0
_FRAME_S = 0.25


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--states", type=Path, metavar="DIR")
    parser.add_argument("--animation", action="store_true")
    asked = parser.parse_args()
    HERE.mkdir(exist_ok=True)
    if asked.states is not None:
        take_states(asked.states)
    elif asked.animation:
        animate()
    else:
        with looking_at_a_room("phantom") as (page, room, client):
            take_all(page, room, client)
        with looking_at_a_room("guide", guide=True) as (page, _, client):
            take_guide(page, client)


@contextmanager
def looking_at_a_room(
    name: str, *, guide: bool = False, size: dict[str, int] | None = None
) -> Iterator[tuple[Page, AttendedRoom, RoomClient]]:
    with (
        tempfile.TemporaryDirectory() as folder,
        running_room(Path(folder) / "cases" / name, guide=guide) as room,
        running_browser() as browser,
        RoomClient(room.url, by="Olga") as client,
    ):
        page = browser.new_page(viewport=size or SIZE)
        page.goto(room.url)
        yield page, room, client


def take_states(folder: Path) -> None:
    """Every state x five sizes x light and dark; says what is wrong with the layout of any."""
    folder.mkdir(parents=True, exist_ok=True)
    taken = 0
    with looking_at_a_room("phantom") as (page, room, client):
        client.describe_case("Facet joint L4/5 left", "Olga Petersen", "phantom")
        room.power_cycle_controllers()
        expect(page.locator("#stand")).to_be_visible()
        page.locator("#stand-yt").fill("99")
        taken += take_sizes(page, folder, "positions")
        arm(client)
        for state in states(page, client):
            taken += take_sizes(page, folder, state)
        room.kill("service")
        expect(page.locator("body")).to_have_class(re.compile(r"\bstale\b"))
        taken += take_sizes(page, folder, "connection-lost")
    with looking_at_a_room("guide", guide=True) as (page, _, client):
        ask_the_guide(client)
        expect(page.locator("#confirm")).to_be_enabled()
        taken += take_sizes(page, folder, "guide-confirm")
        confirm_until_ready(client)
        taken += take_sizes(page, folder, "guide-ready")
    print(f"{taken} pictures in {folder}")


def take_sizes(page: Page, folder: Path, state: str) -> int:
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        for theme in THEMES:
            set_theme(page, theme)
            for fault in layout_faults(page):
                print(f"{state} {width}x{height} {theme}: {fault}")
            page.screenshot(path=folder / f"{state}-{width}x{height}-{theme}.png")
    set_theme(page, "dark")
    return len(SIZES) * len(THEMES)


def take_guide(page: Page, client: RoomClient) -> None:
    """Two fiducials and four axes: what is off before a move, and READY."""
    ask_the_guide(client)
    expect(page.locator("#confirm")).to_be_enabled()
    take(page, "8-guide-confirm")
    confirm_until_ready(client)
    take(page, "8-guide-ready")


def ask_the_guide(client: RoomClient) -> None:
    """Until the first move of an approach with four axes waits for its confirmation."""
    arm(client)
    client.start_calibration()
    state = wait_for(client.state, lambda s: s.calibrated and s.procedure is None, 300.0)
    assert state.measurement is not None
    assert state.measurement.patient_mm is not None
    x, y, z = state.measurement.patient_mm
    client.set_entry((x + 1.0, y - 40.0, z + 1.0))
    client.set_target((x + 3.0, y - 82.0, z - 2.0), label="facet joint")
    client.start_approach()
    wait_for(client.state, lambda s: s.question is not None, 120.0)


def take_all(page: Page, room: AttendedRoom, client: RoomClient) -> None:
    """Drive a case and take a picture of each main state."""
    client.describe_case("Facet joint L4/5 left", "Olga Petersen", "phantom")
    arm(client)
    take(page, "1-start")
    client.start_calibration()
    wait_for(client.state, lambda s: s.acquisition_request and _is_far_out(client))
    take(page, "2-calibration")
    state = wait_for(client.state, lambda s: s.calibrated and s.procedure is None, 300.0)
    assert state.measurement is not None
    assert state.measurement.patient_mm is not None
    x, y, z = state.measurement.patient_mm
    client.set_entry((x + 2.0, y - 35.0, z + 6.0))
    client.set_target((x + 6.0, y, z - 4.0), label="facet joint")
    client.start_approach()
    wait_for(client.state, lambda s: s.question is not None)
    page.get_by_role("button", name="Fiducial", exact=True).click()
    take(page, "3-confirm", "dark", "light")
    for name, width, height in (("tablet", 820, 1180), ("4k", 3840, 2160)):
        page.set_viewport_size({"width": width, "height": height})
        take(page, f"3-confirm-{name}")
    page.set_viewport_size(SIZE)
    confirm_until_ready(client)
    take(page, "4-ready", "dark", "light")
    page.locator("#card-alarms").scroll_into_view_if_needed()
    page.evaluate("scrollTo(0, document.getElementById('below').offsetTop - 90)")
    take(page, "5-record", "dark", "light")
    page.evaluate("scrollTo(0, 0)")
    client.needle_out()
    client.stop()
    wait_for(client.state, lambda s: s.robot.stopped)
    take(page, "6-stopped")
    client.stop(emergency=True)
    wait_for(client.state, lambda s: s.robot.phase == "EMERGENCY")
    take(page, "6-emergency", "dark", "light")
    room.kill("service")
    expect(page.locator("body")).to_have_class(re.compile(r"\bstale\b"))
    take(page, "7-lost")


def _is_far_out(client: RoomClient) -> bool:
    """The third of the four moves of a calibration: the second axis is out."""
    return client.state().robot.positions_um.get("yt", 0) > 10_000


def take(page: Page, name: str, *themes: str) -> None:
    for theme in themes or ("dark",):
        set_theme(page, theme)
        page.mouse.move(5, 5)
        page.wait_for_timeout(_SETTLE_MS)
        page.screenshot(path=HERE / (f"{name}.png" if theme == "dark" else f"{name}-{theme}.png"))
    set_theme(page, "dark")


# The animation


class Film:
    """Frames of the page while a case is clicked; as long as it takes, played in 30 s."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._frames: list[Image.Image] = []

    def until(self, done: Callable[[], object], timeout_s: float = 300.0) -> None:
        """Film until it is so."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._frames.append(Image.open(io.BytesIO(self._page.screenshot())).convert("RGB"))
            if done():
                return
            assert time.monotonic() < deadline_s
            self._page.wait_for_timeout(1000 * _FRAME_S)

    def hold(self, seconds: float) -> None:
        """Film for a while: a person reads."""
        end_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end_s)

    def save(self, path: Path) -> None:
        each_ms = round(1000 * _ANIMATION_S / len(self._frames))
        small = [frame.resize((960, 600), Image.Resampling.LANCZOS) for frame in self._frames]
        first, *rest = small
        first.save(
            path, save_all=True, append_images=rest, duration=each_ms, loop=0, quality=60, method=4
        )
        print(f"{path}: {len(small)} frames, {path.stat().st_size / 1e6:.1f} MB")


def animate() -> None:
    """Arm, calibrate, pick, approach, confirm, READY, puncture, needle out: all by clicking."""
    with looking_at_a_room("phantom") as (page, _, client):
        film = Film(page)
        client.describe_case("Facet joint L4/5 left", "Olga Petersen")

        def click(words: str) -> None:
            page.get_by_role("button", name=words, exact=True).click()

        film.hold(1.0)
        if not client.state().robot.armed:
            page.get_by_role("button", name="Arm the robot").click()
        film.until(lambda: client.state().robot.armed)
        click("Start the calibration")
        film.hold(1.5)
        click("Drive the stages – calibrate")
        film.until(lambda: client.state().calibrated and client.state().procedure is None)
        click("Pick target")
        film.hold(1.0)
        box = page.locator(".view canvas").first.bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + 0.56 * box["width"], box["y"] + 0.53 * box["height"])
        page.locator("#pick-label").fill("facet joint")
        film.hold(1.5)
        click("Set target")
        film.hold(0.7)
        click("Start the approach")
        while not client.state().ready:
            film.until(lambda: client.state().ready or client.state().question)
            if client.state().question:
                film.hold(1.5)
                page.locator("#confirm").click()
                film.until(lambda: not client.state().question)
        film.hold(2.0)
        click("Record the puncture")
        page.locator("#depth").fill("61.5")
        film.hold(1.0)
        click("Record the puncture")
        film.hold(1.5)
        click("Needle withdrawn – unlock motion")
        film.hold(1.5)
        click("Yes, the needle is out of the patient – unlock")
        film.hold(1.5)
        film.save(HERE / "case.webp")


if __name__ == "__main__":
    main()
