"""How long from a slice to a plan, to the screen, and what viewers cost; on the virtual room.

All times come from the room itself: the record's instants (receipt of a slice, next step of the
procedure) and the browser's marks, all on one machine's wall clock.

    python benchmarks/latency.py --quick --json
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from case_record.record import CaseRecord
from service.client import RoomClient
from simulator.demo_room import DemoOptions, DemoRoom

_CHROMIUM = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
_TARGETS_MM = ((1.2, 0.0, 0.9), (-0.8, 0.0, -1.1), (0.4, 0.0, 1.3), (-1.3, 0.0, 0.5))
_VIEWERS = 50
_MOST_CYCLES = 400


class FastRoom(DemoRoom):
    """The demo's room with a scanner that loses no time: more slices a minute."""

    def _write_config(self, ports: tuple[int, int]) -> Path:
        path = super()._write_config(ports)
        quick = "acquisition_s = 0.08\nreconstruction_s = 0.03\n\n[bridge]\nlink = "
        path.write_text(path.read_text().replace("\n[bridge]\nlink = ", quick, 1))
        return path


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer slices")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--slices", type=int, help="slices a condition")
    parser.add_argument("--viewers", nargs=2, metavar=("URL", "N"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.viewers:
        asyncio.run(view(options.viewers[0], int(options.viewers[1])))
        return 0
    wanted = options.slices or (40 if options.quick else 200)
    found = measure(wanted)
    print(json.dumps(found) if options.json else "\n".join(f"{k}: {v}" for k, v in found.items()))
    return 0


def measure(wanted: int) -> dict[str, Any]:
    """Run the room: `wanted` slices alone, with a page open, and with many viewers."""
    with tempfile.TemporaryDirectory() as folder:
        room = FastRoom(DemoOptions(Path(folder), seed=11, speed_factor=6.0))
        try:
            room.start()
            with RoomClient(room.url, by="benchmark") as client:
                return _measure(room, client, wanted)
        finally:
            room.end()


def _measure(room: FastRoom, client: RoomClient, wanted: int) -> dict[str, Any]:
    operator = Cycle(room, client)
    operator.calibrate()
    alone_ms: list[float] = []
    crowded_ms: list[float] = []
    # in turns, so that what else the machine does falls on both alike
    for _ in range(4):
        alone_ms += operator.decisions_ms(wanted // 4)
        with viewers(room.url, _VIEWERS):
            crowded_ms += operator.decisions_ms(wanted // 4)
    with browser_page() as page:
        first_paint_ms, page_bytes = open_page(page, room.url)
        from_id = max(s.slice_id for s in client.slices())
        operator.decisions_ms(max(20, wanted // 4))
        time.sleep(0.5)
        screen_ms = shown_after_ms(page, client, from_id)
    p99, with_viewers_p99 = np.percentile(alone_ms, 99), np.percentile(crowded_ms, 99)
    return {
        "slice_to_plan_ms_p50": _ms(np.median(alone_ms)),
        "slice_to_plan_ms_p99": _ms(p99),
        "slice_to_plan_50_viewers_ms_p50": _ms(np.median(crowded_ms)),
        "slice_to_plan_50_viewers_ms_p99": _ms(with_viewers_p99),
        "slices_to_plan": [len(alone_ms), len(crowded_ms)],
        "slice_to_screen_ms_p50": _ms(np.median(screen_ms)),
        "slice_to_screen_ms_p95": _ms(np.percentile(screen_ms, 95)),
        "slices_on_screen": len(screen_ms),
        "first_paint_ms": _ms(first_paint_ms),
        "page_bytes": page_bytes,
    }


def _ms(value: float) -> float:
    return round(float(value), 1)


class Cycle:
    """Approaches to nearby targets, one after the other, without a puncture."""

    def __init__(self, room: FastRoom, client: RoomClient) -> None:
        self._room = room
        self._client = client
        self._number = 0
        self._base_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def calibrate(self) -> None:
        self._until(lambda s: s.robot.linked)
        self._client.reset()
        self._client.start_calibration()
        state = self._until(lambda s: s.calibrated and s.procedure is None, 180.0)
        self._base_mm = state.measurement.patient_mm

    def decisions_ms(self, wanted: int) -> list[float]:
        """Go on until so many measurements were decided upon; ms from slice to next step."""
        first = len(decisions_ms(self._room.folder))
        for _ in range(_MOST_CYCLES):
            found = decisions_ms(self._room.folder)[first:]
            if len(found) >= wanted:
                return found
            self._approach()
        raise SystemExit(f"only {len(found)} of {wanted} slices after {_MOST_CYCLES} approaches")

    def _approach(self) -> None:
        step = _TARGETS_MM[self._number % len(_TARGETS_MM)]
        self._number += 1
        self._client.set_target([a + b for a, b in zip(self._base_mm, step, strict=True)])
        self._client.start_approach()
        self._until(lambda s: s.procedure is None and not s.robot.moving)
        state = self._client.state()
        if state.ready:
            self._until(lambda s: s.robot.insertion_locked)
            self._client.needle_out()
        elif "prediction" in state.last_outcome:
            self.calibrate()

    def _until(self, wanted: Any, patience_s: float = 90.0) -> Any:
        deadline_s = time.monotonic() + patience_s
        while not wanted(state := self._client.state()):
            if time.monotonic() > deadline_s:
                raise SystemExit(f"the room does not get on: {state.prompt}")
            time.sleep(0.02)
        return state


def decisions_ms(case_dir: Path) -> list[float]:
    """For every measurement made at once from new slices: ms from the last slice's receipt to the
    procedure's next step (a plan, a request for more slices) or its end.
    """
    found: list[float] = []
    with CaseRecord(case_dir) as record:
        for procedure in record.procedures():
            steps = record.steps(procedure.procedure_id)
            for before, step, after in zip(steps, steps[1:], [*steps[2:], None], strict=False):
                if (before.kind, step.kind) != ("Acquire", "Measure") or step.outcome is None:
                    continue
                decided_s = after.sent_s if after else procedure.ended_s
                result = record.measurement(step.outcome["measurement_id"]).result
                if decided_s is None or not result:
                    continue
                received_s = max(record.slice(i).received_s for i in result["slice_ids"])
                found.append(1000 * (decided_s - received_s))
    return found


# Viewers


@contextmanager
def viewers(url: str, count: int) -> Iterator[None]:
    """So many open event streams, read by a process of their own."""
    words = [sys.executable, __file__, "--viewers", url, str(count)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == str(count), "the viewers did not come in"
        yield
    finally:
        process.terminate()
        process.communicate()


async def view(url: str, count: int) -> None:
    host, port = url.removeprefix("http://").split(":")
    streams = [await asyncio.open_connection(host, int(port)) for _ in range(count)]
    for reader, writer in streams:
        writer.write(f"GET /api/v1/events/live HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
        assert b"200" in await reader.readline()
    print(count, flush=True)
    await asyncio.gather(*(_drain(reader) for reader, _ in streams))


async def _drain(reader: asyncio.StreamReader) -> None:
    while await reader.read(65536):
        pass


# The page


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
    page.goto(url)
    page.wait_for_selector("#phases [aria-current]")
    page.wait_for_timeout(500)
    paints = page.evaluate(
        "performance.getEntriesByType('paint').map((entry) => [entry.name, entry.startTime])"
    )
    return dict(paints)["first-contentful-paint"], sum(sizes.values())


def shown_after_ms(page: Page, client: RoomClient, from_id: int) -> list[float]:
    """ms from the receipt of each slice after `from_id` to the frame in which it was drawn."""
    marks = page.evaluate(
        """performance.getEntriesByName("slice-shown")
             .map((mark) => [mark.detail, performance.timeOrigin + mark.startTime])"""
    )
    received_s = {s.slice_id: s.received_s for s in client.slices(after=from_id)}
    return [at_ms - 1000 * received_s[i] for i, at_ms in marks if i in received_s]


if __name__ == "__main__":
    sys.exit(main())
