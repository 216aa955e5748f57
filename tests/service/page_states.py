"""The page in each of its states, and what can be wrong with how it is laid out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from attended_room import arm, calibrated, wait_for
from browser import laid_out, set_theme
from playwright.sync_api import Page, expect

from service.client import RoomClient

# the screens of control rooms, and a tablet held upright
SIZES = ((1024, 768), (1280, 800), (1920, 1080), (3840, 2160), (820, 1180))
THEMES = ("light", "dark")
LONG = "W" * 200
# what to do, the button for it, the distance with its sigma
_IN_ONE_GLANCE = (
    "#prompt, #confirm, #actions .main, #set-target, #error-body .big:not(.quiet), #error-body .pm"
)
_MOST_MOVES = 12

_FAULTS = (Path(__file__).parent / "layout_faults.js").read_text(encoding="utf-8")


def layout_faults(page: Page) -> list[str]:
    """What is wrong with the layout as it is now, in words."""
    laid_out(page)
    return list(page.evaluate(_FAULTS))


def not_in_one_glance(page: Page) -> dict[str, list[str]]:
    """At each of the sizes; only where anything lies under STOP."""
    found = {}
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        if covered := covered_by_stop(page):
            found[f"{width}x{height}"] = covered
    return found


def covered_by_stop(page: Page) -> list[str]:
    """What should be read in one glance with STOP, and is not: it lies under it or below."""
    page.evaluate("scrollTo(0, 0)")
    laid_out(page)
    return list(
        page.evaluate(
            """(glance) => {
                const foot = document.getElementById("foot").getBoundingClientRect().top;
                return [...document.querySelectorAll(glance)].filter((e) => e.checkVisibility()
                    && e.getBoundingClientRect().bottom > foot).map((e) => e.textContent);
            }""",
            _IN_ONE_GLANCE,
        )
    )


def layout_faults_at_all_sizes(page: Page) -> dict[str, list[str]]:
    """At each of the sizes, light and dark; only where anything is wrong."""
    wrong = {}
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        for theme in THEMES:
            set_theme(page, theme)
            if faults := layout_faults(page):
                wrong[f"{width}x{height} {theme}"] = faults
    return wrong


def states(page: Page, client: RoomClient) -> Iterator[str]:
    """Bring a room with one fiducial through a case; yields the name of each state once there."""
    client.stop()
    wait_for(client.state, lambda s: s.robot.stopped and s.procedure is None)
    expect(page.locator("#phases [aria-current]")).to_have_text("Stop")
    yield "stopped"
    client.stop(emergency=True)
    expect(page.locator("#banner-emergency")).to_be_visible()
    yield "emergency"
    arm(client)
    if client.state().target_patient_mm is not None:
        client.withdraw_target()
    expect(page.locator("#chips")).to_contain_text("Armed")
    yield "armed"
    client.start_calibration()
    wait_for(client.state, lambda s: s.procedure == "calibration")
    expect(page.locator("#prompt-more")).to_contain_text("calibration")
    yield "calibrating"
    wait_for(client.state, lambda s: s.procedure is None, 300.0)
    measured = calibrated(client).measurement
    assert measured is not None
    assert measured.patient_mm is not None
    expect(page.locator("#pick")).to_be_enabled()
    page.locator("#pick").click()
    yield "picking"
    page.locator("#pick").click()
    x, y, z = measured.patient_mm
    client.set_entry((x + 2.0, y - 35.0, z + 6.0))
    client.set_target((x + 3.0, y, z - 2.0), label=LONG[:80])
    client.start_approach()
    expect(page.locator("#confirm")).to_be_enabled()
    yield "confirm"
    confirm_until_ready(client)
    expect(page.locator("#prompt.ready")).to_be_visible()
    yield "ready"
    page.get_by_role("button", name="Record the puncture").click()
    expect(page.locator("#depth")).to_be_visible()
    yield "depth"
    client.record_puncture(61.5)
    expect(page.locator("#prompt")).to_contain_text("Puncture recorded")
    yield "punctured"
    client.needle_out()


def confirm_until_ready(client: RoomClient) -> None:
    """Confirm each move of the approach that runs; READY at the end, motion locked."""
    for _ in range(_MOST_MOVES):
        state = wait_for(client.state, lambda s: s.question or s.ready, 120.0)
        if state.ready:
            wait_for(client.state, lambda s: s.robot.insertion_locked)
            return
        assert state.question is not None
        assert state.question.plan is not None
        asked = state.question.question_id
        client.answer(asked, "confirm", state.question.plan["plan_id"])
        wait_for(client.state, lambda s, a=asked: s.question is None or s.question.question_id != a)
    raise AssertionError("the approach does not arrive")
