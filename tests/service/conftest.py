"""Procedures in the offline room: the room's physics and the real engine, nobody waits."""

from collections.abc import Callable, Iterator

import pytest
from attended_room import AttendedRoom, running_room, tidied
from browser import CHROMIUM, Complaints, running_browser
from httpx._config import DEFAULT_TIMEOUT_CONFIG
from offline_arguments import calibration_arguments
from playwright.sync_api import Browser, Page, expect

from service.client import RoomClient
from service.procedure.calibration import Calibration, calibrate
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging, OfflineRoom

_PATIENCE_MS = 60_000
# httpx gives up after 5 s unless told otherwise; a busy machine is not what these tests are about
for _part in ("connect", "read", "write", "pool"):
    setattr(DEFAULT_TIMEOUT_CONFIG, _part, 60.0)


@pytest.fixture
def make_room() -> Callable[..., OfflineRoom]:
    def make(seed: int = 0, stages: StageParameters | None = None, **options) -> OfflineRoom:
        return OfflineRoom(MrImaging(VirtualRoom()), stages or StageParameters(), seed, **options)

    return make


@pytest.fixture
def calibrated(make_room) -> tuple[OfflineRoom, Calibration]:
    room = make_room(seed=3)
    return room, room.run(calibrate(calibration_arguments()))


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttendedRoom]:
    """One whole virtual room, all its processes, for the tests of API and page."""
    with running_room(tmp_path_factory.mktemp("room")) as running:
        yield running


@pytest.fixture
def client(room: AttendedRoom) -> Iterator[RoomClient]:
    with RoomClient(room.url, by="tester") as talking:
        tidied(talking)
        yield talking


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if not CHROMIUM.exists():
        pytest.skip(f"needs the system's Chromium ({CHROMIUM})")
    expect.set_options(timeout=_PATIENCE_MS)
    with running_browser() as running:
        yield running


@pytest.fixture
def page(browser: Browser, room: AttendedRoom) -> Iterator[Page]:
    complaints = Complaints()
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    complaints.watch(page)
    page.set_default_timeout(_PATIENCE_MS)
    page.goto(room.url)
    expect(page.locator("#phases [aria-current]")).to_be_visible()
    yield page
    page.close()
    assert not complaints
