"""A virtual scanner's neighbours on loopback, for real: motor truth, service, DICOM receiver."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydicom.dataset import Dataset
from pynetdicom import AE, StoragePresentationContexts, evt

from simulator.config import VirtualRoom

Start = Callable[..., "Running"]


def wait_until(condition: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"waited {timeout_s:.0f} s in vain: {what}"
        time.sleep(0.01)


@dataclass
class Stages:
    """Stage positions over time; `go` moves on a straight line in `duration_s`."""

    port: int = 0
    times_s: list[float] = field(default_factory=lambda: [0.0])
    positions_mm: list[dict[str, float]] = field(default_factory=lambda: [{"xt": 0.0, "yt": 0.0}])

    def stand(self, **positions_mm: float) -> None:
        self.times_s[:], self.positions_mm[:] = [0.0], [positions_mm]

    def go(self, duration_s: float, **positions_mm: float) -> None:
        now = time.time()
        start = self.at(now)
        self.times_s[:] = [now, now + duration_s]
        self.positions_mm[:] = [start, positions_mm]

    def at(self, time_s: float) -> dict[str, float]:
        first, last = self.times_s[0], self.times_s[-1]
        share = 0.0 if last == first else min(max((time_s - first) / (last - first), 0.0), 1.0)
        start, end = self.positions_mm[0], self.positions_mm[-1]
        return {axis: start[axis] + share * (end[axis] - start[axis]) for axis in start}

    def answer(self, question: str) -> dict[str, Any]:
        match question.split():
            case ["where"]:
                now = time.time()
                moving = self.times_s[0] <= now < self.times_s[-1]
                return {"t": now, "positions_mm": self.at(now), "moving": moving}
            case ["history", first, last]:
                begin = max(float(first), self.times_s[0])
                end = min(float(last), self.times_s[-1])
                count = max(round((end - begin) / 0.002), 0)
                times = [begin + (end - begin) * (n + 1) / count for n in range(count)]
                samples = [[t, self.at(t)] for t in times]
                return {"start_mm": self.at(float(first)), "samples": samples}
        return {"error": f"not understood: {question}"}


@dataclass
class Page:
    """What the service's state says; a test sets `state`."""

    url: str = ""
    state: dict[str, Any] = field(default_factory=lambda: {"acquisition_request": None})
    status: int = 200
    answered: int = 0

    def wait_until_asked(self, times: int = 5) -> None:
        """Until the scanner has seen the present state, that many times."""
        wanted = self.answered + times + 1  # the first may have been under way
        wait_until(lambda: self.answered >= wanted, "the scanner asks")

    def ask_for(self, request_id: str, hold_id: int = 1, count: int = 1, **more: Any) -> None:
        request = {"request_id": request_id, "hold_id": hold_id, "count": count, **more}
        self.state = {"acquisition_request": {"slice_position_mm": None, **request}}


@dataclass
class Receiver:
    """A C-STORE SCP; `statuses` are given first, then 0x0000."""

    port: int = 0
    arrived: list[Dataset] = field(default_factory=list)
    arrived_at_s: list[float] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)

    def wait_for(self, count: int, timeout_s: float = 60.0) -> list[Dataset]:
        wait_until(lambda: len(self.arrived) >= count, f"{count} slices", timeout_s)
        return self.arrived

    def start(self, port: int = 0) -> Any:
        entity = AE(ae_title="AUTOSPINE")
        entity.supported_contexts = StoragePresentationContexts
        server = entity.start_server(
            ("127.0.0.1", port), block=False, evt_handlers=[(evt.EVT_C_STORE, self._store)]
        )
        self.port = server.server_address[1]
        return server

    def _store(self, event: evt.Event) -> int:
        if self.statuses:
            return self.statuses.pop(0)
        dataset = event.dataset
        dataset.file_meta = event.file_meta
        self.arrived.append(dataset)
        self.arrived_at_s.append(time.monotonic())
        return 0x0000


class Running:
    """A scanner in a thread; what it said, and its truth file."""

    def __init__(self, room: VirtualRoom) -> None:
        assert room.scanner is not None
        self.room = room
        self.notes: list[str] = []
        self.truth_file = Path(room.scanner.truth_file)

    def truth(self, kind: str = "acquisition") -> list[dict[str, Any]]:
        if not self.truth_file.exists():
            return []
        lines = [json.loads(line) for line in self.truth_file.read_text().splitlines()]
        return [line for line in lines if line["kind"] == kind]

    def wait_for_truth(self, count: int, kind: str = "acquisition") -> list[dict[str, Any]]:
        wait_until(lambda: len(self.truth(kind)) >= count, f"{count} of {kind} in the truth")
        return self.truth(kind)

    def wait_for_note(self, text: str) -> None:
        wait_until(lambda: any(text in note for note in self.notes), f"a note of {text}")
