"""What the room is doing now, in one value: the page and the virtual scanner read it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from case_record.record import CaseRecord
from room_config.load import Config
from service.commands import ready_arrival
from service.estimate import probability_within
from service.execution import Execution
from service.procedures import latest_calibration
from service.room_link import RoomLink


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True)


class RobotState(_Frozen):
    """The bridge as it last said it was; `linked` False: what follows is old."""

    linked: bool = False
    problem: str = "not connected yet"
    phase: str = "START_UP"
    armed: bool = False
    stopped: bool = False
    stop_reason: str = ""
    insertion_locked: bool = False
    moving: bool = False
    position_certain: bool = False
    positions_um: dict[str, int] = {}
    travel_um: dict[str, tuple[int, int]] = {}
    fault: str | None = None
    boot_id: str = ""


class AcquisitionState(_Frozen):
    """What the scanner operator is asked to acquire now."""

    request_id: str
    hold_id: int
    count: int


class QuestionState(_Frozen):
    question_id: str
    question: str
    choices: list[str]
    plan: dict[str, Any] | None


class MeasurementState(_Frozen):
    """The newest finished measurement: positions in the slice and in the patient."""

    measurement_id: int
    method: str
    state: str
    finished_s: float | None
    reason: str = ""
    slice_id: int | None = None
    centre_px: tuple[float, float] | None = None
    sigma_px: tuple[float, float] | None = None
    radius_px: float | None = None
    patient_mm: tuple[float, float, float] | None = None
    n_frames: int = 0
    snr: float | None = None
    has_reconstruction: bool = False


class ErrorState(_Frozen):
    """How far the fiducial is from the target, in the image plane (row, col) mm."""

    row_mm: float
    col_mm: float
    error_mm: float
    sigma_mm: float
    probability_within_tolerance: float
    target_px: tuple[float, float] | None = None


class ArrivalState(_Frozen):
    """READY: how the needle guide came to the target, and how sure that is."""

    procedure_id: int
    measurement_id: int
    error_mm: float
    sigma_mm: float
    probability: float
    iterations: int
    frames: int
    scan_s: float


class RoomState(_Frozen):
    """Everything that a screen needs to show what is going on."""

    revision: int
    at_s: float
    room: str
    virtual: bool
    case_uid: str = ""
    procedure: str | None = None
    procedure_id: int | None = None
    last_outcome: str = ""
    prompt: str = ""
    ready: bool = False
    arrival: ArrivalState | None = None
    robot: RobotState = RobotState()
    acquisition_request: AcquisitionState | None = None
    question: QuestionState | None = None
    last_slice_id: int | None = None
    last_slice_received_s: float | None = None
    slices: dict[str, int] = {}
    measurement: MeasurementState | None = None
    calibrated: bool = False
    target_patient_mm: tuple[float, float, float] | None = None
    error: ErrorState | None = None
    tolerance_mm: float
    event_id: int = 0

    @classmethod
    def initial(cls, config: Config) -> RoomState:
        return cls(
            revision=0,
            at_s=time.time(),
            room=config.room.name,
            virtual=config.room.virtual,
            tolerance_mm=config.service.tolerance_mm,
        )


def describe(
    config: Config, record: CaseRecord, link: RoomLink, execution: Execution, before: RoomState
) -> RoomState:
    """Return the present state; the revision grows only if something else than time changed."""
    case = record.case()
    running = record.running_procedure()
    ended = next((p for p in reversed(record.procedures()) if p.state != "running"), None)
    last = record.last_slice()
    target = record.last_event("target_set")
    arrival = ready_arrival(record)
    ready = arrival is not None
    measurement = _measurement(record)
    state = RoomState(
        revision=before.revision,
        at_s=time.time(),
        room=config.room.name,
        virtual=config.room.virtual,
        case_uid=case.case_uid if case else "",
        procedure=running.name if running else None,
        procedure_id=running.procedure_id if running else None,
        last_outcome="" if ended is None else _outcome_text(ended.name, ended.state, ended.result),
        prompt=execution.prompt or _idle_prompt(record, link, ready),
        ready=ready,
        arrival=None if arrival is None else _arrival(*arrival),
        robot=_robot(link, before.robot),
        acquisition_request=None
        if execution.request is None
        else AcquisitionState(**vars(execution.request)),
        question=None
        if execution.question is None
        else QuestionState(
            **{**vars(execution.question), "choices": list(execution.question.choices)}
        ),
        last_slice_id=last.slice_id if last else None,
        last_slice_received_s=last.received_s if last else None,
        slices=record.count_slices(),
        measurement=measurement,
        calibrated=record.last_procedure("calibration", "done") is not None,
        target_patient_mm=tuple(target.body["patient_mm"]) if target else None,
        error=_error(config, record, target.body["patient_mm"] if target else None),
        tolerance_mm=config.service.tolerance_mm,
        event_id=record.last_event_id(),
    )
    same = state.model_copy(update={"at_s": before.at_s}) == before
    return state.model_copy(update={"revision": before.revision + (not same)})


def _robot(link: RoomLink, before: RobotState) -> RobotState:
    status = link.status
    if status is None:
        return before.model_copy(update={"linked": False, "problem": link.problem})
    return RobotState(
        linked=True,
        problem="",
        phase=str(status.phase),
        armed=status.armed,
        stopped=status.stopped,
        stop_reason=status.stop_reason,
        insertion_locked=status.insertion_locked,
        moving=status.moving,
        position_certain=status.position_certain,
        positions_um=dict(status.positions_um),
        travel_um=link.travel_um,
        fault=status.fault,
        boot_id=status.boot_id,
    )


def _arrival(procedure_id: int, result: dict[str, Any]) -> ArrivalState:
    names = set(ArrivalState.model_fields) - {"procedure_id"}
    return ArrivalState(procedure_id=procedure_id, **{name: result[name] for name in names})


def _measurement(record: CaseRecord) -> MeasurementState | None:
    last = record.last_measurement()
    if last is None:
        return None
    found = last.result or {}
    return MeasurementState(
        measurement_id=last.measurement_id,
        method=last.method,
        state=last.state,
        finished_s=last.finished_s,
        reason=last.reason,
        slice_id=found.get("slice_id"),
        centre_px=found.get("centre_px"),
        sigma_px=found.get("sigma_px"),
        radius_px=found.get("radius_px"),
        patient_mm=found.get("patient_mm"),
        n_frames=found.get("n_frames", 0),
        snr=found.get("snr"),
        has_reconstruction=bool(found.get("reconstruction")),
    )


def _error(config: Config, record: CaseRecord, target_mm: list[float] | None) -> ErrorState | None:
    """The error by the newest measurement alone (the procedure also knows the moves before)."""
    last = record.last_measurement(state="done")
    calibration = latest_calibration(record)
    if last is None or last.result is None or target_mm is None or calibration is None:
        return None
    offset = calibration.plane.from_patient(target_mm) - np.array(last.result["plane_mm"])
    covariance = np.array(last.result["covariance_mm2"])
    spacing = np.array(calibration.plane.spacing_mm)
    target_px = np.array(last.result["centre_px"]) + offset / spacing
    return ErrorState(
        row_mm=float(offset[0]),
        col_mm=float(offset[1]),
        error_mm=float(np.linalg.norm(offset)),
        sigma_mm=float(np.sqrt(np.trace(covariance) / 2)),
        probability_within_tolerance=probability_within(
            offset, covariance, config.service.tolerance_mm
        ),
        target_px=(float(target_px[0]), float(target_px[1])),
    )


def _idle_prompt(record: CaseRecord, link: RoomLink, ready: bool) -> str:
    status = link.status
    if status is None:
        return f"No link to the robot: {link.problem}"
    if ready:
        return "READY: puncture; then say when the needle is out."
    if status.stopped:
        return f"Stopped ({status.stop_reason}). Re-arm to go on."
    if not status.armed:
        return "Arm the robot."
    if record.last_procedure("calibration", "done") is None:
        return "Start the calibration."
    if record.last_event("target_set") is None:
        return "Set a target."
    return "Start the approach, or set another target."


def _outcome_text(name: str, state: str, result: Any) -> str:
    reason = (result or {}).get("reason", "")
    return f"{name} {state}" + (f": {reason}" if reason else "")
