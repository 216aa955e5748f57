"""Is a long case as quick as a short one: the state, the event stream, lists, report, export, plan.

Records of 100, 10,000 and 100,000 events (and up to 10,000 slices) are written as the room writes
them; the state is described as the control loop does it, ten to fifty times a second. For the way
from a slice to a plan the virtual room is run on an empty case and on the longest one, in turns.

    python benchmarks/long_case.py --quick --json
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _approaches import Cycle, FastRoom, say

from case_record.cases import Cases
from case_record.record import CaseRecord
from case_record.rows import NewSlice
from room_config.load import Config, load_config
from service.cli.export import write_export
from service.cli.report import report_page
from service.client import RoomClient
from service.room.cases.life import CaseLife
from service.room.execution import Execution
from service.room.link import PumpedClient, RoomLink
from service.room.state import RoomState
from service.room.state_view import Describer
from service.web.event_stream import _event_message
from simulator.demo.room import DemoOptions

SIZES = (100, 10_000, 100_000)
MOST_SLICES = 10_000
_ROOM = """
[room]
name = "long case"
case_dir = "case"
[service]
bridge_link = "/dev/null"
"""
_QUICK_DECISIONS, _FULL_DECISIONS = 12, 100
_REPEATS = 30


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer slices in the running room")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    options = parser.parse_args(arguments)
    found = measure(_QUICK_DECISIONS if options.quick else _FULL_DECISIONS)
    print(json.dumps(found) if options.json else "\n".join(f"{k}: {v}" for k, v in found.items()))
    return 0


def measure(decisions: int) -> dict[str, Any]:
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for size in SIZES:
            say(f"a record of {size} events")
            case_dir = folder / str(size) / "case"
            write_long_case(case_dir, size, min(size // 10, MOST_SLICES))
            for what, took_ms in _measure_record(case_dir).items():
                found.setdefault(what, {})[str(size)] = round(took_ms, 3)
        ratio = slice_to_plan_ratio(folder, folder / str(SIZES[-1]) / "case", decisions)
    return {**found, **ratio}


def write_long_case(case_dir: Path, events: int, slices: int) -> None:
    """A case in which so many slices came and were set aside, and so much else happened."""
    with CaseRecord(case_dir, create=True) as record:
        record.start_case("virtual room", seed=0)
        with record.transaction():
            for number in range(events):
                if number < slices:
                    record.add_slice(_slice(number))
                body = {"sop_instance_uid": f"1.2.3.{number}", "frames": 1, "state": "quarantined",
                        "reason_code": "wrong_orientation", "received_s": 1.0}  # fmt: skip
                record.append_event("slice_received", body, source="listener")


def _slice(number: int) -> NewSlice:
    geometry = {
        "position_mm": [0.0, 0.0, 0.0],
        "row_direction": [0.0, 0.0, -1.0],
        "col_direction": [1.0, 0.0, 0.0],
        "spacing_mm": [1.0, 1.0],
        "shape": [128, 128],
    }
    return NewSlice(
        sop_instance_uid=f"1.2.3.{number}", frame=0, sha256=f"{number:064x}",
        path=f"inbox/{number}.dcm", state="quarantined", hold_id=None,
        reason_code="wrong_orientation", reason="90 degrees from coronal", received_s=1.0,
        received_monotonic_s=1.0, acquired_from_s=None, acquired_to_s=None, time_source="",
        header={"geometry": geometry, "series_description": "localizer"},
    )  # fmt: skip


def _measure_record(case_dir: Path) -> dict[str, float]:
    config = _config(case_dir)
    target = case_dir.with_name("case.zip")
    with CaseRecord(case_dir) as record:
        middle = record.last_event_id() // 2
        return {
            "state_ms": _median_ms(_describing(config, record)),
            "order_ms": _median_ms(lambda: record.append_event("noted", {}, source="benchmark")),
            "stream_ms": _median_ms(lambda: [*map(_event_message, record.events(middle, 100))]),
            "list_ms": _median_ms(
                lambda: record.page_of_slices(after_id=0, limit=100, newest=True, state=None)
            ),
            "verify_ms": _median_ms(record.verify, 1),
            "report_ms": _median_ms(lambda: report_page(record), 1),
            "export_ms": _median_ms(lambda: write_export(record, target), 1),
        }


def _config(case_dir: Path) -> Config:
    path = case_dir.with_name("room.toml")
    path.write_text(_ROOM)
    return load_config(path, {})


def _describing(config: Config, record: CaseRecord) -> Callable[[], object]:
    link = RoomLink(PumpedClient("/dev/null", name="benchmark"), lambda text: None)
    execution = Execution(config, record, link, lambda: None)
    life = CaseLife(Cases(*config.room.folders), record, time.time())
    describer = Describer(config, record, link, life)
    state = describer.describe(execution, RoomState.initial(config))
    return lambda: describer.describe(execution, state)


def _median_ms(act: Callable[[], object], repeats: int = _REPEATS) -> float:
    took_s = []
    for _ in range(repeats):
        began_s = time.perf_counter()
        act()
        took_s.append(time.perf_counter() - began_s)
    return 1000 * float(np.median(took_s))


def slice_to_plan_ratio(folder: Path, long_case: Path, decisions: int) -> dict[str, Any]:
    """The room on a long case against the room on an empty one: medians, and their ratio."""
    medians: dict[str, list[float]] = {"short": [], "long": []}
    for turn, name in enumerate(("short", "long", "long", "short")):
        room_dir = folder / f"room-{turn}"
        if name == "long":
            shutil.copytree(long_case, room_dir)
        say(f"the room on a {name} case")
        medians[name].append(_slice_to_plan_ms(room_dir, -(-decisions // 2)))
    short_ms, long_ms = (float(np.mean(medians[name])) for name in ("short", "long"))
    return {
        "slice_to_plan_ms": {"short": round(short_ms, 1), "long": round(long_ms, 1)},
        "slice_to_plan_ratio": round(long_ms / short_ms, 3),
    }


def _slice_to_plan_ms(folder: Path, decisions: int) -> float:
    room = FastRoom(DemoOptions(folder, seed=11, speed_factor=8.0))
    try:
        room.start()
        with RoomClient(room.url, by="benchmark") as client:
            operator = Cycle(room, client)
            operator.calibrate()
            found = operator.decide(decisions)
        return float(np.median([one.total_ms for one in found]))
    finally:
        room.end()


if __name__ == "__main__":
    raise SystemExit(main())
