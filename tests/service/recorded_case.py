"""A case on disk: real slices of the virtual room, really measured, and an approach to READY."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path

import numpy as np
from virtual_slices import write_slice

from case_record.record import CaseRecord
from case_record.rows import NewSlice
from dicom_listener.slice_rows import header_for_record
from dicom_slice.header import read_header
from service.procedure.registry import APPROACH
from service.procedure.steps import HoldShift
from service.procedure.targets import TARGET_SET
from service.room.validity import READY
from simulator.config import SliceProtocol, VirtualRoom
from sr_engine.worker import measure

ROOM = VirtualRoom(protocol=SliceProtocol(shape=(96, 128)))
SHIFTS_MM = ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25))
OFFSET_MM = (0.8, -1.3)
"""Where the target lies from the fiducial, row and column."""
TOLERANCE_MM = 0.06


def make_case(folder: Path, measurements: int = 1) -> Path:
    """A case folder with so many measurements of four slices each."""
    case_dir = folder / "case"
    with CaseRecord(case_dir, create=True) as record:
        record.start_case("test room", seed=1)
        for _ in range(measurements):
            add_measurement(record)
    return case_dir


def add_measurement(record: CaseRecord) -> int:
    """Four slices at four holds, localized and reconstructed by the worker's own code."""
    holds = []
    for place, (row_mm, col_mm) in enumerate(SHIFTS_MM):
        record.end_open_hold(time.time())
        hold = record.begin_hold(
            set_id=1,
            place=place,
            setpoints_um={"xt": int(1000 * col_mm), "yt": int(1000 * row_mm)},
            readback_um={"xt": int(1000 * col_mm), "yt": int(1000 * row_mm)},
            shift_um={"xt": int(1000 * col_mm), "yt": int(1000 * row_mm)},
            shift_px=(row_mm, col_mm),
            settled_at_s=time.time(),
        )
        add_slice(record, hold.hold_id, {"xt": col_mm, "yt": row_mm})
        holds.append(HoldShift(hold.hold_id, (row_mm, col_mm)))
    return request_measurement(record, tuple(holds))


def request_measurement(record: CaseRecord, holds: tuple[HoldShift, ...]) -> int:
    """Asked for as the service does, answered as the worker does."""
    request = {
        "holds": [{"hold_id": h.hold_id, "shift_mm": list(h.shift_mm)} for h in holds],
        "expected_plane_mm": None,
        "gate_mm": None,
        "shift_sigma_mm": 0.03,
        "slice_position_mm": None,
        "radius_mm": [2.5, 6.5],
        "region_px": None,
    }
    number = record.request_measurement("ml", [h.hold_id for h in holds], request)
    measure(record, record.measurement(number), factor=2)
    done = record.measurement(number)
    assert done.state == "done", done.reason
    return number


def add_slice(record: CaseRecord, hold_id: int | None, stage_mm: dict[str, float]) -> int:
    """A slice of a hold, or (None) one that the listener has set aside for its time."""
    inbox = record.case_dir / "inbox"
    inbox.mkdir(exist_ok=True)
    number = len(list(inbox.iterdir())) + 1
    path = inbox / f"{number}.dcm"
    write_slice(path, ROOM, stage_mm, seed=number)
    (header,) = read_header(path)
    now_s = time.time()
    row = NewSlice(
        sop_instance_uid=header.sop_instance_uid,
        frame=0,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        path=str(path.relative_to(record.case_dir)),
        state="quarantined" if hold_id is None else "assigned",
        hold_id=hold_id,
        reason_code="outside_hold" if hold_id is None else "",
        reason="outside of any hold" if hold_id is None else "",
        received_s=now_s,
        received_monotonic_s=time.monotonic(),
        acquired_from_s=now_s - 1,
        acquired_to_s=now_s,
        time_source="AcquisitionDateTime",
        header=header_for_record(header),
    )
    return record.add_slice(row).slice_id


def come_to_ready(record: CaseRecord) -> int:
    """An approach during which the fiducial was measured once more, and its READY."""
    target_mm = np.array(record.measurement(1).result["plane_mm"]) + OFFSET_MM
    record.append_event(TARGET_SET, {"patient_mm": [1.0, 2.0, 3.0]}, source="service", who="tester")
    arguments = {"target_mm": target_mm.tolist(), "tolerance_mm": TOLERANCE_MM}
    procedure_id = record.begin_procedure(APPROACH, {"arguments": arguments, "target": 1})
    number = add_measurement(record)
    result = {
        "measurement_id": number,
        "error_mm": 0.0214,
        "sigma_mm": 0.0123,
        "probability": 0.9876,
        "iterations": 3,
        "frames": 9,
        "scan_s": 4.5,
    }
    record.end_procedure(procedure_id, "done", result)
    record.append_event(READY, {"procedure_id": procedure_id}, source="service")
    return procedure_id


def puncture(record: CaseRecord, procedure_id: int) -> int:
    body = {
        "procedure_id": procedure_id,
        "insertion_depth_mm": 42.5,
        "error_mm": 0.0214,
        "sigma_mm": 0.0123,
    }
    return record.append_event("puncture", body, source="service", who="Olga")
