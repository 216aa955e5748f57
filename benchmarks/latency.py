"""How long from a slice to a plan, to the screen, and what viewers cost; on the virtual room.

All times come from the room itself: the record's instants (receipt of a slice, next step of the
procedure) and the browser's marks, all on one machine's wall clock. Blocks with and without viewers
take turns in the order A B B A, so that what else the machine does falls on both alike. A p99 is
worth what its number of samples is worth: that number and an interval are printed with it.

    python benchmarks/latency.py --quick --json
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _approaches import Cycle, Decision, FastRoom, say
from _page import browser_page, open_page, shown_after_ms
from _viewers import viewers
from numpy.typing import NDArray

from service.client import RoomClient
from simulator.demo.room import DemoOptions

_VIEWERS = 50
_QUICK_SLICES, _FULL_SLICES = 32, 400
_QUICK_PAIRS, _FULL_PAIRS = 2, 10
_RESAMPLED = 2000


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer slices")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--slices", type=int, help="slices a condition")
    options = parser.parse_args(arguments)
    wanted = options.slices or (_QUICK_SLICES if options.quick else _FULL_SLICES)
    found = measure(wanted, _QUICK_PAIRS if options.quick else _FULL_PAIRS)
    print(json.dumps(found) if options.json else "\n".join(f"{k}: {v}" for k, v in found.items()))
    return 0


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
    with viewers(operator.client, _VIEWERS) as crowd:
        for number in range(pairs):
            for with_viewers in (False, True, True, False):
                crowd.come_in() if with_viewers else crowd.leave()
                found = operator.decide(block)
                (crowded if with_viewers else alone).extend(found)
                cpu_s = operator.service_cpu_s()
                say(
                    f"round {number + 1}/{pairs}, {_VIEWERS if with_viewers else 0} viewers: "
                    f"{len(found)} slices, service used {cpu_s:.1f} s of processor"
                )
    return _report(alone, crowded)


def _report(alone: Sequence[Decision], crowded: Sequence[Decision]) -> dict[str, Any]:
    alone_ms = np.array([one.total_ms for one in alone])
    crowded_ms = np.array([one.total_ms for one in crowded])
    low, high = ratio_interval(alone_ms, crowded_ms, 99)
    return {
        **_percentiles("slice_to_plan_ms", alone_ms),
        **_percentiles("slice_to_plan_50_viewers_ms", crowded_ms),
        "slices_to_plan": [len(alone_ms), len(crowded_ms)],
        "viewers_p90_ratio": _round(np.percentile(crowded_ms, 90) / np.percentile(alone_ms, 90)),
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


if __name__ == "__main__":
    sys.exit(main())
