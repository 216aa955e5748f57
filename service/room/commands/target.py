"""Commands that say where the needle is to go: target and entry point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from service.procedure.arguments import recording_of
from service.procedure.registry import APPROACHES, GUIDE_RECORDING, RECORDING, recording_arguments
from service.procedure.scan_frame import newest_frame
from service.procedure.targets import (
    ENTRY_SET,
    TARGET_SET,
    TARGET_WITHDRAWN,
    TargetError,
    current_target,
    target_that_can_be_taken,
)
from service.room.context import RoomContext
from service.room.proposals import Plan, why_not_in_bore, why_senseless
from service.room.reach import OutOfReachError, ReachUnknownError, check_reach
from service.room.refusal import ConflictError
from service.room.summaries import PointMm


class TargetCommands:
    """Target and entry point; a plan that waits for confirmation is void when they change."""

    def __init__(self, room: RoomContext) -> None:
        self._room = room

    def set_target(
        self, patient_mm: Sequence[float], by: str, label: str = "", in_water: bool = False
    ) -> None:
        """Set where the fiducial is to be, in patient mm (LPS); in_water: a place in tissue."""
        if len(patient_mm) != 3 or not all(math.isfinite(value) for value in patient_mm):
            raise ConflictError("bad_target", "A target needs three finite numbers (patient mm).")
        x, y, z = (float(value) for value in patient_mm)
        self._judge((x, y, z), in_water)
        self._void_plan_for(by, "target was changed")
        frame = newest_frame(self._room.record)
        body = {"patient_mm": [x, y, z], "label": label, "in_water": in_water}
        seen = {} if frame is None else {"scan_frame": frame.to_json()}
        self._room.note(TARGET_SET, by, {**body, **seen})

    def _judge(self, patient_mm: PointMm, in_water: bool) -> None:
        """Refuse a target that cannot be one, as far as that can be told now."""
        plan = Plan("operator", "target", "page", patient_mm)
        if why := why_senseless(plan) or why_not_in_bore(plan):
            raise ConflictError("bad_target", f"Not set: {why}.")
        if in_water and not self._room.config.imaging.readout_polarity:
            raise ConflictError(
                "no_polarity",
                "Not set: a target in tissue needs the readout polarity "
                "(imaging.readout_polarity in the room's file).",
            )
        try:
            check_reach(self._room, plan, in_water=in_water)
        except OutOfReachError as error:
            raise ConflictError("out_of_reach", f"Not set: {error}.") from error
        except ReachUnknownError:
            pass  # an approach asks again before anything moves

    def reach(
        self, patient_mm: Sequence[float], by: str, in_water: bool = False
    ) -> tuple[str, str]:
        """Whether a point could be the target: `within`, `out` or `unknown`, and why.

        Nothing is changed or recorded.
        """
        x, y, z = (float(value) for value in patient_mm)
        plan = Plan(by, "target", "page", (x, y, z))
        if why := why_senseless(plan) or why_not_in_bore(plan):
            return "out", why
        try:
            check_reach(self._room, plan, in_water=in_water)
        except OutOfReachError as error:
            return "out", str(error)
        except ReachUnknownError as error:
            return "unknown", str(error)
        return "within", ""

    def withdraw_target(self, by: str) -> None:
        """There is no target any more until another one is set."""
        if current_target(self._room.record) is None:
            raise ConflictError("no_target", "There is no target to withdraw.")
        self._void_plan_for(by, "target was withdrawn")
        self._room.note(TARGET_WITHDRAWN, by, {})

    def choose_target(self, number: int, by: str) -> None:
        """Take a target of this case again, by its number."""
        try:
            known = target_that_can_be_taken(self._room.record, number)
        except TargetError as error:
            raise ConflictError("no_target", f"Not set: {error}.") from error
        self._void_plan_for(by, "target was changed")
        body: dict[str, Any] = {"patient_mm": list(known.patient_mm), "label": known.label}
        if known.found_by is not None:
            body["found_by"] = known.found_by.to_json()
        if known.frame is not None:  # it is where it was set, not where it is chosen again
            body |= {"scan_frame": known.frame.to_json(), "scan_frame_seq": known.frame_seq}
        self._room.note(TARGET_SET, by, {**body, "in_water": known.in_water, "again": number})

    def record_target(self, by: str, label: str = "") -> int:
        """Begin to find out where the fiducial is now: that place becomes the target.

        With two fiducials the needle's line does: entry point and target.
        """
        self._room.check_may_start()
        room, settings = self._room, self._room.settings()
        guide = settings.service.guide
        start = room.start_point(guide=guide is not None)
        arguments = recording_of(settings, guide, room.seed(), room.proof_arguments(start))
        body = {**recording_arguments(arguments, start), "label": label, "by": by}
        return room.begin(RECORDING if guide is None else GUIDE_RECORDING, body, by)

    def set_entry(self, patient_mm: Sequence[float], by: str) -> None:
        """Set the planned skin point, patient mm (LPS)."""
        if self._room.config.service.guide is not None:
            self._void_plan_for(by, "entry point was changed")
        self._room.note(ENTRY_SET, by, {"patient_mm": [float(value) for value in patient_mm]})

    def _void_plan_for(self, by: str, what: str) -> None:
        """Before a target changes: void the plan that waits for confirmation; refuse if busy."""
        running = self._room.record.running_procedure()
        if running is None:
            return
        question = self._room.execution.question
        if running.name not in APPROACHES or question is None or question.plan is None:
            raise ConflictError("busy", "End the running procedure before changing the target.")
        reason = (
            f"the {what} by {by} while a move was waiting for confirmation; the move was not "
            "made. Start the approach again"
        )
        body = {"plan_id": question.plan["plan_id"], "reason": reason}
        self._room.note("plan_void", by, body)
        self._room.abort(reason)
