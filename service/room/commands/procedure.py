"""Commands to procedures: begin one, answer its questions, end it, record the puncture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from case_record.cases import Cases
from service.procedure.arguments import approach_of, calibration_of
from service.procedure.observe import CONFIRM
from service.procedure.plan import PLAN_VOID, PlanRefusedError
from service.procedure.registry import (
    APPROACH,
    CALIBRATION,
    GUIDE_APPROACH,
    GUIDE_CALIBRATION,
    approach_arguments,
    calibration_arguments,
)
from service.procedure.scan_frame import newest_frame
from service.procedure.targets import (
    Target,
    TargetError,
    current_entry,
    current_entry_number,
    current_target,
    why_void_target,
)
from service.room.context import RoomContext
from service.room.history import arrival_by_hand
from service.room.refusal import ConflictError
from service.room.robot.memory import last_jacobian
from service.room.validity import PUNCTURE, readiness


class ProcedureCommands:
    """Calibration, approach and puncture."""

    def __init__(self, room: RoomContext, cases: Cases) -> None:
        self._room = room
        self._cases = cases

    def start_calibration(self, by: str, guide: bool | None = None) -> int:
        """Begin a calibration; returns its procedure id. guide: four axes; None: as configured."""
        self._room.check_may_start()
        room, with_guide = self._room, self._room.guide_wanted(guide)
        try:
            arguments = calibration_of(room.config, with_guide, room.travel(), room.seed())
        except PlanRefusedError as error:
            raise ConflictError("out_of_travel", f"Calibration: {error}.") from error
        name = GUIDE_CALIBRATION if with_guide else CALIBRATION
        last, same_mount = last_jacobian(room.record, self._cases, name)
        arguments = replace(arguments, last=last, same_mount=same_mount)
        return room.begin(name, calibration_arguments(arguments), by)

    def start_approach(self, by: str, guide: bool | None = None) -> int:
        """Begin the approach to the target; returns its procedure id.

        guide: with four axes, to the line from entry to target; None: as configured.
        """
        self._room.check_may_start()
        room, with_guide = self._room, self._room.guide_wanted(guide)
        start = room.start_point(guide=with_guide is not None)
        target, entry_mm = self._target(), current_entry(room.record)
        if with_guide is not None and entry_mm is None:
            raise ConflictError(
                "no_entry", "Set an entry point first: it gives the needle its direction."
            )
        settings = room.settings()
        try:
            arguments = approach_of(
                settings,
                settings.service.guide if with_guide else None,
                room.travel(),
                start,
                entry_mm,
                target,
                self._newest_header(),
                room.seed(),
                proven=room.is_proven(start),
            )
        except TargetError as error:
            raise ConflictError(
                "target_unusable", f"The target cannot be used: {error}."
            ) from error
        if why := arguments.why_never_sure():
            raise ConflictError("tolerance_too_tight", f"Not started: {why}.")
        body = {**approach_arguments(arguments, start), "target": target.number}
        body["scan_frame"] = self._scan_frame()
        if with_guide is None:
            return room.begin(APPROACH, body, by)
        body["entry"] = current_entry_number(room.record)
        return room.begin(GUIDE_APPROACH, body, by)

    def _target(self) -> Target:
        target = current_target(self._room.record)
        if target is None:
            raise ConflictError("no_target", "Set a target first.")
        if why := why_void_target(self._room.record, target):
            raise ConflictError("target_void", f"The target cannot be used: {why}.")
        return target

    def _newest_header(self) -> Mapping[str, Any]:
        newest = self._room.record.last_slice("assigned")
        return {} if newest is None else newest.header

    def _scan_frame(self) -> dict[str, Any] | None:
        frame = newest_frame(self._room.record)
        return None if frame is None else frame.to_json()

    def answer(self, question_id: str, choice: str, by: str, plan_id: str | None = None) -> None:
        """Answer the question that is on the page; void if it is another one by now.

        A confirmed plan must also still rest on where the robot stands and on the newest
        measurement.
        """
        question = self._room.execution.question
        if self._room.execution.aborting is not None:
            raise ConflictError(PLAN_VOID, f"Void: {self._room.execution.aborting}.")
        if question is None or question.question_id != question_id:
            raise ConflictError("stale_question", self._why_closed())
        if choice not in question.choices:
            raise ConflictError("unknown_choice", f"Choose one of {', '.join(question.choices)}.")
        if choice == CONFIRM and question.plan is not None:
            self._check_plan(question.plan, plan_id)
        body = {"question_id": question_id, "choice": choice}
        self._room.note("answered", by, body if plan_id is None else {**body, "plan_id": plan_id})
        self._room.execution.answer(choice, by)

    def _why_closed(self) -> str:
        text = "This question is no longer open."
        ended = self._room.record.last_ended_procedure()
        if self._room.record.running_procedure() is not None or ended is None:
            return text
        reason = (ended.result or {}).get("reason")
        return f"{text} The {ended.name} {ended.state}: {reason}." if reason else text

    def _check_plan(self, plan: Mapping[str, Any], plan_id: str | None) -> None:
        status = self._room.linked()
        if plan_id is not None and plan_id != plan["plan_id"]:
            raise ConflictError(
                "stale_plan", "This plan has been replaced: review the one shown now."
            )
        if status.stopped or not status.armed:
            raise ConflictError("not_armed", "Re-arm the robot; then start the approach again.")
        newest = self._room.record.last_measurement()
        if newest is not None and newest.measurement_id != plan["measurement_id"]:
            raise ConflictError(
                "stale_plan", "There is a newer measurement: start the approach again."
            )
        for axis, planned_from_um in plan["from_um"].items():
            moved_um = status.positions_um.get(axis, planned_from_um) - planned_from_um
            if not abs(moved_um) <= self._room.config.service.repeatability_um:
                raise ConflictError(
                    "stale_plan",
                    f"Axis {axis} has moved by {moved_um} µm since this plan was made: "
                    "end the procedure and start the approach again.",
                )

    def confirm_acquisition(self, hold_id: int, by: str) -> None:
        """The operator says that the slices of a hold were acquired (rooms in arrival mode)."""
        self._room.record.hold(hold_id)
        self._room.note("acquisition_confirmed", by, {"hold_id": hold_id})

    def abort(self, by: str) -> None:
        """End the running procedure; the robot stays where it is."""
        if self._room.record.running_procedure() is None:
            raise ConflictError("nothing_runs", "No procedure is running.")
        self._room.note("abort", by, {})
        self._room.abort(f"ended by {by}")

    def puncture(self, by: str, insertion_depth_mm: float | None = None) -> None:
        """Record that the puncture was made. Motion stays locked until the needle is out."""
        found = readiness(self._room.record, self._room.now())
        if found is None:
            raise ConflictError("not_ready", "The needle guide is not at a target (not READY).")
        if found.lost is not None:
            text = f"READY was lost: {found.lost.text}. Measure again before puncturing."
            raise ConflictError("not_ready", text)
        if not found.ready:
            raise ConflictError("not_ready", "Motion is not locked yet: wait for READY.")
        body = {
            "procedure_id": found.procedure_id,
            "insertion_depth_mm": insertion_depth_mm,
            "error_mm": found.arrival["error_mm"],
            "sigma_mm": found.arrival["sigma_mm"],
            "by_hand": arrival_by_hand(self._room.record, found.procedure_id),
        }
        self._room.note(PUNCTURE, by, body)
