"""The offline room with a case record: real DICOM files, the real worker, replayable afterwards.

Its clock is its own: it starts at a given instant and goes on by what moves and slices take.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Case, NewSlice
from dicom_listener.slice_rows import header_for_record
from dicom_slice.header import read_header
from robot_bridge.protocol.messages import CommandState
from service.procedure.registry import build_procedure, result_to_json
from service.procedure.runner import run_procedure
from service.procedure.steps import (
    Acquire,
    Acquired,
    Measure,
    Measured,
    Moved,
    MoveTo,
    Outcome,
    Step,
)
from service.room.measuring import measure_request, measured_from_result
from simulator.config import ScannerSettings
from simulator.dicom_writer import AcquisitionStamp, Series, Study, write_mr_image
from simulator.stage_physics import StageParameters
from sr_engine.request import is_at_position
from sr_engine.worker import Known, measure
from studies.offline_room import MrImaging, OfflineRoom

_MOVE_S, _SLICE_S = 1.0, 0.5
_INBOX = "inbox"


class RecordedRoom(OfflineRoom):
    """Carries out steps as `OfflineRoom`; whatever happens is in `record`."""

    def __init__(
        self,
        record: CaseRecord,
        imaging: MrImaging,
        stages: StageParameters,
        seed: int,
        *,
        start_s: float = 1_700_000_000.0,
        **options: Any,
    ) -> None:
        super().__init__(imaging, stages, seed, **options)
        self.record = record
        self.case: Case = record.start_case("recorded", seed)
        self.clock_s = start_s
        self._protocol = imaging.room.protocol
        self._scanner = ScannerSettings(
            service_url="http://127.0.0.1:1",  # not used: nothing is sent
            listener_port=1,
            motors_truth_port=1,
            truth_file="none",
        )
        self._known = Known()
        self._study = Study.new(start_s)
        self._series = Series.new(1, "recorded", ("M", "ND"), start_s)
        (record.case_dir / _INBOX).mkdir(exist_ok=True)
        self._begin_hold(None, dict(self.setpoints_um))

    def run_recorded(self, name: str, arguments: Mapping[str, Any]) -> Any:
        """Run a procedure as the service does; its failure is recorded and raised."""
        number = self.record.begin_procedure(name, dict(arguments))
        running = self.record.running_procedure()
        assert running is not None
        try:
            result = run_procedure(
                self.record, number, build_procedure(running), self.execute, self.case.case_uid
            )
        except Exception as error:
            self.record.end_procedure(number, "failed", {"reason": str(error)})
            raise
        self.record.end_procedure(number, "done", result_to_json(result))
        return result

    def execute(self, step: Step, command_id: str = "") -> Outcome:
        self._command_id = command_id
        return super().execute(step, command_id)

    def _move(self, step: MoveTo) -> Moved:
        self.record.end_open_hold(self.clock_s)
        self.record.send_move(
            self._command_id,
            setpoints_um=step.setpoints_um,
            measurement_id=step.rests_on,
            purpose=step.purpose,
        )
        moved = super()._move(step)
        self.clock_s += _MOVE_S
        self.record.end_move(
            self._command_id,
            CommandState(moved.state),
            moved.code,
            moved.text,
            moved.readback_um,
        )
        hold_id = self._begin_hold(step, dict(moved.readback_um))
        return Moved(moved.state, moved.code, moved.text, hold_id, moved.readback_um)

    def _begin_hold(self, step: MoveTo | None, readback_um: dict[str, int]) -> int:
        next_set = self.record.next_set_id()
        in_set = step is not None and not step.new_set
        hold = self.record.begin_hold(
            set_id=next_set - 1 if in_set else next_set,
            place=step.place if step else 0,
            setpoints_um=step.setpoints_um if step else readback_um,
            readback_um=readback_um,
            shift_um=step.shift_um if step else {},
            shift_px=step.shift_px if step else (0.0, 0.0),
            settled_at_s=self.clock_s,
        )
        return hold.hold_id

    def _acquire(self, step: Acquire) -> Acquired:
        if step.fresh:
            self.record.end_open_hold(self.clock_s)
            self._begin_hold(None, dict(self.setpoints_um))
        hold = self.record.open_hold()
        assert hold is not None
        self.record.expect_slices(hold.hold_id, step.count)
        position_mm = step.slice_position_mm
        while self._count_at(hold.hold_id, position_mm) < step.count:
            self._receive(hold.hold_id, position_mm)
        return Acquired(hold.hold_id, step.count)

    def _count_at(self, hold_id: int, position_mm: float | None) -> int:
        rows = self.record.slices(hold_id=hold_id)
        return sum(is_at_position(row, position_mm) for row in rows)

    def _receive(self, hold_id: int, slice_position_mm: float | None) -> None:
        pixels, geometry = self.imaging.look(self.stage_mm, self._rng, slice_position_mm)
        self.frames += 1
        stamp = AcquisitionStamp(
            self.clock_s, _SLICE_S, self.frames, 1, self.clock_s + 2 * _SLICE_S
        )
        dataset = write_mr_image(
            pixels,
            geometry,
            protocol=self._protocol,
            scanner=self._scanner,
            study=self._study,
            series=self._series,
            stamp=stamp,
        )
        path = self.record.case_dir / _INBOX / f"{self.frames:04d}.dcm"
        dataset.save_as(path, enforce_file_format=True)
        begin_s, self.clock_s = self.clock_s, self.clock_s + _SLICE_S
        self.record.add_slice(self._new_slice(path, hold_id, begin_s))

    def _new_slice(self, path: Path, hold_id: int, begin_s: float) -> NewSlice:
        header = read_header(path)[0]
        return NewSlice(
            sop_instance_uid=header.sop_instance_uid,
            frame=0,
            sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
            path=path.relative_to(self.record.case_dir).as_posix(),
            state="assigned",
            hold_id=hold_id,
            reason_code="",
            reason="",
            received_s=self.clock_s,
            received_monotonic_s=self.clock_s,
            acquired_from_s=begin_s,
            acquired_to_s=self.clock_s,
            time_source="AcquisitionDateTime",
            header=header_for_record(header),
        )

    def _measure(self, step: Measure) -> Measured:
        request = measure_request(step, self._radius_mm, self._region_px)
        hold_ids = [hold.hold_id for hold in step.holds]
        number = self.record.request_measurement(step.method, hold_ids, request)
        measure(self.record, self.record.measurement(number), 2, self._known)
        done = self.record.measurement(number)
        if done.result is None:
            return Measured(number, done.reason_code, done.reason)
        return measured_from_result(number, done.result)
