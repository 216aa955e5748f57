"""From the record, the link and the running procedure to the one value that a screen shows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from case_record.presence import who_is_alive
from case_record.record import CaseRecord
from case_record.rows import Measurement, Procedure, SliceRow
from room_config.load import Config
from service.procedure.arguments import calibration_origin_um
from service.procedure.plan import Travel
from service.procedure.targets import (
    Target,
    TargetError,
    current_entry,
    current_target,
    why_void_target,
)
from service.room.alarm_list import AlarmBook, Condition
from service.room.belief.describe import describe_belief
from service.room.belief.goal import effective, goal_tolerance_mm
from service.room.belief.state import BeliefState
from service.room.cases.held import HeldSlices, arriving
from service.room.cases.life import QUESTION, CaseLife
from service.room.conditions import HANGS, conditions, disk_refuses
from service.room.context import now_of
from service.room.execution import Execution
from service.room.history import arrival_by_hand, rests_on_slices
from service.room.link import RoomLink
from service.room.measurement_view import (
    describe_error,
    describe_measurement,
    describe_other_fiducial,
    describe_reconstruction,
)
from service.room.motion_allowed import may_start
from service.room.prompt import is_calibrated, is_punctured, next_action, outcome_text, prompt
from service.room.proposals import ProposalBook
from service.room.robot.whereabouts import source_of, taken_to_stand
from service.room.scanner_clock import clock_update, clock_was_set
from service.room.state import (
    AcquisitionState,
    ArrivalState,
    CaseState,
    DriveState,
    FiducialState,
    HoldState,
    LostState,
    MeasurementState,
    ProcessState,
    QuestionState,
    RobotState,
    RoomState,
    SliceState,
)
from service.room.validity import RESTS_ON, Now, Readiness, age_s, readiness, why_not_now

PROCESSES = ("listener", "worker")
_BEAT_IS_OLD_S = 1.0
_BEAT_IS_LOST_S = 3.0
_LOOK_EVERY_S = 0.25


class Describer:
    """Makes the state anew when asked; keeps only what is dear to find out again."""

    def __init__(
        self,
        config: Config,
        record: CaseRecord,
        link: RoomLink,
        life: CaseLife,
        others_wrong: Callable[[], Sequence[Condition]] = tuple,
    ) -> None:
        self._others_wrong = others_wrong
        self._config = config
        self._life = life
        self._held = HeldSlices(life.cases)
        self._look = ProcessLook(life.cases.home)
        self._record = record
        self._link = link
        self._alarms = AlarmBook()
        self._proposals = ProposalBook()
        self._around_id = 0
        self._believed_at = self._counted_at = (-1, -1)
        self._counted: dict[str, int] = {}

    def describe(self, execution: Execution, before: RoomState) -> RoomState:
        """Return the present state; the revision grows only if something else than time changed."""
        config, record, link = self._config, self._record, self._link
        settings = effective(config, record)
        case = record.case()
        target = current_target(record)
        void = why_void_target(record, target) if target else ""
        target_mm = list(target.patient_mm) if target and not void else None
        measurement = record.last_measurement()
        now = now_of(config, link)
        found = readiness(record, now)
        arrival = _arrival(record, found, now)
        state = before.model_copy(
            update={
                "at_s": time.time(),
                "case_uid": case.case_uid if case else "",
                "case_folder": record.case_dir.name,
                "case_question": QUESTION if self._life.asks else "",
                "holding": self._held.look(record),
                "case": _case(record),
                **_procedures(record, execution),
                "prompt": QUESTION
                if self._life.asks
                else prompt(config, record, link, execution, found) + _marked(arrival),
                "ready": arrival is not None,
                "ready_lost": _lost_ready(found),
                "next_action": next_action(config, record, link, execution, found),
                "calibration_drives": _drives(config, link),
                "arrival": arrival,
                "punctured": found is not None and is_punctured(record, found.procedure_id),
                "robot": describe_robot(link, before.robot),
                "jog_possible": may_start(record, now) is None,
                "hold": _hold(record),
                **_slices(record, self._counts()),
                "measurement": _measurement(record, measurement, now),
                **self._around(measurement, before),
                **clock_update(config, record, time.time()),
                "calibrated": is_calibrated(config, record),
                "target_patient_mm": tuple(target_mm) if target_mm else None,
                "entry_patient_mm": current_entry(record),
                "target_lost": LostState(code="target_void", text=void) if void else None,
                **_error(settings, record, None if void else target, void, now),
                "event_id": record.last_event_id(),
                "processes": self._look.processes(),
                "proposals": self._proposals.update(record),
                "tolerance_mm": goal_tolerance_mm(settings),
                "belief": self._believed(before),
            }
        )
        other = _other(record, state.other_fiducial, now)
        state = state.model_copy(update={"other_fiducial": other})
        wrong = [*conditions(state), *clock_was_set(config, record), *arriving(record)]
        wrong += disk_refuses(record.case_dir, config.listener.min_free_mib)
        wrong += self._others_wrong()
        alarms = self._alarms.update(wrong, record)
        state = state.model_copy(update={"alarms": alarms})
        same = _timeless(state) == _timeless(before)
        return state.model_copy(update={"revision": before.revision + (not same)})

    def _around(self, last: Measurement | None, before: RoomState) -> dict[str, Any]:
        """What goes with the newest measurement; looked up once for each."""
        if last is None or last.measurement_id == self._around_id:
            return {}
        self._around_id = last.measurement_id
        return {
            "reconstruction": describe_reconstruction(self._record, before.reconstruction, last),
            "other_fiducial": describe_other_fiducial(self._record, last),
        }

    def _counts(self) -> dict[str, int]:
        """Slices by state; counted anew when the record has changed: there may be thousands."""
        changes = self._record.change_count()
        if changes != self._counted_at:
            self._counted_at, self._counted = changes, self._record.count_slices()
        return self._counted

    def _believed(self, before: RoomState) -> BeliefState:
        """What the system believes; worked out anew when the record has changed."""
        changes = self._record.change_count()
        if before.belief is not None and changes == self._believed_at:
            return before.belief
        self._believed_at = changes
        return describe_belief(self._config, self._record)


class ProcessLook:
    """How the other processes of the room do; looked at now and then."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._processes: list[ProcessState] = []
        self._look_at_s = 0.0

    def processes(self) -> list[ProcessState]:
        if time.monotonic() >= self._look_at_s:
            self._look_at_s = time.monotonic() + _LOOK_EVERY_S
            self._processes = [
                ProcessState(name=p.name, **_condition(p.seen, p.running, p.beat_age_s))
                for p in who_is_alive(self._home, PROCESSES)
            ]
        return self._processes


def _condition(seen: bool, running: bool, beat_age_s: float) -> dict[str, str]:
    if not seen:
        return {"condition": "none", "detail": "has not run in this room yet"}
    if not running:
        return {"condition": "down", "detail": "has ended"}
    if beat_age_s > _BEAT_IS_LOST_S:
        return {"condition": "old", "detail": HANGS}
    if beat_age_s > _BEAT_IS_OLD_S:
        return {"condition": "old", "detail": "is quiet"}
    return {"condition": "up", "detail": ""}


def describe_robot(link: RoomLink, before: RobotState) -> RobotState:
    """The bridge as it last said it was; without a link as it was, and that it is not linked."""
    status = link.status
    if status is None:
        return before.model_copy(update={"linked": False, "problem": link.problem})
    taken = taken_to_stand(status)
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
        taken_um={axis: one.at_um for axis, one in taken.items()},
        taken_from=source_of(taken) if taken else "",
    )


def _procedures(record: CaseRecord, execution: Execution) -> dict[str, Any]:
    """The one that runs, what it asks for, and how the last one ended."""
    running, ended = record.running_procedure(), record.last_ended_procedure()
    request, question = execution.request, execution.question
    return {
        "procedure": running.name if running else None,
        "procedure_id": running.procedure_id if running else None,
        "last_outcome": outcome_text(ended.name, ended.state, ended.result) if ended else "",
        "last_failure": _failure(ended) if running is None else None,
        "acquisition_request": AcquisitionState(**vars(request)) if request else None,
        "question": QuestionState(**{**vars(question), "choices": list(question.choices)})
        if question
        else None,
    }


def _failure(ended: Procedure | None) -> str | None:
    """The code of the failure with which the last procedure ended; None unless it failed."""
    if ended is None or ended.state != "failed":
        return None
    return str((ended.result or {}).get("code", ""))


def _case(record: CaseRecord) -> CaseState | None:
    described = record.last_event("case_described")
    return CaseState(**described.body) if described else None


def _hold(record: CaseRecord) -> HoldState | None:
    hold = record.open_hold()
    if hold is None:
        return None
    return HoldState(hold_id=hold.hold_id, set_id=hold.set_id, settled_at_s=hold.settled_at_s)


def _slices(record: CaseRecord, counts: dict[str, int]) -> dict[str, Any]:
    """How many there are, the last one, and the one that is shown."""
    last = record.last_slice()
    shown = record.last_slice("assigned") or last
    return {
        "last_slice_id": last.slice_id if last else None,
        "last_slice_received_s": last.received_s if last else None,
        "slices": counts,
        "slice": _slice(shown) if shown else None,
    }


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


def _arrival(record: CaseRecord, found: Readiness | None, now: Now) -> ArrivalState | None:
    """Of the approach whose target the needle guide is at now."""
    if found is None or not found.ready:
        return None
    result = found.arrival
    known = {name: result[name] for name in ArrivalState.model_fields if name in result}
    measurement = record.measurement(int(result["measurement_id"]))
    age = age_s(measurement.request[RESTS_ON], now)
    by_hand = arrival_by_hand(record, found.procedure_id)
    more = {"age_s": age, "by_hand": by_hand}
    return ArrivalState(procedure_id=found.procedure_id, **{**known, **more})


def _marked(arrival: ArrivalState | None) -> str:
    """An overrule is never out of sight where READY rests on it."""
    return "" if arrival is None or not arrival.by_hand else " (relies on slices assigned by hand)"


def _drives(config: Config, link: RoomLink) -> list[DriveState]:
    """What a calibration would drive, and how far: said before it is ordered."""
    status = link.status
    if status is None:
        return []
    guide = config.service.guide
    axes = config.service.axes if guide is None else guide.axes
    move_mm = (guide or config.service).calibration_move_mm
    drives = []
    for axis in axes:
        travel = Travel(*link.travel_left_um.get(axis, (0, 0)))
        origin_mm = calibration_origin_um(travel, round(move_mm * 1000)) / 1000
        stops_mm = (status.positions_um.get(axis, 0) / 1000, origin_mm, origin_mm + move_mm)
        drives.append(DriveState(axis=axis, stops_mm=(*stops_mm, origin_mm)))
    return drives


def _lost_ready(found: Readiness | None) -> LostState | None:
    if found is None or found.lost is None:
        return None
    return LostState(code=found.lost.code, text=found.lost.text)


def _measurement(record: CaseRecord, last: Measurement | None, now: Now) -> MeasurementState | None:
    if last is None:
        return None
    facts = last.request.get(RESTS_ON)
    lost = why_not_now(record, last, now) if last.state == "done" else None
    update = {
        "lost": None if lost is None else LostState(code=lost.code, text=lost.text),
        "age_s": None if facts is None else age_s(facts, now),
        "by_hand": rests_on_slices(last, record.slices_by_hand()),
    }
    return describe_measurement(last).model_copy(update=update)


def _other(record: CaseRecord, other: FiducialState | None, now: Now) -> FiducialState | None:
    """The other fiducial, and whether it is still there."""
    if other is None:
        return None
    lost = why_not_now(record, record.measurement(other.measurement_id), now)
    said = None if lost is None else LostState(code=lost.code, text=lost.text)
    return other.model_copy(update={"lost": said})


def _error(
    config: Config, record: CaseRecord, target: Target | None, void: str, now: Now
) -> dict[str, Any]:
    """How far off it is now; if that is not known, why not."""
    last = record.last_measurement("done")
    if last is None:
        return {"error": None, "error_reason": "nothing measured yet"}
    lost = why_not_now(record, last, now)
    if lost is not None:
        return {"error": None, "error_reason": lost.text}
    if target is None:
        return {"error": None, "error_reason": void or "no target set"}
    try:
        error = describe_error(config, record, target)
    except TargetError as unusable:
        return {"error": None, "error_reason": str(unusable)}
    return {"error": error, "error_reason": "" if error else "not calibrated"}


def _timeless(state: RoomState) -> RoomState:
    """The state without what changes by time alone."""
    ageless = {"age_s": None}
    parts = {name: getattr(state, name) for name in ("measurement", "arrival")}
    younger = {name: part and part.model_copy(update=ageless) for name, part in parts.items()}
    return state.model_copy(update={"at_s": 0.0, "revision": 0, **younger})
