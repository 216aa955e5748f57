"""The operator's page in a real browser, and when it has drawn a slice."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Page, sync_playwright

from service.client import RoomClient

_CHROMIUM = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
_PATIENCE_S = 300.0
_PAGE_LOOK_MS = 50


@contextmanager
def browser_page() -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=_CHROMIUM)
        try:
            yield browser.new_page(viewport={"width": 1280, "height": 800})
        finally:
            browser.close()


def open_page(page: Page, url: str) -> tuple[float, int]:
    """Return ms to the first paint, and the bytes of page, scripts and styles."""
    sizes: dict[str, int] = {}

    def note(answer: Any) -> None:
        if "/page/" in answer.url or answer.url.rstrip("/") == url:
            sizes[answer.url] = len(answer.body())

    page.on("response", note)
    page.goto(url, wait_until="load")
    wait_until_shown(page, 0)
    paints = page.evaluate(
        "performance.getEntriesByType('paint').map((entry) => [entry.name, entry.startTime])"
    )
    return dict(paints)["first-contentful-paint"], sum(sizes.values())


def wait_until_shown(page: Page, slice_id: int) -> None:
    """Until this slice, or a newer one, was drawn (the page's policy forbids waiting inside it)."""
    deadline_s = time.monotonic() + _PATIENCE_S
    while not page.evaluate(
        "(id) => performance.getEntriesByName('slice-shown').some((mark) => mark.detail >= id)",
        slice_id,
    ):
        if time.monotonic() > deadline_s:
            raise SystemExit(f"slice {slice_id} was not drawn")
        page.wait_for_timeout(_PAGE_LOOK_MS)


def shown_after_ms(page: Page, client: RoomClient, from_id: int) -> list[float]:
    """ms from the receipt of each slice after `from_id` to the frame in which it was drawn."""
    shown = client.state().slice
    assert shown is not None
    wait_until_shown(page, shown.slice_id)
    marks = page.evaluate(
        """performance.getEntriesByName("slice-shown")
             .map((mark) => [mark.detail, performance.timeOrigin + mark.startTime])"""
    )
    received_s = {s.slice_id: s.received_s for s in client.slices(after=from_id)}
    return [at_ms - 1000 * received_s[i] for i, at_ms in marks if i in received_s]
