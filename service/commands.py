"""What the operator (or a program with the operator's rights) may ask of the control loop.

Every method runs in the control loop's thread. What cannot be done now is a `ConflictError` whose
text says what to do instead; every command that is carried out is an event that names who asked.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from case_record.record import CaseRecord
from dicom_listener.overrule import give_up_slices, reassign, reset_clock
from robot_bridge.client import BridgeError, BridgeStatus
from room_config.load import Config
from room_config.service import GuideConfig
from service.calibration import Calibration
from service.execution import Execution
from service.fiducial_plan import approach_of, calibration_of, gate_of, recording_of
from service.guide_plan import guide_approach_of, guide_calibration_of, guide_recording_of
from service.plan import PLAN_VOID, PlanRefusedError, Travel, check_travel
from service.procedures import (
    APPROACH,
    APPROACHES,
    CALIBRATION,
    GUIDE_APPROACH,
    GUIDE_CALIBRATION,
    GUIDE_RECORDING,
    JOG,
    RECORDING,
    approach_arguments,
    calibration_arguments,
    guide_approach_arguments,
    guide_calibration_arguments,
    latest_calibration,
    recording_arguments,
)
from service.readiness import ConflictError, may_start, ready_arrival
from service.room_link import RoomLink
from service.start_point import POSITION_DECLARED, positions_to_declare, start_point
from service.steering import CONFIRM
from service.targets import (
    ENTRY_SET,
    TARGET_SET,
    TARGET_WITHDRAWN,
    Target,
    TargetError,
    all_targets,
    current_entry,
    current_target,
)

_SOURCE = "service"


class Commands:
    def __init__(
        self, config: Config, record: CaseRecord, link: RoomLink, execution: Execution
    ) -> None:
        self._config = config
        self._record = record
        self._link = link
        self._execution = execution

    # Robot

    def reset(self, by: str) -> None:
        """Clear a latched stop, take the positions as they stand or are recorded, and arm."""
        status = self._linked()
        try:
            if not status.position_certain:
                positions_um = positions_to_declare(self._record, status.positions_um)
                self._link.client.declare_position(positions_um, by)
                counted_um = dict(status.positions_um)
                body = {"positions_um": positions_um, "counted_um": counted_um}
                self._note(POSITION_DECLARED, by, body)
            if status.stopped:
                self._link.client.rearm(by)
            elif not status.armed:
                self._link.client.arm(by)
        except BridgeError as error:
            raise ConflictError("robot_refused", str(error)) from error
        self._note("armed", by, {})

    def note_stop(self, by: str, emergency: bool) -> None:
        """STOP was sent already: record it and end the procedure."""
        self._note("emergency" if emergency else "stop", by, {})
        self._abort(f"STOP by {by}")

    def abort(self, by: str) -> None:
        """End the running procedure; the robot stays where it is."""
        if self._record.running_procedure() is None:
            raise ConflictError("nothing_runs", "No procedure is running.")
        self._note("abort", by, {})
        self._abort(f"ended by {by}")

    def _abort(self, reason: str) -> None:
        if self._record.running_procedure() is not None:
            self._execution.abort(reason)

    def keep_lock(self) -> None:
        """Hold the insertion lock from READY until the operator says that the needle is out."""
        status = self._link.status
        if status is None or status.insertion_locked or status.moving:
            return
        if ready_arrival(self._record) is None:
            return
        try:
            self._link.client.set_insertion_lock(True, _SOURCE)
        except BridgeError:
            return  # asked again at the next tick; until then `may_start` refuses every motion
        self._note("insertion_locked", _SOURCE, {})

    # Procedures

    def start_calibration(self, by: str, guide: bool | None = None) -> int:
        """Begin a calibration; returns its procedure id. guide: four axes; None: as configured."""
        self._may_start()
        with_guide = self._guide_wanted(guide)
        if with_guide is not None:
            return self._start_guide_calibration(with_guide, by)
        try:
            arguments = calibration_of(self._config, self._travel(), self._seed())
        except PlanRefusedError as error:
            raise ConflictError("out_of_travel", f"Calibration: {error}.") from error
        return self._begin(CALIBRATION, calibration_arguments(arguments), by)

    def _guide_wanted(self, guide: bool | None) -> GuideConfig | None:
        """The guide's table if four axes are to be used; None for one fiducial and two axes."""
        configured = self._config.service.guide
        if guide and configured is None:
            raise ConflictError(
                "no_guide", "This room has no [service.guide] table: it steers two axes only."
            )
        return configured if guide or guide is None else None

    def _start_guide_calibration(self, guide: GuideConfig, by: str) -> int:
        try:
            arguments = guide_calibration_of(self._config, guide, self._travel())
        except PlanRefusedError as error:
            raise ConflictError("out_of_travel", f"Calibration: {error}.") from error
        return self._begin(GUIDE_CALIBRATION, guide_calibration_arguments(arguments), by)

    def set_target(
        self, patient_mm: Sequence[float], by: str, label: str = "", in_water: bool = False
    ) -> None:
        """Set where the fiducial is to be, in patient mm (LPS); in_water: a place in tissue."""
        if len(patient_mm) != 3 or not all(math.isfinite(value) for value in patient_mm):
            raise ConflictError("bad_target", "A target is three finite numbers, patient mm.")
        self._void_plan_for(by, "target was changed")
        body = {"patient_mm": [float(value) for value in patient_mm]}
        self._note(TARGET_SET, by, {**body, "label": label, "in_water": in_water})

    def withdraw_target(self, by: str) -> None:
        """There is no target any more until another one is set."""
        if current_target(self._record) is None:
            raise ConflictError("no_target", "There is no target to withdraw.")
        self._void_plan_for(by, "target was withdrawn")
        self._note(TARGET_WITHDRAWN, by, {})

    def choose_target(self, number: int, by: str) -> None:
        """Take a target of this case again, by its number."""
        known = next((t for t in all_targets(self._record) if t.number == number), None)
        if known is None:
            raise ConflictError("no_target", f"This case has no target number {number}.")
        self._void_plan_for(by, "target was changed")
        body = {"patient_mm": list(known.patient_mm), "label": known.label}
        self._note(TARGET_SET, by, {**body, "in_water": known.in_water, "again": number})

    def record_target(self, by: str, label: str = "") -> int:
        """Begin to find out where the fiducial is now: that place becomes the target.

        With two fiducials the needle's line does: entry point and target.
        """
        self._may_start()
        guide = self._guide_wanted(None)
        if guide is not None:
            start = self._start_point(guide=True)
            told = recording_arguments(guide_recording_of(self._config, guide), start)
            return self._begin(GUIDE_RECORDING, {**told, "label": label, "by": by}, by)
        arguments = recording_of(self._config, self._seed())
        start = self._start_point()
        body = {**recording_arguments(arguments, start), "label": label, "by": by}
        return self._begin(RECORDING, body, by)

    def set_entry(self, patient_mm: Sequence[float], by: str) -> None:
        """Set the planned skin point, patient mm (LPS)."""
        if self._config.service.guide is not None:
            self._void_plan_for(by, "entry point was changed")
        self._note(ENTRY_SET, by, {"patient_mm": [float(value) for value in patient_mm]})

    def _void_plan_for(self, by: str, what: str) -> None:
        """Before a target changes: void the plan that waits for confirmation; refuse if busy."""
        running = self._record.running_procedure()
        if running is None:
            return
        question = self._execution.question
        if running.name not in APPROACHES or question is None or question.plan is None:
            raise ConflictError("busy", "Abort the running procedure before changing the target.")
        reason = (
            f"the {what} by {by} while a move waited for confirmation: the move is not made, "
            "start the approach again"
        )
        body = {"plan_id": question.plan["plan_id"], "reason": reason}
        self._note("plan_void", by, body)
        self._abort(reason)

    def jog(self, axis: str, distance_um: int, by: str) -> int:
        """Move one axis by hand; returns the id of the procedure that does it."""
        self._may_start()
        status = self._linked()
        travel = self._travel()
        if axis not in travel or axis not in status.positions_um:
            raise ConflictError("unknown_axis", f"The robot has no axis {axis!r}.")
        if not status.position_certain:
            raise ConflictError("position_uncertain", "Check the robot's position and re-arm.")
        setpoint_um = status.positions_um[axis] + distance_um
        try:
            check_travel({axis: setpoint_um}, travel)
        except PlanRefusedError as error:
            raise ConflictError("out_of_travel", f"Not moved: {error}.") from error
        setpoints_um = {**status.positions_um, axis: setpoint_um}
        return self._begin(JOG, {"setpoints_um": setpoints_um}, by)

    def start_approach(self, by: str, guide: bool | None = None) -> int:
        """Begin the approach to the target; returns its procedure id.

        guide: with four axes, to the line from entry to target; None: as configured.
        """
        self._may_start()
        with_guide = self._guide_wanted(guide)
        if with_guide is not None:
            return self._start_guide_approach(with_guide, by)
        start = self._start_point()
        target = self._target()
        try:
            arguments = approach_of(
                self._config,
                self._link.travel_um,
                start,
                target,
                self._newest_header(),
                self._seed(),
            )
        except TargetError as error:
            raise _unusable(error) from error
        body = {**approach_arguments(arguments, start), "target": target.number}
        return self._begin(APPROACH, body, by)

    def _start_guide_approach(self, guide: GuideConfig, by: str) -> int:
        start = self._start_point(guide=True)
        target, entry_mm = self._target(), current_entry(self._record)
        if entry_mm is None:
            raise ConflictError("no_entry", "Set an entry point first: the needle has a direction.")
        try:
            arguments = guide_approach_of(
                self._config, guide, self._travel(), start, entry_mm, target, self._newest_header()
            )
        except TargetError as error:
            raise _unusable(error) from error
        body = {**guide_approach_arguments(arguments, start), "target": target.number}
        return self._begin(GUIDE_APPROACH, body, by)

    def _target(self) -> Target:
        target = current_target(self._record)
        if target is None:
            raise ConflictError("no_target", "Set a target first.")
        return target

    def _newest_header(self) -> Mapping[str, Any]:
        newest = self._record.last_slice("assigned")
        return {} if newest is None else newest.header

    def answer(self, question_id: str, choice: str, by: str, plan_id: str | None = None) -> None:
        """Answer the question that is on the page; void if it is another one by now.

        A confirmed plan must also still rest on where the robot stands and on the newest
        measurement.
        """
        question = self._execution.question
        if self._execution.aborting is not None:
            raise ConflictError(PLAN_VOID, f"Void: {self._execution.aborting}.")
        if question is None or question.question_id != question_id:
            raise ConflictError("stale_question", self._why_closed())
        if choice not in question.choices:
            raise ConflictError("unknown_choice", f"Choose one of {', '.join(question.choices)}.")
        if choice == CONFIRM and question.plan is not None:
            self._check_plan(question.plan, plan_id)
        body = {"question_id": question_id, "choice": choice}
        self._note("answered", by, body if plan_id is None else {**body, "plan_id": plan_id})
        self._execution.answer(choice, by)

    def _why_closed(self) -> str:
        text = "This question is not open any more."
        ended = self._record.last_ended_procedure()
        if self._record.running_procedure() is not None or ended is None:
            return text
        reason = (ended.result or {}).get("reason")
        return f"{text} The {ended.name} {ended.state}: {reason}." if reason else text

    def _check_plan(self, plan: Mapping[str, Any], plan_id: str | None) -> None:
        status = self._linked()
        if plan_id is not None and plan_id != plan["plan_id"]:
            raise ConflictError("stale_plan", "This plan was replaced: read the one shown now.")
        if status.stopped or not status.armed:
            raise ConflictError("not_armed", "Re-arm the robot; then start the approach again.")
        newest = self._record.last_measurement()
        if newest is not None and newest.measurement_id != plan["measurement_id"]:
            raise ConflictError("stale_plan", "A newer measurement exists: start again.")
        for axis, planned_from_um in plan["from_um"].items():
            moved_um = status.positions_um.get(axis, planned_from_um) - planned_from_um
            if not abs(moved_um) <= self._config.service.repeatability_um:
                raise ConflictError(
                    "stale_plan",
                    f"Axis {axis} has moved by {moved_um} µm since this plan was made: "
                    "end the procedure and start the approach again.",
                )

    # Slices and the case

    def assign_slice(self, slice_id: int, hold_id: int | None, why: str, by: str) -> None:
        """Overrule the listener: the slice belongs to this hold, or (None) to none."""
        row = self._record.slice(slice_id)
        if hold_id is not None:
            self._record.hold(hold_id)
            if not row.header.get("geometry"):
                raise ConflictError("no_geometry", f"Slice {slice_id} has no geometry: rescan.")
        reassign(self._record, slice_id, hold_id, by, why or "decided on the page")

    def give_up_slices(self, hold_id: int, why: str, by: str) -> None:
        """No more slices will come of a hold: the next one need not be scanned again for it."""
        hold = self._record.hold(hold_id)
        if hold.ended_at_s is None and self._record.running_procedure() is not None:
            raise ConflictError(
                "busy", f"Hold {hold_id} stands and its slices are asked for: end the procedure."
            )
        give_up_slices(self._record, hold_id, by, why)

    def confirm_acquisition(self, hold_id: int, by: str) -> None:
        """The operator says that the slices of a hold were acquired (rooms in arrival mode)."""
        self._record.hold(hold_id)
        self._note("acquisition_confirmed", by, {"hold_id": hold_id})

    def describe_case(self, by: str, **words: str) -> None:
        """Write down what the operator says about the case."""
        self._note("case_described", by, dict(words))

    # The puncture

    def puncture(self, by: str, insertion_depth_mm: float | None = None) -> None:
        """Record that the puncture was made. Motion stays locked until the needle is out."""
        arrival = ready_arrival(self._record)
        if arrival is None:
            raise ConflictError("not_ready", "The needle guide is not at a target (not READY).")
        body = {
            "procedure_id": arrival[0],
            "insertion_depth_mm": insertion_depth_mm,
            "error_mm": arrival[1]["error_mm"],
            "sigma_mm": arrival[1]["sigma_mm"],
        }
        self._note("puncture", by, body)

    def lock_motion(self, by: str) -> None:
        """The needle is going in: no motion until the operator says that it is out."""
        self._linked()
        if self._record.running_procedure() is not None:
            raise ConflictError("busy", "A procedure is running: end it before locking motion.")
        try:
            self._link.client.set_insertion_lock(True, by)
        except BridgeError as error:
            raise ConflictError("robot_refused", str(error)) from error
        self._note("insertion_locked", by, {})

    def needle_out(self, by: str) -> None:
        """The needle is out: unlock motion."""
        status = self._linked()
        self._note("needle_out", by, {})
        if not status.insertion_locked:
            return
        try:
            self._link.client.set_insertion_lock(False, by)
        except BridgeError as error:
            raise ConflictError("robot_refused", str(error)) from error

    def compare_clocks(self, by: str, offset_s: float, uncertainty_s: float) -> None:
        """The room's clock minus the scanner's, compared just now; the listener heeds the event."""
        body = {"offset_s": offset_s, "uncertainty_s": uncertainty_s, "at_s": time.time()}
        self._note("clock_sync", by, body)

    def forget_clock(self, why: str, by: str) -> None:
        """The scanner's clock was set, or seemed to be: the next slices show it anew."""
        reset_clock(self._record, by, why)

    # What these have in common

    def _begin(self, name: str, arguments: dict[str, Any], by: str) -> int:
        with self._record.transaction():
            number = self._record.begin_procedure(name, arguments)
            self._note(f"{name}_started", by, {"procedure_id": number})
        return number

    def _note(self, kind: str, by: str, body: dict[str, Any]) -> None:
        self._record.append_event(kind, body, source=_SOURCE, who=by)

    def _linked(self) -> BridgeStatus:
        status = self._link.status
        if status is None:
            raise ConflictError("no_link", f"No link to the robot: {self._link.problem}")
        return status

    def _may_start(self) -> None:
        self._linked()
        refusal = may_start(self._record, self._link.status)
        if refusal is not None:
            raise refusal

    def _seed(self) -> int:
        """Of the next procedure's random choices: from the case's seed and its number."""
        case = self._record.case()
        words = (case.seed if case else 0, len(self._record.procedures()))
        return int(np.random.SeedSequence(words).generate_state(1)[0])

    def _travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self._link.travel_um.items()}

    def _start_point(self, *, guide: bool = False) -> Calibration:
        """The calibration with the estimate carried to where the robot stands now."""
        calibration = latest_calibration(self._record, guide=guide)
        if calibration is None:
            raise ConflictError("not_calibrated", "Calibrate first.")
        status = self._linked()
        noise = gate_of(self._config).noise
        return start_point(self._record, calibration, status.positions_um, noise)


def _unusable(error: TargetError) -> ConflictError:
    return ConflictError("target_unusable", f"The target cannot be used: {error}.")
