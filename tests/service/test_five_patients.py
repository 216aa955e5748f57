"""A day in the room: one patient after the other by clicking, and nothing is ever restarted for it.

One is interrupted by `kill -9` of the service; before another the controllers lose their supply.
"""

from __future__ import annotations

import contextlib
import io
import re
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pydicom
import pytest
from attended_room import AttendedRoom, read_off, wait_for
from browser import correct_positions, laid_out
from playwright.sync_api import Browser, Page, expect
from playwright.sync_api import TimeoutError as PlaywrightTimeoutError

from case_record.cases import Cases
from case_record.record import CaseRecord
from service.client import RoomClient, ServiceGoneError
from service.room.state import RoomState

pytestmark = pytest.mark.timeout(1800)
SLOW_MS = 120_000
PRESS_S = 180.0


class Hospital(AttendedRoom):
    """The virtual room with a folder of cases, whose controllers can lose their supply."""

    def _write_config(self, ports: tuple[int, int]) -> Path:
        path = super()._write_config(ports)
        one = f'case_dir = "{self.folder}"'
        text = path.read_text()
        assert one in text
        path.write_text(text.replace(one, f'cases_dir = "{self.folder / "cases"}"'))
        return path


@pytest.fixture
def hospital(tmp_path: Path) -> Iterator[Hospital]:
    room = Hospital(tmp_path)
    try:
        room.start()
        yield room
    finally:
        room.end()


@pytest.fixture
def screen(browser: Browser, hospital: Hospital) -> Iterator[Page]:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(SLOW_MS)
    page.goto(hospital.url)
    yield page
    page.close()


def state_of(client: RoomClient) -> RoomState | None:
    """None while the service is being started again."""
    try:
        return client.state()
    except ServiceGoneError:
        return None


def until(client: RoomClient, wanted, timeout_s: float = 180.0) -> RoomState:
    return wait_for(lambda: state_of(client), lambda s: s is not None and wanted(s), timeout_s)


def press(page: Page, client: RoomClient, done: Callable[[RoomState], object], *words: str) -> None:
    """Press the first of these buttons that is there, until what is wanted has come of it.

    As a person does: a button that has just moved takes no click, and a page is drawn anew.
    """
    deadline_s = time.monotonic() + PRESS_S
    while not done(until(client, lambda s: True)):
        assert time.monotonic() < deadline_s, f"nothing came of {words}: {client.state().prompt}"
        for word in words:
            button = page.get_by_role("button", name=word, exact=True).first
            if button.is_visible():
                with contextlib.suppress(PlaywrightTimeoutError):
                    button.click(timeout=2000)
                break
        page.wait_for_timeout(300)


def arm(page: Page, client: RoomClient) -> None:
    """Arm the robot, as the page asks for it; a question that is open comes first."""
    offered = page.get_by_role("button", name=re.compile("(arm|Arm) the robot$")).first
    while True:
        state = until(client, lambda s: s.robot.linked and not s.robot.moving)
        robot = state.robot
        if (robot.armed and not robot.stopped and robot.position_certain) or state.question:
            return
        if robot.taken_um:
            expect(page.locator("#next")).to_contain_text("Assumed stage positions")
            # what the bridge remembers may be too uncertain to calibrate with
            correct_positions(page, read_off(client, robot.taken_um))
        with contextlib.suppress(PlaywrightTimeoutError):  # the page was drawn anew meanwhile
            offered.click(timeout=2000)
        page.wait_for_timeout(200)


def go_through(page: Page, client: RoomClient, done) -> RoomState:
    """Click the main answer of whatever is asked until `done`."""
    while True:
        state = until(client, lambda s: done(s) or s.question is not None or not s.robot.armed)
        if done(state):
            return state
        if state.question is None:
            arm(page, client)
            continue
        with contextlib.suppress(PlaywrightTimeoutError):  # it was answered by what happened
            page.locator("#question .answers button.main").click(timeout=5000)


def begin(page: Page, client: RoomClient, label: str) -> str:
    expect(page.locator("#new-label")).to_be_visible()
    page.locator("#new-label").fill(label)
    press(page, client, lambda s: s.case_folder, "Start the case")
    state = until(client, lambda s: s.case_folder and s.case and s.case.label == label)
    expect(page.locator("#room")).to_contain_text(label)
    assert state.calibrated is False
    assert state.target_patient_mm is None
    assert state.measurement is None
    assert state.slices == {}
    assert state.case_folder is not None
    return state.case_folder


def start_calibration(page: Page, client: RoomClient) -> None:
    """In two steps: what will move is said before it does."""
    steps = ("Drive the stages – calibrate", "Start the calibration")
    press(page, client, lambda s: s.procedure == "calibration" or s.calibrated, *steps)


def calibrate(page: Page, client: RoomClient) -> None:
    start_calibration(page, client)
    go_through(page, client, lambda s: s.procedure is None and s.calibrated)


def pick_and_approach(page: Page, client: RoomClient) -> None:
    state = client.state()
    assert state.slice is not None
    assert state.measurement is not None
    assert state.measurement.centre_px is not None
    row, col = state.measurement.centre_px
    page.get_by_role("button", name="Pick target", exact=True).first.click()
    laid_out(page)
    box = page.locator(".view canvas").first.bounding_box()
    assert box is not None
    rows, cols = state.slice.shape
    x = box["x"] + (col + 2.5) * box["width"] / cols
    page.mouse.click(x, box["y"] + (row - 1.5) * box["height"] / rows)
    press(page, client, lambda s: s.target_patient_mm, "Set target")
    press(page, client, lambda s: s.procedure == "approach" or s.ready, "Start the approach")
    go_through(page, client, lambda s: s.ready and s.robot.insertion_locked)


def puncture(page: Page, client: RoomClient) -> None:
    press(page, client, lambda s: s.punctured, "Record the puncture")
    unlock = page.get_by_role("button", name=re.compile("unlock", re.I))
    while until(client, lambda s: True).robot.insertion_locked:
        # two steps, the second elsewhere; a button that has just moved takes no click for a moment
        with contextlib.suppress(PlaywrightTimeoutError):
            unlock.last.click(timeout=2000)
        page.wait_for_timeout(300)


def finish(page: Page, client: RoomClient) -> None:
    steps = ("Finish the case now", "Finish the case …")
    press(page, client, lambda s: s.case_folder is None, *steps)
    expect(page.locator("#new-label")).to_be_visible()


def one_patient(
    page: Page, client: RoomClient, hospital: Hospital, label: str, *, killed: bool
) -> str:
    folder = begin(page, client, label)
    arm(page, client)
    if killed:
        start_calibration(page, client)
        until(client, lambda s: s.robot.moving)
        hospital.kill("service")
        hospital.start_again("service")
        state = until(client, lambda s: s.robot.linked)
        assert state.case_folder == folder
        assert state.case_question == ""
        expect(page.locator("#room")).to_contain_text(label)
        go_through(page, client, lambda s: s.procedure is None)
        arm(page, client)
    if not client.state().calibrated:
        calibrate(page, client)
    pick_and_approach(page, client)
    puncture(page, client)
    finish(page, client)
    return folder


def identity_of(folder: Path) -> set[str]:
    """Whatever names a patient or an examination in the slices of a case."""
    found: set[str] = set()
    for path in (folder / "inbox").glob("*.dcm"):
        data_set = pydicom.dcmread(path, stop_before_pixels=True)
        found |= {str(data_set.PatientID), str(data_set.PatientName)}
        found |= {str(data_set.StudyInstanceUID), str(data_set.FrameOfReferenceUID)}
        found.add(str(data_set.SOPInstanceUID))
    return found


def said_in(folder: Path, words: set[str]) -> list[str]:
    """Files of a case, and members of its export, that say one of the words."""
    wanted = [word.encode() for word in words]
    said = []
    for path in folder.rglob("*"):
        if not path.is_file():
            continue
        pieces = {str(path): path.read_bytes()}
        if path.suffix == ".zip":
            with zipfile.ZipFile(io.BytesIO(pieces[str(path)])) as archive:
                pieces = {name: archive.read(name) for name in archive.namelist()}
        said += [name for name, text in pieces.items() if any(word in text for word in wanted)]
    return said


@pytest.mark.parametrize(
    ("patients", "killed", "cycled"),
    [
        pytest.param(2, 1, 2, id="two"),
        pytest.param(5, 3, 4, id="five", marks=pytest.mark.soak),
    ],
)
def test_patients_one_after_the_other_by_clicking(hospital, screen, patients, killed, cycled):
    cases = Cases(hospital.folder / "cases")
    with RoomClient(hospital.url, by="tester") as client:
        folders = []
        for number in range(1, patients + 1):
            if number == cycled:
                hospital.power_cycle_controllers()
                until(client, lambda s: s.robot.linked and s.robot.taken_um)
            folders.append(
                one_patient(screen, client, hospital, f"patient {number}", killed=number == killed)
            )
        papers = [cases.home / name / "papers" / "case.zip" for name in folders]
        wait_for(lambda: [path.is_file() for path in papers], all, 120.0)
        of_case = {name: str(client.events(case=name)) for name in folders}
    identities = {name: identity_of(cases.home / name) for name in folders}
    for name in folders:
        with CaseRecord(cases.home / name, read_only=True) as record:
            record.verify_events()
            assert record.last_event("puncture") is not None
            assert record.last_event("case_finished") is not None
            assert all(move.measurement_id is None or move.state for move in record.moves())
        for other in set(folders) - {name}:
            strangers = identities[other] - identities[name]
            assert strangers, "each patient is another one"
            assert said_in(cases.home / name, strangers) == []
            assert not any(word in of_case[name] for word in strangers)
