"""How long from a slice to a plan, to the screen, and what viewers cost; on the virtual room.

All times come from the room itself: the record's instants (receipt of a slice, next step of the
procedure) and the browser's marks, all on one machine's wall clock. Blocks with and without viewers
take turns in the order A B B A, so that what else the machine does falls on both alike. A p99 is
worth what its number of samples is worth: that number and an interval are printed with it.

    python benchmarks/latency.py --quick --json
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page, sync_playwright

from case_record.record import CaseRecord
from case_record.rows import Measurement
from service.client import RoomClient
from service.state import RoomState
from simulator.demo_room import DemoOptions, DemoRoom

_CHROMIUM = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
_TARGETS_MM = ((0.6, 0.0, 0.5), (-0.4, 0.0, -0.6), (0.2, 0.0, 0.7), (-0.7, 0.0, 0.3))
_VIEWERS = 50
_QUICK_SLICES, _FULL_SLICES = 40, 400
_QUICK_PAIRS, _FULL_PAIRS = 2, 10
_RESAMPLED = 2000
_PATIENCE_S = 300.0
_LOOK_EVERY_S = 0.02


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer slices")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--slices", type=int, help="slices a condition")
    parser.add_argument("--view", nargs=2, metavar=("URL", "N"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.view:
        asyncio.run(view(options.view[0], int(options.view[1])))
        return 0
    wanted = options.slices or (_QUICK_SLICES if options.quick else _FULL_SLICES)
    found = measure(wanted, _QUICK_PAIRS if options.quick else _FULL_PAIRS)
    print(json.dumps(found) if options.json else "\n".join(f"{k}: {v}" for k, v in found.items()))
    return 0


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class FastRoom(DemoRoom):
    """The demo's room with a scanner that loses no time: more slices a minute."""

    def _write_config(self, ports: tuple[int, int]) -> Path:
        path = super()._write_config(ports)
        quick = "acquisition_s = 0.08\nreconstruction_s = 0.03\n\n[bridge]\nlink = "
        path.write_text(path.read_text().replace("\n[bridge]\nlink = ", quick, 1))
        return path


def measure(wanted: int, pairs: int) -> dict[str, Any]:
    """Run the room: `wanted` slices alone, as many with viewers, then some with a page open."""
    with tempfile.TemporaryDirectory() as folder:
        room = FastRoom(DemoOptions(Path(folder), seed=11, speed_factor=8.0))
        try:
            say("starting the virtual room")
            room.start()
            with RoomClient(room.url, by="benchmark") as client:
                operator = Cycle(room, client)
                operator.calibrate()
                found = _with_and_without_viewers(operator, wanted, pairs)
                return {**found, **_on_screen(operator, max(20, wanted // 4))}
        finally:
            room.end()


def _with_and_without_viewers(operator: Cycle, wanted: int, pairs: int) -> dict[str, Any]:
    alone: list[Decision] = []
    crowded: list[Decision] = []
    block = -(-wanted // (2 * pairs))
    with Viewers(operator.client) as viewers:
        for number in range(pairs):
            for with_viewers in (False, True, True, False):
                viewers.come_in() if with_viewers else viewers.leave()
                found = operator.decide(block)
                (crowded if with_viewers else alone).extend(found)
                cpu_s = operator.service_cpu_s()
                say(
                    f"round {number + 1}/{pairs}, {_VIEWERS if with_viewers else 0} viewers: "
                    f"{len(found)} slices, service used {cpu_s:.1f} s of processor"
                )
    alone_ms = np.array([one.total_ms for one in alone])
    crowded_ms = np.array([one.total_ms for one in crowded])
    low, high = ratio_interval(alone_ms, crowded_ms, 99)
    return {
        **_percentiles("slice_to_plan_ms", alone_ms),
        **_percentiles("slice_to_plan_50_viewers_ms", crowded_ms),
        "slices_to_plan": [len(alone_ms), len(crowded_ms)],
        "viewers_p99_ratio": _round(np.percentile(crowded_ms, 99) / np.percentile(alone_ms, 99)),
        "viewers_p99_ratio_90_percent_interval": [_round(low), _round(high)],
        "path_ms_p50": _parts(alone, 50),
        "path_ms_p99": _parts(alone, 99),
    }


def _percentiles(name: str, values_ms: NDArray[np.float64]) -> dict[str, float]:
    return {f"{name}_p{at}": _round(np.percentile(values_ms, at)) for at in (50, 90, 99)}


def _parts(decisions: Sequence[Decision], at: float) -> dict[str, float]:
    return {
        name: _round(np.percentile([one.parts_ms[name] for one in decisions], at))
        for name in decisions[0].parts_ms
    }


def _on_screen(operator: Cycle, wanted: int) -> dict[str, Any]:
    client = operator.client
    with browser_page() as page:
        say(f"the page: {wanted} slices")
        first_paint_ms, page_bytes = open_page(page, client.url)
        from_id = max(s.slice_id for s in client.slices(newest=True, limit=1))
        operator.decide(wanted)
        screen_ms = shown_after_ms(page, client, from_id)
    return {
        "slice_to_screen_ms_p50": _round(np.median(screen_ms)),
        "slice_to_screen_ms_p95": _round(np.percentile(screen_ms, 95)),
        "slices_on_screen": len(screen_ms),
        "first_paint_ms": _round(first_paint_ms),
        "page_bytes": page_bytes,
    }


def _round(value: float) -> float:
    return round(float(value), 2)


def ratio_interval(
    first: NDArray[np.float64], second: NDArray[np.float64], percentile: float
) -> tuple[float, float]:
    """90 % interval of the ratio second/first of a percentile, by resampling both."""
    rng = np.random.default_rng(0)
    ratios = [
        np.percentile(rng.choice(second, len(second)), percentile)
        / np.percentile(rng.choice(first, len(first)), percentile)
        for _ in range(_RESAMPLED)
    ]
    low, high = np.percentile(ratios, (5, 95))
    return float(low), float(high)


# Approaches, one after the other


class Cycle:
    """Approaches to nearby targets, one after the other, without a puncture."""

    def __init__(self, room: FastRoom, client: RoomClient) -> None:
        self._room = room
        self.client = client
        self._number = 0
        self._base_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._after_id = 0

    def calibrate(self) -> None:
        say("calibrating")
        self._until(lambda s: s.robot.linked)
        self.client.reset()
        self.client.start_calibration()
        state = self._until(lambda s: s.calibrated and s.procedure is None)
        assert state.measurement is not None
        assert state.measurement.patient_mm is not None
        self._base_mm = state.measurement.patient_mm
        self._after_id = len(self._procedures())

    def decide(self, wanted: int) -> list[Decision]:
        """Go on until so many measurements were decided upon; what each of them took."""
        found: list[Decision] = []
        deadline_s = time.monotonic() + _PATIENCE_S + 10.0 * wanted
        while len(found) < wanted:
            if time.monotonic() > deadline_s:
                raise SystemExit(f"only {len(found)} of {wanted} slices: {self.client.state()}")
            self._approach()
            found += decisions(self._room.folder, self._after_id)
            self._after_id = len(self._procedures())
        return found

    def service_cpu_s(self) -> float:
        """Processor time of the service's process since its start."""
        process = self._room.family.children["service"].process
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _procedures(self) -> Sequence[Any]:
        with CaseRecord(self._room.folder) as record:
            return record.procedures()

    def _approach(self) -> None:
        step = _TARGETS_MM[self._number % len(_TARGETS_MM)]
        self._number += 1
        self.client.set_target([a + b for a, b in zip(self._base_mm, step, strict=True)])
        self.client.start_approach()
        state = self._until(lambda s: s.procedure is None and not s.robot.moving)
        if state.ready:
            self._until(lambda s: s.robot.insertion_locked)
            self.client.needle_out()
            self._until(lambda s: not s.robot.insertion_locked)
        elif "prediction" in state.last_outcome:
            self.calibrate()

    def _until(self, wanted: Callable[[RoomState], object]) -> RoomState:
        deadline_s = time.monotonic() + _PATIENCE_S
        while not wanted(state := self.client.state()):
            if time.monotonic() > deadline_s:
                raise SystemExit(f"the room does not get on: {state.prompt}")
            time.sleep(_LOOK_EVERY_S)
        return state


@dataclass(frozen=True)
class Decision:
    """What one measurement made at once from new slices took, in ms, and in which part."""

    total_ms: float
    parts_ms: dict[str, float]


def decisions(case_dir: Path, after_id: int) -> list[Decision]:
    """Of the procedures after an id: from the last slice's receipt to the procedure's next step
    (a plan, a request for more slices) or its end.
    """
    with CaseRecord(case_dir) as record:
        return [
            one
            for procedure in record.procedures()
            if procedure.procedure_id > after_id
            for one in _decisions_of(record, procedure.procedure_id, procedure.ended_s)
        ]


def _decisions_of(
    record: CaseRecord, procedure_id: int, ended_s: float | None
) -> Iterator[Decision]:
    steps = record.steps(procedure_id)
    for before, step, after in zip(steps, steps[1:], [*steps[2:], None], strict=False):
        if (before.kind, step.kind) != ("Acquire", "Measure") or step.outcome is None:
            continue
        measured = record.measurement(step.outcome["measurement_id"])
        decided_s = after.sent_s if after else ended_s
        if measured.result and decided_s and before.ended_s and measured.finished_s:
            yield _decision(record, measured, before.ended_s, decided_s)


def _decision(
    record: CaseRecord, measured: Measurement, seen_s: float, decided_s: float
) -> Decision:
    assert measured.result is not None
    assert measured.finished_s is not None
    received_s = max(record.slice(i).received_s for i in measured.result["slice_ids"])
    return Decision(
        1000 * (decided_s - received_s),
        {
            "listener_until_service_saw": 1000 * (seen_s - received_s),
            "service_until_requested": 1000 * (measured.requested_s - seen_s),
            "worker": 1000 * (measured.finished_s - measured.requested_s),
            "service_until_decided": 1000 * (decided_s - measured.finished_s),
        },
    )


# Viewers


class Viewers:
    """Open event streams, read by a process of their own; they come in and leave when told to."""

    def __init__(self, client: RoomClient) -> None:
        self._client = client
        self._words = [sys.executable, __file__, "--view", client.url, str(_VIEWERS)]

    def __enter__(self) -> Viewers:
        self._process = subprocess.Popen(
            self._words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._process.terminate()
        self._process.communicate()

    def come_in(self) -> None:
        self._tell("in", _VIEWERS)

    def leave(self) -> None:
        self._tell("out", 0)

    def _tell(self, word: str, wanted: int) -> None:
        """Returns when the service itself counts as many open streams as are wanted."""
        assert self._process.stdin is not None
        self._process.stdin.write(word + "\n")
        deadline_s = time.monotonic() + _PATIENCE_S
        while self._client.metric("autospine_viewers") != wanted:
            if time.monotonic() > deadline_s:
                raise SystemExit(f"{wanted} viewers did not come about")
            time.sleep(_LOOK_EVERY_S)


async def view(url: str, count: int) -> None:
    """Obey the words `in` and `out` on standard input."""
    host, port = url.removeprefix("http://").split(":")
    readers: list[asyncio.Task[None]] = []
    while word := (await asyncio.to_thread(sys.stdin.readline)).strip():
        if word == "in" and not readers:
            readers = [asyncio.create_task(_read(host, int(port))) for _ in range(count)]
        elif word == "out":
            for reader in readers:
                reader.cancel()
            readers = []


async def _read(host: str, port: int) -> None:
    reader, writer = await asyncio.open_connection(host, port)
    try:
        words = f"GET /api/v1/events/live HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n"
        writer.write(words.encode())
        while await reader.read(65536):
            pass
    finally:
        writer.close()


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
    page.goto(url, wait_until="load")
    page.wait_for_function("performance.getEntriesByName('slice-shown').length > 0")
    paints = page.evaluate(
        "performance.getEntriesByType('paint').map((entry) => [entry.name, entry.startTime])"
    )
    return dict(paints)["first-contentful-paint"], sum(sizes.values())


def shown_after_ms(page: Page, client: RoomClient, from_id: int) -> list[float]:
    """ms from the receipt of each slice after `from_id` to the frame in which it was drawn."""
    shown = client.state().slice
    assert shown is not None
    page.wait_for_function(
        "(id) => performance.getEntriesByName('slice-shown').some((mark) => mark.detail >= id)",
        arg=shown.slice_id,
    )
    marks = page.evaluate(
        """performance.getEntriesByName("slice-shown")
             .map((mark) => [mark.detail, performance.timeOrigin + mark.startTime])"""
    )
    received_s = {s.slice_id: s.received_s for s in client.slices(after=from_id)}
    return [at_ms - 1000 * received_s[i] for i, at_ms in marks if i in received_s]


if __name__ == "__main__":
    sys.exit(main())
