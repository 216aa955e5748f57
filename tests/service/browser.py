"""The system's Chromium for tests of the page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, expect, sync_playwright

CHROMIUM = Path("/usr/bin/chromium")
AXE = Path(__file__).parent / "vendored" / "axe.min.js"
# what axe leaves out unless it is asked for is asked for: contrast of level AAA, size of controls
_LEVELS = [f"wcag{version}{level}" for version in (2, 21, 22) for level in ("a", "aa", "aaa")]
_EVERY_LEVEL = {
    "resultTypes": ["violations"],
    "runOnly": {"type": "tag", "values": [*_LEVELS, "best-practice"]},
    "rules": {"color-contrast-enhanced": {"enabled": True}, "target-size": {"enabled": True}},
}
_PATIENCE_MS = 60_000.0
_OPTIONS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@contextmanager
def running_browser() -> Iterator[Browser]:
    expect.set_options(timeout=_PATIENCE_MS)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=_OPTIONS)
        try:
            yield browser
        finally:
            browser.close()


def laid_out(page: Page) -> None:
    """Until what was changed has its place on the screen: observers of sizes act a frame later."""
    page.evaluate(
        """() => new Promise((done) => requestAnimationFrame(
            () => requestAnimationFrame(() => requestAnimationFrame(done))))"""
    )


def violations(page: Page) -> list[str]:
    """What axe finds wrong with the accessibility of what is shown now, in the theme of now."""
    # the page's own policy forbids foreign scripts, as it should: axe comes in through the debugger
    page.evaluate(AXE.read_text(encoding="utf-8") + "; null")
    found = page.evaluate(f"axe.run(document, {json.dumps(_EVERY_LEVEL)})")
    return [
        f"{v['impact']} {v['id']}: {v['nodes'][0]['html'][:120]} "
        f"{v['nodes'][0].get('failureSummary', '')[:300]}"
        for v in found["violations"]
    ]


def set_theme(page: Page, theme: str) -> None:
    page.evaluate(f"document.documentElement.dataset.theme = '{theme}'")


def correct_positions(page: Page, positions_um: Mapping[str, int]) -> None:
    """Type where the stages stand into the fields that hold what is assumed."""
    for axis, at_um in positions_um.items():
        page.locator(f"#stand-{axis}").fill(f"{at_um / 1000:.3f}")


class Complaints(list[str]):
    """What the page logged as an error; a test that ends with any has failed."""

    def watch(self, page: Page) -> None:
        page.on("pageerror", lambda error: self.append(str(error)))
        page.on("console", lambda m: self.append(m.text) if m.type == "error" else None)
