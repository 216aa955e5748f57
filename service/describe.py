"""From the record, the link and the running procedure to the one value that a screen shows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from case_record.presence import who_is_alive
from case_record.record import CaseRecord
from case_record.rows import Measurement, SliceRow
from robot_bridge.client import BridgeStatus
from robot_bridge.phases import WorkPhase
from room_config.load import Config
from service.alarms import AlarmBook, Condition
from service.estimate import probability_within
from service.execution import Execution
from service.procedures import CALIBRATION, GUIDE_CALIBRATION, latest_calibration
from service.readiness import may_start, ready_arrival
from service.room_link import RoomLink
from service.state import (
    AcquisitionState,
    ArrivalState,
    CaseState,
    ClockState,
    ErrorState,
    FiducialState,
    HoldState,
    MeasurementState,
    ProcessState,
    QuestionState,
    ReconstructionState,
    RobotState,
    RoomState,
    SliceState,
)
from service.targets import current_entry, current_target
from sr_engine.geometry import SliceGeometry

PROCESSES = ("listener", "worker")
_BEAT_IS_OLD_S = 3.0
_LOOK_EVERY_S = 0.25
_LOOKED_BACK = 24
_SAME_SLICE_MM = 0.5


class Describer:
    """Makes the state anew when asked; keeps only what is dear to find out again."""

    def __init__(
        self,
        config: Config,
        record: CaseRecord,
        link: RoomLink,
        others_wrong: Callable[[], Sequence[Condition]] = tuple,
    ) -> None:
        self._others_wrong = others_wrong
        self._config = config
        self._record = record
        self._link = link
        self._alarms = AlarmBook()
        self._processes: list[ProcessState] = []
        self._look_at_s = 0.0
        self._around_id = 0

    def describe(self, execution: Execution, before: RoomState) -> RoomState:
        """Return the present state; the revision grows only if something else than time changed."""
        config, record, link = self._config, self._record, self._link
        case = record.case()
        running = record.running_procedure()
        ended = record.last_ended_procedure()
        last = record.last_slice()
        shown = record.last_slice("assigned") or last
        target = current_target(record)
        target_mm = list(target.patient_mm) if target else None
        arrival = ready_arrival(record)
        measurement = record.last_measurement()
        robot = _robot(link, before.robot)
        slices = record.count_slices()
        processes = self._look_at_processes()
        state = before.model_copy(
            update={
                "at_s": time.time(),
                "case_uid": case.case_uid if case else "",
                "case": _case(record),
                "procedure": running.name if running else None,
                "procedure_id": running.procedure_id if running else None,
                "last_outcome": ""
                if ended is None
                else _outcome_text(ended.name, ended.state, ended.result),
                "prompt": _prompt(config, record, link, execution, arrival is not None),
                "ready": arrival is not None,
                "arrival": None if arrival is None else _arrival(*arrival),
                "punctured": arrival is not None and _punctured(record, arrival[0]),
                "robot": robot,
                "jog_possible": may_start(record, link.status) is None,
                "acquisition_request": None
                if execution.request is None
                else AcquisitionState(**vars(execution.request)),
                "question": None
                if execution.question is None
                else QuestionState(
                    **{**vars(execution.question), "choices": list(execution.question.choices)}
                ),
                "hold": _hold(record),
                "last_slice_id": last.slice_id if last else None,
                "last_slice_received_s": last.received_s if last else None,
                "slices": slices,
                "slice": None if shown is None else _slice(shown),
                "measurement": None if measurement is None else _measurement(measurement),
                **self._around(measurement, before),
                "clock": _clock(config, record),
                "calibrated": _is_calibrated(config, record),
                "target_patient_mm": tuple(target_mm) if target_mm else None,
                "entry_patient_mm": current_entry(record),
                "error": _error(config, record, target_mm),
                "event_id": record.last_event_id(),
                "processes": processes,
            }
        )
        alarms = self._alarms.update([*_conditions(state), *self._others_wrong()], record)
        state = state.model_copy(update={"alarms": alarms})
        same = state.model_copy(update={"at_s": before.at_s}) == before
        return state.model_copy(update={"revision": before.revision + (not same)})

    def _around(self, last: Measurement | None, before: RoomState) -> dict[str, Any]:
        """What goes with the newest measurement; looked up once for each."""
        if last is None or last.measurement_id == self._around_id:
            return {}
        self._around_id = last.measurement_id
        return {
            "reconstruction": _reconstruction(self._record, before.reconstruction, last),
            "other_fiducial": _other_fiducial(self._record, last),
        }

    def _look_at_processes(self) -> list[ProcessState]:
        if time.monotonic() >= self._look_at_s:
            self._look_at_s = time.monotonic() + _LOOK_EVERY_S
            self._processes = [
                ProcessState(name=p.name, **_condition(p.seen, p.running, p.beat_age_s))
                for p in who_is_alive(self._config.room.case_dir, PROCESSES)
            ]
        return self._processes


def _condition(seen: bool, running: bool, beat_age_s: float) -> dict[str, str]:
    if not seen:
        return {"condition": "none", "detail": "has not run on this case yet"}
    if not running:
        return {"condition": "down", "detail": "has ended"}
    if beat_age_s > _BEAT_IS_OLD_S:
        return {"condition": "old", "detail": "does not get on"}
    return {"condition": "up", "detail": ""}


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


def _is_calibrated(config: Config, record: CaseRecord) -> bool:
    """As the room is used: with the guide's four axes if it has them."""
    name = CALIBRATION if config.service.guide is None else GUIDE_CALIBRATION
    return record.last_procedure(name, "done") is not None


def _case(record: CaseRecord) -> CaseState | None:
    described = record.last_event("case_described")
    return CaseState(**described.body) if described else None


def _hold(record: CaseRecord) -> HoldState | None:
    hold = record.open_hold()
    if hold is None:
        return None
    return HoldState(hold_id=hold.hold_id, set_id=hold.set_id, settled_at_s=hold.settled_at_s)


def _slice(row: SliceRow) -> SliceState | None:
    geometry = row.header.get("geometry")
    if not geometry:
        return None
    return SliceState(
        slice_id=row.slice_id,
        state=row.state,
        received_s=row.received_s,
        acquired_to_s=row.acquired_to_s,
        time_source=row.time_source,
        **geometry,
    )


def _arrival(procedure_id: int, result: dict[str, Any]) -> ArrivalState:
    known = {name: result[name] for name in ArrivalState.model_fields if name in result}
    return ArrivalState(procedure_id=procedure_id, **known)


def _punctured(record: CaseRecord, procedure_id: int) -> bool:
    puncture = record.last_event("puncture")
    return puncture is not None and puncture.body["procedure_id"] == procedure_id


def _clock(config: Config, record: CaseRecord) -> ClockState | None:
    compared = record.last_event("clock_sync")
    forgotten = record.last_event("clock_reset")
    listener = config.listener
    if forgotten is not None and (compared is None or compared.event_id < forgotten.event_id):
        return None
    if compared is not None:
        offset_s, uncertainty_s = (compared.body[k] for k in ("offset_s", "uncertainty_s"))
        return ClockState(
            offset_s=offset_s,
            uncertainty_s=uncertainty_s,
            compared_s=compared.wall_s,
            who=compared.who,
        )
    if listener.clock_offset_s is None:
        return None
    return ClockState(offset_s=listener.clock_offset_s, uncertainty_s=listener.clock_uncertainty_s)


def _other_fiducial(record: CaseRecord, last: Measurement) -> FiducialState | None:
    """The newest one found at another slice position than the newest measurement's."""
    at_mm = last.request.get("slice_position_mm")
    if at_mm is None:
        return None
    before = record.page_of_measurements(
        after_id=last.measurement_id, limit=_LOOKED_BACK, newest=True
    )
    for row in before:
        other_mm = row.request.get("slice_position_mm")
        if row.result and other_mm is not None and abs(other_mm - at_mm) > _SAME_SLICE_MM:
            return FiducialState(
                measurement_id=row.measurement_id,
                patient_mm=row.result["patient_mm"],
                radius_mm=_radius_mm(row.result),
            )
    return None


def _measurement(last: Measurement) -> MeasurementState:
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
        radius_mm=_radius_mm(found) if found else None,
        covariance_mm2=found.get("covariance_mm2"),
        patient_mm=found.get("patient_mm"),
        n_frames=found.get("n_frames", 0),
        snr=found.get("snr"),
        has_reconstruction=bool(found.get("reconstruction")),
    )


def _reconstruction(
    record: CaseRecord, before: ReconstructionState | None, last: Measurement
) -> ReconstructionState | None:
    """The newest measurement's, if it has one; else the one that was shown, or at a new start of
    the service the newest of the last ones.
    """
    rows = [last]
    if before is None:
        rows += record.page_of_measurements(
            after_id=last.measurement_id, limit=_LOOKED_BACK, newest=True
        )
    newest = next(filter(_has_reconstruction, rows), None)
    return before if newest is None else reconstruction_state(record, newest)


def _has_reconstruction(measurement: Measurement) -> bool:
    return bool((measurement.result or {}).get("reconstruction"))


def reconstruction_state(record: CaseRecord, measurement: Measurement) -> ReconstructionState:
    """Geometry of a measurement's super-resolution image; it covers what its slices cover."""
    result = measurement.result or {}
    row = record.slice(result["slice_id"])
    shape = np.load(record.case_dir / result["reconstruction"], mmap_mode="r").shape
    geometry = _geometry(row)
    factor = int(shape[0]) // geometry.shape[0]
    fine = geometry.finer_grid(factor)
    return ReconstructionState(
        measurement_id=measurement.measurement_id,
        factor=factor,
        patient_mm=result["patient_mm"],
        radius_mm=_radius_mm(result),
        **vars(fine),
    )


def _radius_mm(result: Mapping[str, Any]) -> float:
    return float(result["radius_px"]) * float(np.mean(result["plane"]["spacing_mm"]))


def _geometry(row: SliceRow) -> SliceGeometry:
    return SliceGeometry(**{k: tuple(v) for k, v in row.header["geometry"].items()})


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


def _prompt(
    config: Config, record: CaseRecord, link: RoomLink, execution: Execution, ready: bool
) -> str:
    if link.status is None:
        return f"No link to the robot: {link.problem}"
    return execution.prompt or _idle_prompt(config, record, link.status, ready)


def _idle_prompt(config: Config, record: CaseRecord, status: BridgeStatus, ready: bool) -> str:
    if ready:
        return "READY: puncture; then say when the needle is out."
    if status.phase is WorkPhase.EMERGENCY:
        return "EMERGENCY: the drives are parked. See to patient and needle; then re-arm."
    if status.stopped:
        return f"Stopped ({_plain(status.stop_reason)}). Re-arm to go on."
    if not status.armed:
        return "Arm the robot."
    if not _is_calibrated(config, record):
        return "Start the calibration."
    if current_target(record) is None:
        return "Set a target."
    if config.service.guide is not None and current_entry(record) is None:
        return "Set an entry point."
    return "Start the approach, or set another target."


def _plain(code: str) -> str:
    return code.replace("_", " ")


def _outcome_text(name: str, state: str, result: Any) -> str:
    reason = (result or {}).get("reason", "")
    return f"{name} {state}" + (f": {reason}" if reason else "")


def _conditions(state: RoomState) -> list[Condition]:
    """What is wrong now, most urgent first; each with what to do about it."""
    robot = state.robot
    found = []
    if not robot.linked:
        found.append(
            Condition(
                "no_link", "alarm", f"No link to the robot: {robot.problem}", "Check the line."
            )
        )
    if robot.linked and robot.fault:
        found.append(Condition("fault", "alarm", f"Motor fault: {robot.fault}", "See the motors."))
    if robot.linked and robot.phase == WorkPhase.EMERGENCY:
        text = f"EMERGENCY ({_plain(robot.stop_reason)}): the drives are parked"
        what = "See to patient and needle. Re-arm when it is safe, then measure again."
        found.append(Condition("emergency", "alarm", text, what))
    elif robot.linked and robot.stopped:
        text = f"The robot is stopped ({_plain(robot.stop_reason)})"
        found.append(Condition("stopped", "alarm", text, "Re-arm when it is safe."))
    if robot.linked and not robot.position_certain:
        text = "The robot's position is not certain"
        found.append(Condition("position", "warning", text, "Re-arm, then measure."))
    for process in state.processes:
        if process.condition in ("down", "old"):
            text = f"The {process.name} {process.detail}"
            found.append(
                Condition(f"{process.name}_lost", "alarm", text, f"Start the {process.name} again.")
            )
    if state.measurement is not None and state.measurement.state == "failed":
        text = f"Measurement failed: {state.measurement.reason}"
        found.append(Condition("measurement", "warning", text, "Rescan."))
    return found
