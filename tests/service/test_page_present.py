"""On the page: STOP says what became of it, nothing is done by a click that was meant for another
button, an overrule gives its reason, and all tabs of a browser share one event stream.
"""

import re
import time
from pathlib import Path

import httpx
import pytest
from attended_room import AttendedRoom, arm, calibrated, wait_for
from browser import Complaints
from lone_service import running_service
from playwright.sync_api import Browser, Page, expect
from recorded_case import add_slice, make_case

from case_record.record import CaseRecord
from service.client import RoomClient

TABS = 8
SLOW_MS = 200_000.0


def visit(browser: Browser, url: str, complaints: Complaints) -> Page:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    complaints.watch(page)
    page.goto(url)
    expect(page.locator("#phases [aria-current]")).to_be_visible()
    return page


def viewers(url: str) -> int:
    lines = httpx.get(f"{url}/metrics").text.splitlines()
    return int(float(next(one for one in lines if one.startswith("autospine_viewers")).split()[1]))


def stops(folder: Path) -> int:
    with CaseRecord(folder / "case") as record:
        return len(record.events_of_kind("stop"))


def test_many_tabs_share_one_event_stream_and_a_stop_gets_out_of_any_of_them(
    browser: Browser, tmp_path: Path
) -> None:
    complaints = Complaints()
    camera = "http://bench.example:8090/"
    with (
        running_service(tmp_path, f'camera_preview_url = "{camera}"\n') as url,
        browser.new_context() as context,
    ):
        pages = [context.new_page() for _ in range(TABS)]
        for page in pages:
            complaints.watch(page)
            page.goto(url)
            expect(page.locator("#phases [aria-current]")).to_be_visible()
        assert viewers(url) == 1
        expect(page.get_by_role("link", name="Camera")).to_have_attribute("href", camera)
        for number, page in enumerate((pages[0], pages[-1]), 1):
            page.bring_to_front()
            page.locator("#stop").click()
            wait_for(lambda: stops(tmp_path), lambda found, n=number: found == n)
        # what is heard in one tab is heard in all
        expect(pages[3].locator("#events li").filter(has_text="Stop")).to_have_count(2)
        pages[0].close()  # the one that was first
        httpx.put(f"{url}/api/v1/case", json={"label": "heard on"})
        expect(pages[1].locator("#room")).to_contain_text("heard on")
    assert complaints == []


def test_a_stop_that_reaches_no_robot_says_so_at_the_button(
    browser: Browser, tmp_path: Path
) -> None:
    with running_service(tmp_path) as url:
        page = visit(browser, url, Complaints())
        page.locator("#stop").click()
        said = page.locator("#stop-said")
        expect(said).to_have_text("NOT DELIVERED – USE THE STOP SWITCH")
        with browser.new_context(java_script_enabled=False) as context:
            bare = context.new_page()
            bare.goto(url)
            bare.locator("#stop").click()
            expect(bare.locator("h1")).to_contain_text("NOT DELIVERED – USE THE STOP SWITCH")
    # the service is gone: nobody answers
    page.keyboard.press("Escape")
    expect(said).to_have_text("NOT DELIVERED – USE THE STOP SWITCH")
    page.close()


def test_a_stop_that_has_arrived_says_stopped(page: Page, client: RoomClient) -> None:
    arm(client)
    page.locator("#stop").click()
    expect(page.locator("#stop-said")).to_have_text("stopped")
    assert client.state().robot.stopped
    arm(client)
    expect(page.locator("#stop-said")).to_have_text("")


def test_an_order_that_the_browser_held_back_is_not_carried_out_late(
    room: AttendedRoom, client: RoomClient
) -> None:
    arm(client)
    at_um = client.state().robot.positions_um
    late = {"X-Asked-At": str(time.monotonic() - 10)}
    body = {"axis": "xt", "distance_um": 500}
    answer = httpx.post(f"{room.url}/api/v1/jog", json=body, headers=late)
    assert answer.status_code == 409
    assert answer.json()["title"] in ("stale_order", "void_after_stop")
    assert client.state().robot.positions_um == at_um


@pytest.mark.timeout(600)
def test_impatient_clicks_at_confirm_neither_unlock_nor_puncture(
    page: Page, client: RoomClient
) -> None:
    measured = calibrated(client).measurement
    assert measured is not None
    assert measured.patient_mm is not None
    x, y, z = measured.patient_mm
    client.set_target((x + 1.0, y, z - 1.0))
    before = client.state().event_id
    client.start_approach()
    confirm = page.locator("#confirm")
    while True:
        state = wait_for(client.state, lambda s: s.ready or s.question is not None, 200.0)
        if state.ready:
            break
        expect(confirm).to_be_enabled(timeout=SLOW_MS)
        box = confirm.bounding_box()
        assert box is not None
        at = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.dblclick(*at)
        # and again and again at the same place, until long after READY
        until = before
        while client.state().procedure is not None and client.state().question is None:
            page.mouse.dblclick(*at)
    expect(page.locator("#prompt.ready")).to_be_visible(timeout=SLOW_MS)
    for _ in range(20):
        page.mouse.dblclick(*at)
        page.wait_for_timeout(150)
    kinds = {event.kind for event in client.events(after=until)}
    assert "ready" in kinds
    assert not kinds & {"needle_out", "puncture"}
    assert client.state().robot.insertion_locked
    # the second step of unlocking is nowhere near
    unlock = page.get_by_role("button", name="Needle withdrawn – unlock motion")
    if not unlock.is_visible():
        page.get_by_role("button", name="Cancel").click()
    unlock.click()
    sure = page.get_by_role("button", name="Yes, the needle is out")
    place = sure.bounding_box()
    assert place is not None
    inside = place["x"] <= at[0] <= place["x"] + place["width"]
    assert not (inside and place["y"] <= at[1] <= place["y"] + place["height"])
    sure.click()
    expect(page.locator("#chips")).not_to_contain_text("Motion locked", timeout=SLOW_MS)


def test_a_slice_is_offered_for_its_own_hold_only_and_a_reason_is_asked_for(
    browser: Browser, tmp_path: Path
) -> None:
    case_dir = make_case(tmp_path)
    with CaseRecord(case_dir) as record:
        stage_mm = {"xt": 0.25, "yt": 0.25}
        early = add_slice(record, None, stage_mm)  # before the robot stands at the next hold
        hold = record.open_hold()
        assert hold is not None
        record.end_open_hold(time.time())
        values = {name: getattr(hold, name) for name in ("setpoints_um", "readback_um", "shift_um")}
        now_s = time.time()
        here = record.begin_hold(
            set_id=2, place=0, shift_px=(0.0, 0.0), settled_at_s=now_s, expected_slices=1, **values
        )
        late = add_slice(record, None, stage_mm)
    complaints = Complaints()
    with running_service(tmp_path) as url, RoomClient(url) as client:
        page = visit(browser, url, complaints)
        offers = page.locator("#aside button")
        expect(page.locator("#aside tbody tr")).to_have_count(2)
        expect(offers).to_have_count(1)
        expect(offers).to_have_text(f"Use at hold {here.hold_id}")
        offers.click()
        page.get_by_label("Why does it belong to this hold?").fill("seen on the console")
        page.get_by_role("button", name=f"Use at hold {here.hold_id}").click()
        used = wait_for(lambda: client.slice(late), lambda s: s.state == "assigned")
        assert used.hold_id == here.hold_id
        event = [e for e in client.events() if e.kind == "slice_reassigned"][-1]
        assert (event.who, event.body["why"]) == ("operator", "seen on the console")
        assert client.slice(early).offered_hold_id is None
        page.close()
    assert complaints == []


def test_while_a_target_is_picked_the_reach_is_drawn_and_a_cleared_field_is_an_error(
    page: Page, client: RoomClient
) -> None:
    calibrated(client)
    before = client.state().event_id
    page.get_by_role("button", name="Pick target").click()
    expect(page.locator("#reach").first).to_have_attribute(
        "points", re.compile(r"^(-?[\d.]+,-?[\d.]+ ?){4}$")
    )
    page.locator("#pick-x").fill("")
    page.get_by_role("button", name="Set target", exact=True).click()
    expect(page.locator("#refusal")).to_contain_text("is empty")
    assert "target_set" not in {event.kind for event in client.events(after=before)}
    page.get_by_role("button", name="Cancel").click()
