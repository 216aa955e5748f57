"""The image area and the cards of the page in a real Chromium, on the whole virtual room."""

import json
import re
import time
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest
from attended_room import AttendedRoom, arm, calibrated, stop_all, wait_for
from browser import laid_out, set_theme, violations
from lone_service import running_service
from playwright.sync_api import Browser, Locator, Page, expect
from test_api_documents import copy_case

from case_record.record import CaseRecord
from service.client import RoomClient
from service.room.state import RoomState

VIEW = ".view >> nth=0"
# the first canvas of the slice: how bright it is on average, 0 to 255
BRIGHTNESS = """() => { const canvas = document.querySelector(".view canvas");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let sum = 0; for (let k = 0; k < data.length; k += 4) sum += data[k];
    return 4 * sum / data.length; }"""


@pytest.fixture
def state(page: Page, client: RoomClient) -> RoomState:
    """A calibrated room whose newest slice is on the page."""
    state = calibrated(client)
    assert state.slice is not None
    expect(page.locator(f"{VIEW} >> .what")).to_have_text(f"Slice {state.slice.slice_id}")
    return state


def place_of(page: Page, state: RoomState, row: float, col: float) -> tuple[float, float]:
    """Where a pixel's centre of the slice is on the screen."""
    assert state.slice is not None
    laid_out(page)
    box = page.locator(".view canvas").first.bounding_box()
    assert box is not None
    rows, cols = state.slice.shape
    return (
        box["x"] + (col + 0.5) * box["width"] / cols,
        box["y"] + (row + 0.5) * box["height"] / rows,
    )


def patient_mm(state: RoomState, row: float, col: float) -> list[float]:
    assert state.slice is not None
    slice_ = state.slice
    between_rows, between_cols = slice_.spacing_mm
    along = np.outer(row * between_rows, slice_.row_direction)[0]
    across = np.outer(col * between_cols, slice_.col_direction)[0]
    return [float(v) for v in np.array(slice_.position_mm) + along + across]


def test_the_cursor_reads_the_patients_millimetres_and_the_pixels_own_value(
    page: Page, state: RoomState, room: AttendedRoom
) -> None:
    assert state.slice is not None
    page.mouse.move(*place_of(page, state, 50, 70))
    read = page.locator("#images .read")
    expect(read).to_contain_text("row 50.0")
    said = read.inner_text().replace("−", "-")
    found = re.search(r"x (-?[\d.]+) +y (-?[\d.]+) +z (-?[\d.]+) mm", said)
    assert found is not None
    assert [float(v) for v in found.groups()] == pytest.approx(patient_mm(state, 50, 70), abs=0.15)
    raw = httpx.get(f"{room.url}/api/v1/slices/{state.slice.slice_id}/pixels")
    value = np.frombuffer(raw.content, "<f4").reshape(state.slice.shape)[50, 70]
    assert float(said.split("value ")[1].split()[0]) == pytest.approx(float(value), rel=1e-3)


def test_window_and_level_change_what_is_seen_and_auto_brings_it_back(
    page: Page, state: RoomState
) -> None:
    natural = page.evaluate(BRIGHTNESS)
    level = page.get_by_label("Level")
    level.focus()
    for _ in range(40):
        page.keyboard.press("ArrowRight")
    darker = page.evaluate(BRIGHTNESS)
    assert darker < natural
    page.get_by_role("button", name="Auto").click()
    assert page.evaluate(BRIGHTNESS) == pytest.approx(natural)
    x, y = place_of(page, state, 50, 70)
    page.mouse.move(x, y)
    page.mouse.down(button="right")
    page.mouse.move(x, y + 60, steps=5)
    page.mouse.up(button="right")
    assert page.evaluate(BRIGHTNESS) != pytest.approx(natural)
    page.get_by_role("button", name="Auto").click()


def test_zoom_by_wheel_by_key_and_by_button_and_both_views_follow(
    page: Page, state: RoomState
) -> None:
    def widths() -> list[float]:
        boxes = [page.locator(f".view >> nth={k} >> canvas").first.bounding_box() for k in (0, 1)]
        return [box["width"] for box in boxes if box is not None]

    expect(page.locator(".view >> nth=1 >> .what")).to_contain_text("×2")
    laid_out(page)
    whole = widths()[0]
    page.mouse.move(*place_of(page, state, 60, 60))
    laid_out(page)
    assert widths()[0] == whole, "the image does not jump when the pointer comes in"
    page.mouse.wheel(0, -400)
    wait_for(lambda: widths()[0], lambda width: width > 1.5 * whole)
    page.locator(VIEW).focus()
    before = widths()[0]
    page.keyboard.press("+")
    assert widths()[0] == pytest.approx(1.5 * before, rel=1e-3)
    assert widths()[0] == pytest.approx(widths()[1], rel=0.02)
    page.keyboard.press("0")
    assert widths()[0] == pytest.approx(whole)
    page.get_by_role("button", name="Fiducial", exact=True).click()
    circle = page.locator("#fiducial").bounding_box()
    view = page.locator(VIEW).bounding_box()
    assert circle is not None
    assert view is not None
    assert circle["x"] + circle["width"] / 2 == pytest.approx(
        view["x"] + view["width"] / 2, abs=2.0
    )
    page.get_by_role("button", name="Whole").click()
    assert widths()[0] == pytest.approx(whole)


def test_one_image_or_both_or_blended(page: Page, state: RoomState) -> None:
    slice_view, reconstruction = page.locator(".view >> nth=0"), page.locator(".view >> nth=1")
    page.get_by_role("button", name="Reconstruction", exact=True).click()
    expect(slice_view).to_be_hidden()
    page.get_by_role("button", name="Slice", exact=True).click()
    expect(reconstruction).to_be_hidden()
    alone = page.locator(f"{VIEW} >> canvas >> nth=1")
    expect(alone).to_be_hidden()
    page.get_by_role("button", name="Blended").click()
    expect(alone).to_be_visible()
    page.get_by_role("button", name="Both").click()
    expect(reconstruction).to_be_visible()


def test_what_the_fit_leaves_is_one_click_away_with_its_chi2(
    page: Page, state: RoomState, room: AttendedRoom
) -> None:
    measurement = state.measurement
    assert measurement is not None
    assert measurement.centre_px is not None
    assert measurement.radius_px is not None
    page.get_by_role("button", name="Residual").click()
    residual = page.locator(".view >> nth=2")
    expect(residual.locator(".what")).to_contain_text(f"Slice {measurement.slice_id} − disc, χ² ")
    expect(page.locator(VIEW)).to_be_visible()
    url = f"{room.url}/api/v1/measurements/{measurement.measurement_id}/residual"
    answer = httpx.get(url)
    rows, cols = map(int, answer.headers["X-Shape"].split(","))
    left = np.frombuffer(answer.content, "<f4").reshape(rows, cols)
    raw = httpx.get(f"{room.url}/api/v1/slices/{measurement.slice_id}/pixels").content
    seen = np.frombuffer(raw, "<f4").reshape(rows, cols)
    row, col = (round(value) for value in measurement.centre_px)
    near = np.s_[row - 8 : row + 9, col - 8 : col + 9]
    # the disc takes most of the fiducial away; a tube in its middle stays, for everybody to see
    assert np.sum(left[near] ** 2) < 0.6 * np.sum((seen[near] - np.median(seen)) ** 2)
    assert not left[:20].any()


def test_an_entry_point_is_picked_moved_by_keys_and_drawn_with_its_line_to_the_target(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    before = client.state().entry_patient_mm
    page.get_by_role("button", name="Pick target").click()
    page.mouse.click(*place_of(page, state, 40, 60))
    page.locator(VIEW).focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    page.locator("#set-entry").click()
    entry = wait_for(
        client.state, lambda s: s.entry_patient_mm not in (None, before)
    ).entry_patient_mm
    # a click is exact to a pixel of the screen, a key moves by a tenth of a millimetre
    assert entry == pytest.approx(patient_mm(state, 40.1, 60.1), abs=0.25)
    page.get_by_role("button", name="Pick target").click()
    page.mouse.click(*place_of(page, state, 60, 70))
    page.locator("#set-target").click()
    wait_for(client.state, lambda s: s.target_patient_mm is not None)
    expect(page.locator(f"{VIEW} >> line.c-entry")).to_have_count(1)
    client.withdraw_target()


def test_a_target_of_before_is_taken_again_by_clicking(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    first, second = patient_mm(state, 55, 60), patient_mm(state, 58, 66)
    client.set_target((first[0], first[1], first[2]), label="the first")
    client.set_target((second[0], second[1], second[2]), label="the second")
    expect(page.locator("#targets tr", has_text="the second")).to_contain_text("current")
    page.get_by_role("button", name="Use again: target the first").click()
    wait_for(client.state, lambda s: s.target_patient_mm == pytest.approx(first))
    client.withdraw_target()


def test_a_jog_by_clicking_moves_one_axis_by_what_the_button_says(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    arm(client)
    before = client.state().robot.positions_um
    page.locator("#jog summary").click()
    page.get_by_role("button", name="xt plus 0.1 mm").click()
    after = wait_for(
        client.state, lambda s: s.robot.positions_um["xt"] != before["xt"] and s.procedure is None
    ).robot.positions_um
    assert after["xt"] - before["xt"] == pytest.approx(100, abs=20)
    assert after["yt"] == pytest.approx(before["yt"], abs=5)


def test_motion_is_locked_for_the_needle_by_hand_and_unlocked(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    arm(client)
    page.locator("#jog summary").click()
    page.get_by_role("button", name="Lock motion for the needle").click()
    expect(page.locator("#chips")).to_contain_text("Motion locked")
    expect(page.get_by_role("button", name="xt plus 1 mm")).to_be_disabled()
    page.get_by_role("button", name="Needle withdrawn – unlock motion").click()
    page.get_by_role("button", name="Yes, the needle is out").click()
    expect(page.locator("#chips")).not_to_contain_text("Motion locked")


def test_an_emergency_looks_unlike_a_stop_and_says_what_to_do(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    arm(client)
    banner = page.locator("#banner-emergency")
    client.stop()
    expect(page.locator("#phases [aria-current]")).to_have_text("Stop")
    expect(banner).to_be_hidden()
    page.locator("#emergency").click()
    expect(banner).to_be_visible()
    expect(banner).to_contain_text("Attend to the patient and the needle first")
    expect(page.locator("#phases [aria-current]")).to_have_text("Emergency")
    expect(page.locator("#prompt")).to_contain_text("re-arm")
    expect(page.locator("#alarms")).to_contain_text("drives parked")
    assert [e.kind for e in client.events()][-20:].count("emergency") == 1
    for theme in ("dark", "light"):
        set_theme(page, theme)
        assert not violations(page)
    page.get_by_role("button", name="Re-arm the robot").click()
    expect(banner).to_be_hidden()
    expect(page.locator("#chips")).to_contain_text("Armed")
    stop_all(client)


def test_the_clocks_are_compared_by_typing_what_the_scanner_shows(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    client.compare_clocks(-37.2, 0.02)
    known = sum(e.kind == "clock_sync" for e in client.events())
    card = page.locator("#scanner-clock")
    expect(card).to_contain_text("37.2 s ahead")
    page.locator("#scanner-shows").fill("half past ten")
    page.get_by_role("button", name="Scanner clock reads this now").click()
    expect(card).to_contain_text("Type what the scanner clock reads")
    # the scanner of the virtual room is 37.2 s ahead
    read_s = time.time()
    shown = page.evaluate("new Date(Date.now() + 37200).toTimeString().slice(0, 8)")
    page.locator("#scanner-shows").fill(shown)
    page.get_by_role("button", name="Scanner clock reads this now").click()
    pressed_s = time.time()
    page.get_by_role("button", name="Use this").click()
    event = wait_for(
        lambda: [e for e in client.events() if e.kind == "clock_sync"],
        lambda found: len(found) > known,
    )[-1]
    # whole seconds are shown; what passed between reading and pressing makes the scanner seem late
    assert -37.2 - 0.7 <= event.body["offset_s"] <= -37.2 + 0.7 + pressed_s - read_s
    assert event.body["uncertainty_s"] == 1.0
    expect(card).to_contain_text("by operator")
    page.get_by_role("button", name="The scanner clock was changed: discard this").click()
    expect(card).to_contain_text("Not compared")
    client.compare_clocks(-37.2, 0.02)


def test_a_comparison_that_slices_have_made_doubtful_says_so_until_the_clocks_are_compared_again(
    page: Page, state: RoomState, client: RoomClient, room: AttendedRoom
) -> None:
    client.compare_clocks(-37.2, 0.02)
    card = page.locator("#scanner-clock")
    expect(card).not_to_contain_text("Doubted")
    doubt = {"scanner": "MR 1", "text": "it arrived 3.0 s sooner", "is_certain": False}
    with CaseRecord(room.folder) as record:
        record.append_event("clock_doubted", {**doubt, "at_s": time.time()}, source="listener")
    expect(card.locator(".wrong")).to_contain_text(
        "Doubted: compare again (MR 1: it arrived 3.0 s sooner). Until then slices are pending."
    )
    expect(page.locator("#alarms")).to_contain_text("The scanner's clock is doubted")
    client.compare_clocks(-37.2, 0.02)
    expect(card).not_to_contain_text("Doubted")


def test_slices_that_will_not_come_are_given_up_where_slices_were_set_aside(
    page: Page, state: RoomState, client: RoomClient
) -> None:
    arm(client)
    slice_ = client.slices(state="assigned")[0]
    client.assign_slice(slice_.slice_id, None, why="a doubtful one")
    assert slice_.hold_id is not None
    before = client.state().event_id
    page.locator("#lacking-hold").fill(str(slice_.hold_id))
    # the list is drawn anew under the operator's hands; what was typed stays
    client.describe_case("another list")
    expect(page.locator("#events li").first).to_contain_text("another list")
    page.get_by_role("button", name="Stop waiting for these slices").click()
    given_up = wait_for(
        lambda: [e for e in client.events(after=before) if e.kind == "slices_given_up"],
        lambda found: found,
    )
    assert given_up[-1].who == "operator"
    assert given_up[-1].body["hold_id"] == slice_.hold_id
    # the template was learnt from it: nothing can be measured until the room is calibrated again
    client.start_calibration()
    wait_for(
        client.state, lambda s: s.procedure is None and s.last_outcome == "calibration done", 120.0
    )


def test_report_and_export_of_this_case_and_of_others_are_a_click_away(
    page: Page, state: RoomState, client: RoomClient, tmp_path: Path
) -> None:
    with page.expect_download(timeout=300_000) as waiting:
        page.get_by_role("link", name="Export as zip").click()
    path = tmp_path / "case.zip"
    waiting.value.save_as(path)
    with zipfile.ZipFile(path) as archive:
        assert json.loads(archive.read("MANIFEST.json"))["format"] == "autospine-case-export"
    with page.expect_popup() as opening:
        page.get_by_role("link", name="Report", exact=True).click()
    report = opening.value
    expect(report.locator("body")).to_contain_text(client.state().case_uid, timeout=300_000)
    report.close()
    row = page.locator("#past tbody tr").first
    expect(row.get_by_role("link", name=re.compile("^Report of"))).to_be_visible()


def test_the_card_of_the_parts_counts_what_crosses_the_line(page: Page, state: RoomState) -> None:
    def count(cell: Locator) -> int:
        text = cell.inner_text()
        return int(text) if text.isdecimal() else 0

    for name in ("Service", "Robot", "Listener", "Worker"):
        expect(page.locator("#parts tr", has_text=name).first).to_contain_text(
            re.compile("running|linked")
        )
    sent = page.locator('[data-metric="autospine_link_frames_sent"]')
    first = wait_for(lambda: count(sent), lambda n: n > 10)
    wait_for(lambda: count(sent), lambda n: n > first)


def test_the_other_fiducial_of_the_guide_is_drawn_with_the_axis_through_both(
    browser: Browser, room: AttendedRoom, state: RoomState, tmp_path: Path
) -> None:
    """A record in which the newest measurement and one before lie at two slice positions."""
    copy_case(room.folder, tmp_path / "case")
    with CaseRecord(tmp_path / "case") as record:
        found = record.measurements("done")[-1].result
        assert found is not None
        x, y, z = found["patient_mm"]
        for where_mm, patient in ((20.0, [x + 5.0, y - 60.0, z + 3.0]), (80.0, [x, y, z])):
            number = record.request_measurement("ml", [1], {"slice_position_mm": where_mm})
            record.finish_measurement(number, {**found, "patient_mm": patient})
    with running_service(tmp_path) as url:
        page = browser.new_page()
        page.goto(url)
        other = page.locator(f"{VIEW} >> .other-fiducial")
        expect(other).to_have_count(1)
        axis = page.locator(f"{VIEW} >> .guide-axis")
        # columns grow to the left (+x), rows towards the feet (-z)
        along = [float(axis.get_attribute(k) or "nan") for k in ("x1", "y1", "x2", "y2")]
        assert along[2] - along[0] == pytest.approx(5.0)
        assert along[3] - along[1] == pytest.approx(-3.0)
        page.close()


def test_every_control_can_be_reached_by_the_tabulator(page: Page, state: RoomState) -> None:
    wanted = page.evaluate(
        """() => [...document.querySelectorAll("button, input, summary, a[href]")]
            .filter((one) => !one.disabled && one.checkVisibility()).length"""
    )
    page.locator("body").focus()
    seen = set()
    for _ in range(2 * wanted + 40):
        page.keyboard.press("Tab")
        seen.add(
            page.evaluate(
                """() => { const one = document.activeElement;
                    return [...document.querySelectorAll("*")].indexOf(one); }"""
            )
        )
    missed = page.evaluate(
        """(seen) => { const all = [...document.querySelectorAll("*")];
            return all.filter((one, k) => one.matches("button, input, summary, a[href]")
                && !one.disabled && one.checkVisibility() && !seen.includes(k))
                .map((one) => one.outerHTML.slice(0, 80)); }""",
        sorted(seen),
    )
    assert not missed
