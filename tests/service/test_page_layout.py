"""How the page is laid out, in a real Chromium: five sizes, every state, the longest names."""

import re

import pytest
from attended_room import AttendedRoom, arm, calibrated, stop_all, wait_for
from browser import laid_out, set_theme, violations
from lone_service import running_service
from page_states import LONG, SIZES, THEMES, layout_faults_at_all_sizes, not_in_one_glance, states
from playwright.sync_api import Browser, Page, expect

from service.client import RoomClient
from service.web.access import new_token, token_hash


def test_nothing_is_cut_or_scrolls_by_itself_or_lies_under_stop_or_is_hard_to_read_in_any_state(
    page: Page, client: RoomClient
) -> None:
    wrong = {}
    for state in states(page, client):
        for name, faults_of in ((LONG, layout_faults_at_all_sizes), ("layout", not_in_one_glance)):
            client.describe_case(name, name, name)
            expect(page.locator("#room")).to_have_text(re.compile(rf" {name}$"))
            if faults := faults_of(page):
                wrong[f"{state}, {name[:8]}"] = faults
        page.set_viewport_size({"width": 1280, "height": 800})
        for theme in THEMES:
            set_theme(page, theme)
            if found := violations(page):
                wrong[f"{state}, {theme}"] = found
    assert not wrong


def test_the_login_form_fits_keeps_what_is_typed_and_no_connection_is_called_lost(
    browser: Browser, tmp_path_factory: pytest.TempPathFactory
) -> None:
    token = new_token()
    table = (
        f'[[service.token]]\nname = "{"W" * 64}"\nrole = "viewer"\nsha256 = "{token_hash(token)}"\n'
    )
    with running_service(tmp_path_factory.mktemp("login"), table) as url:
        page = browser.new_page()
        page.goto(url)
        page.locator("#token").press_sequentially("half a tok")
        # long enough for every watch of the event stream to have given up, were there one
        page.wait_for_timeout(6000)
        assert page.locator("#token").input_value() == "half a tok"
        expect(page.locator("body")).not_to_have_class("stale")
        assert "lost" not in page.locator("#top").inner_text()
        page.locator("#token").fill(token)
        page.get_by_role("button", name="Log in").click()
        expect(page.locator("#who")).to_contain_text("viewer")
        assert not layout_faults_at_all_sizes(page)
        page.close()


def test_the_image_is_the_largest_thing_and_keeps_its_size_when_picking_starts(
    page: Page, client: RoomClient
) -> None:
    calibrated(client)
    expect(page.locator("#pick")).to_be_enabled()
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        laid_out(page)
        before = page.locator(".views").bounding_box()
        others = page.locator("#act-scroll > section, #foot, #top, #alarm-line")
        assert before is not None
        area = before["width"] * before["height"]
        for k in range(others.count()):
            box = others.nth(k).bounding_box()
            assert box is None or area > box["width"] * box["height"]
        page.locator("#pick").click()
        laid_out(page)
        assert page.locator(".views").bounding_box() == before
        page.locator("#pick").click()


def test_type_on_a_4k_panel_is_as_large_as_on_a_full_hd_panel_of_the_same_size(page: Page) -> None:
    def share_of_the_height(width: int, height: int) -> list[float]:
        page.set_viewport_size({"width": width, "height": height})
        laid_out(page)
        sizes = page.evaluate(
            """() => ["#prompt", "#stop", "td", "button", "#room"].map((one) =>
                parseFloat(getComputedStyle(document.querySelector(one)).fontSize))"""
        )
        assert min(sizes) > 12
        return [size / height for size in sizes]

    assert share_of_the_height(3840, 2160) == pytest.approx(
        share_of_the_height(1920, 1080), rel=0.01
    )


def test_confirm_is_a_few_tabs_away_and_focus_survives_what_is_drawn_anew(
    page: Page, client: RoomClient, room: AttendedRoom
) -> None:
    measured = calibrated(client).measurement
    assert measured is not None
    assert measured.patient_mm is not None
    x, y, z = measured.patient_mm
    client.set_target((x + 2.0, y, z), label="one")
    again = page.get_by_role("button", name="Use again: target one")
    client.set_target((x + 2.0, y, z + 2.0), label="two")
    again.focus()
    client.set_target((x - 2.0, y, z + 2.0), label="three")
    expect(page.locator("#targets tr", has_text="three")).to_contain_text("current")
    expect(again).to_be_focused()
    arm(client)
    client.start_approach()
    expect(page.locator("#confirm")).to_be_enabled()
    page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    page.locator("#theme").focus()
    for _ in range(4):
        page.keyboard.press("Tab")
        if page.locator("#confirm").evaluate("(one) => one === document.activeElement"):
            break
    expect(page.locator("#confirm")).to_be_focused()
    stop_all(client)
    # its button is gone: the keyboard goes on at what to do next, not at the head of the page
    wait_for(client.state, lambda s: s.question is None)
    expect(page.locator("#next")).to_be_focused()


def test_a_refusal_goes_away_when_it_is_no_longer_true(page: Page, client: RoomClient) -> None:
    calibrated(client)
    if client.state().target_patient_mm is not None:
        client.withdraw_target()
    expect(page.locator("#pick")).to_be_enabled()
    page.evaluate(
        """() => import("./page/actions.js").then(({ act }) => act(async () => {
            throw new Error("a target is needed"); }))"""
    )
    expect(page.locator("#refusal")).to_have_text("a target is needed")
    measured = client.state().measurement
    assert measured is not None
    assert measured.patient_mm is not None
    client.set_target(measured.patient_mm)
    expect(page.locator("#refusal")).to_have_text("")
