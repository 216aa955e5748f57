"""Anatomy on the page: planning slices at other depths, the guide's fiducials before each move."""

import io
import re
import time
from pathlib import Path

import pydicom
import pytest
from attended_room import AttendedRoom, arm, calibrated, running_room, wait_for
from browser import laid_out
from lone_service import running_service
from page_states import layout_faults, layout_faults_at_all_sizes, not_in_one_glance
from playwright.sync_api import Browser, Page, expect
from pydicom.uid import generate_uid
from pynetdicom import AE
from test_api_documents import copy_case

from service.client import RefusedByServiceError, RoomClient

DEPTH_MM = 7.0


def send_planning_slice(room: AttendedRoom, client: RoomClient) -> int:
    """A slice like the newest one, DEPTH_MM further along patient y; returns its number here."""
    state = client.state()
    assert state.slice is not None
    before = state.last_slice_id or 0
    dataset = pydicom.dcmread(io.BytesIO(client.slice_dicom(state.slice.slice_id)))
    x, y, z = (float(value) for value in dataset.ImagePositionPatient)
    dataset.ImagePositionPatient = [x, y + DEPTH_MM, z]
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    ae = AE("PLANNING")
    ae.add_requested_context(dataset.SOPClassUID, dataset.file_meta.TransferSyntaxUID)
    port = int(room.virtual_table["scanner"]["listener_port"])
    association = ae.associate("127.0.0.1", port, ae_title="AUTOSPINE")
    assert association.is_established
    assert association.send_c_store(dataset).Status == 0
    association.release()
    seen = wait_for(client.state, lambda s: (s.last_slice_id or 0) > before)
    return int(seen.last_slice_id or 0)


def test_a_target_is_picked_on_a_planning_slice_at_another_depth(
    page: Page, room: AttendedRoom, client: RoomClient
) -> None:
    state = calibrated(client)
    assert state.slice is not None
    depth_mm = state.slice.position_mm[1] + DEPTH_MM
    number = send_planning_slice(room, client)
    thumb = page.get_by_role("button", name=re.compile(f"^{number} (planning|set aside|waiting)"))
    expect(thumb).to_contain_text(f"P {depth_mm:.1f}")
    thumb.click()
    what = page.locator(".view .what").first
    expect(what).to_have_text(f"Slice {number} (not the newest)")
    # the fiducial lies in another slice: it is not drawn here
    expect(page.locator("#fiducial")).to_have_count(0)
    page.locator("#pick").click()
    laid_out(page)
    box = page.locator(".view canvas").first.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.55 * box["width"], box["y"] + 0.5 * box["height"])
    expect(page.locator("#pick-panel .facts")).to_contain_text("mm from the fiducial")
    expect(page.locator("#pick-panel .facts")).to_contain_text("Within the robot's travel")
    page.locator("#pick-label").fill("planned")
    page.locator("#set-target").click()
    target = wait_for(client.state, lambda s: s.target_patient_mm is not None).target_patient_mm
    assert target is not None
    assert target[1] == pytest.approx(depth_mm, abs=0.01)
    expect(page.locator("#targets")).to_contain_text("planned")
    page.locator("#newest-slice").click()
    expect(what).to_have_text(f"Slice {state.slice.slice_id}")
    client.withdraw_target()


def test_a_point_out_of_reach_is_called_so_while_pointing(page: Page, client: RoomClient) -> None:
    calibrated(client)
    page.locator("#pick").click()
    page.locator("#pick-x").fill("60")
    page.locator("#pick-x").press("Enter")
    expect(page.locator("#pick-panel .facts")).to_contain_text("Out of reach: axis xt")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#pick-panel")).to_be_hidden()


def test_settings_of_the_case_are_changed_within_bounds_and_recorded(
    page: Page, client: RoomClient
) -> None:
    arm(client)
    page.locator("#settings summary").click()
    page.locator("#set-tolerance_mm").fill("0.2")
    page.locator("#set-most_slices").fill("8")
    page.get_by_role("button", name="Apply").click()
    state = wait_for(client.state, lambda s: s.tolerance_mm == 0.2)
    assert state.belief is not None
    assert state.belief.goal.most_slices == 8
    changed = [e for e in client.events() if e.kind == "settings_changed"]
    assert changed[-1].who == "operator"
    assert changed[-1].body["tolerance_mm"] == 0.2
    goal = {"strategy": "adaptive", "confidence": 0.95, "most_slices": 6}
    with pytest.raises(RefusedByServiceError, match="this room allows"):
        client.change_settings(tolerance_mm=5.0, **goal)
    client.change_settings(tolerance_mm=0.06, **goal)


def test_a_case_of_before_is_opened_read_only(
    browser: Browser, room: AttendedRoom, client: RoomClient, tmp_path: Path
) -> None:
    newest = calibrated(client).slice
    assert newest is not None
    client.describe_case("the first one")
    copy_case(room.folder, tmp_path / "old")
    with running_service(tmp_path) as url:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(url)
        page.get_by_role("link", name="the first one").click()
        expect(page.locator("#prompt")).to_contain_text("read only")
        expect(page.locator(".view .what").first).to_have_text(f"Slice {newest.slice_id}")
        expect(page.locator(".thumb").first).to_be_visible()
        expect(page.locator("#events")).to_contain_text("Calibration started")
        expect(page.locator("#actions button")).to_have_count(0)
        expect(page.locator("#pick")).to_be_disabled()
        expect(page.locator("#stop")).to_be_enabled()
        assert not layout_faults(page)
        page.goto(f"{url}/?case=nowhere")
        expect(page.locator("#refusal")).to_contain_text("There is no case 'nowhere'")
        page.close()


def test_with_four_axes_each_fiducials_distance_is_shown_before_each_confirm(
    browser: Browser, tmp_path: Path
) -> None:
    with running_room(tmp_path, guide=True) as room, RoomClient(room.url) as client:
        page = browser.new_page(viewport={"width": 1920, "height": 1080})
        page.goto(room.url)
        arm(client)
        client.start_calibration()
        found = wait_for(client.state, lambda s: s.calibrated and s.procedure is None, 300.0)
        assert found.measurement is not None
        assert found.measurement.patient_mm is not None
        x, y, z = found.measurement.patient_mm
        page.locator("#pick").click()
        facts = page.locator("#pick-panel .facts")
        expect(facts).to_contain_text("The needle's direction is not known")
        client.set_entry((x + 1.0, y - 40.0, z + 1.0))
        for axis, place, said in (("y", y - 82.0, "Within"), ("x", x + 90.0, "Out of reach")):
            page.locator(f"#pick-{axis}").fill(f"{place:.2f}")
            page.locator(f"#pick-{axis}").press("Enter")
            expect(facts).to_contain_text(said)
        page.get_by_role("button", name="Cancel").click()
        client.set_target((x + 3.0, y - 82.0, z - 2.0))
        client.start_approach()
        expect(page.locator("#confirm")).to_be_enabled()
        assert not layout_faults_at_all_sizes(page)
        assert not not_in_one_glance(page)
        shown = confirm_each(page, client)
        assert shown
        for upper, lower, tip in shown:
            assert min(upper, lower, tip) > 0
        # each move brings the tip nearer
        assert shown[-1][2] <= shown[0][2]
        expect(page.locator("#needle circle")).to_have_count(10)
        page.close()


def confirm_each(page: Page, client: RoomClient) -> list[tuple[float, float, float]]:
    """Confirm on the page until READY; what stood there of upper, lower and tip before each."""
    shown = []
    deadline_s = time.monotonic() + 300
    while time.monotonic() < deadline_s:
        state = wait_for(client.state, lambda s: s.question or s.ready, 120.0)
        if state.ready:
            return shown
        assert state.question is not None
        assert state.question.plan is not None
        parts = {part["name"]: part for part in state.question.plan["parts"]}
        expect(page.locator("#confirm")).to_be_enabled()
        row = []
        for name in ("upper", "lower", "tip"):
            text = page.locator(f'[data-part="{name}"] b').inner_text()
            off = (parts[name]["row_mm"] ** 2 + parts[name]["col_mm"] ** 2) ** 0.5
            assert float(text.split()[0]) == pytest.approx(off, abs=6e-4)
            row.append(float(text.split()[0]))
        shown.append((row[0], row[1], row[2]))
        asked = state.question.question_id
        page.locator("#confirm").click()
        wait_for(client.state, lambda s, a=asked: not s.question or s.question.question_id != a)
    raise AssertionError("READY does not come")
