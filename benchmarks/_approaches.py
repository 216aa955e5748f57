"""Approaches on the virtual room, one after the other, and how long each decision took."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Measurement
from service.client import RoomClient, ServiceGoneError
from service.room.state import RoomState
from simulator.demo.room import DemoRoom

_TARGETS_MM = ((0.6, 0.0, 0.5), (-0.4, 0.0, -0.6), (0.2, 0.0, 0.7), (-0.7, 0.0, 0.3))
_PATIENCE_S = 300.0
_LOOK_EVERY_S = 0.02


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class FastRoom(DemoRoom):
    """The demo's room with a scanner that loses no time: more slices a minute."""

    def _write_config(self, ports: tuple[int, int]) -> Path:
        path = super()._write_config(ports)
        quick = "acquisition_s = 0.08\nreconstruction_s = 0.03\n\n[bridge]\nlink = "
        path.write_text(path.read_text().replace("\n[bridge]\nlink = ", quick, 1))
        return path


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
        self.client.reset(self.client.state().robot.taken_um)
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
        while True:
            with contextlib.suppress(ServiceGoneError):  # for a moment it does not know
                state = self.client.state()
                if wanted(state):
                    return state
            if time.monotonic() > deadline_s:
                raise SystemExit("the room does not get on")
            time.sleep(_LOOK_EVERY_S)


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
