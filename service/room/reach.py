"""Whether the robot can bring the guide to where somebody wants it, before anybody starts."""

from __future__ import annotations

import numpy as np

from service.procedure.arguments import approach_of
from service.procedure.calibration import Calibration
from service.procedure.plan import PlanRefusedError, plan_move
from service.procedure.registry import latest_calibration
from service.procedure.targets import Target, TargetError, current_entry
from service.room.context import RoomContext
from service.room.proposals import Plan, Point3


class OutOfReachError(Exception):
    """The robot cannot do it; one line with the numbers."""


class ReachUnknownError(Exception):
    """Nobody can tell yet; the text says what is missing."""


def check_reach(room: RoomContext, plan: Plan, *, in_water: bool = False) -> None:
    """What an approach would work out from where the robot stands, without starting one.

    Raises OutOfReachError or ReachUnknownError.
    """
    guide = room.config.service.guide
    calibration = latest_calibration(room.record, guide=guide is not None)
    if calibration is None:
        raise ReachUnknownError("the robot's reach is not known until it is calibrated")
    status = room.link.status
    if status is None:
        raise ReachUnknownError("no link to the robot")
    if plan.target_mm is None:
        raise ReachUnknownError("no target set yet")
    start = room.start_point(guide=guide is not None)
    target = Target(0, plan.target_mm, in_water=in_water)
    newest = room.record.last_slice("assigned")
    header = {} if newest is None else newest.header
    config, travel = room.config, room.travel()
    entry_mm = None if guide is None else entry_of(room, plan, start)
    try:
        told = approach_of(config, guide, travel, start, entry_mm, target, header, 0)
        plan_move(
            start.estimate,
            np.array(told.target_mm),
            start.jacobian,
            travel,
            measurement_id=start.measurement_id,
            plan_id="reach",
        )
    except (TargetError, PlanRefusedError) as error:
        raise OutOfReachError(str(error)) from error


def entry_of(room: RoomContext, plan: Plan, start: Calibration) -> Point3:
    """The entry point: the plan's own; where its line leaves the guide; or the one that is set."""
    guide = room.config.service.guide
    if plan.entry_mm is not None:
        return plan.entry_mm
    if plan.direction is not None and plan.target_mm is not None and guide is not None:
        normal, direction = start.plane.normal, np.array(plan.direction)
        along = float(normal @ direction)
        if not abs(along) > 0.1:
            raise OutOfReachError("the needle would lie in the slice plane")
        target = np.array(plan.target_mm)
        distance = (guide.lower_plane_mm - float(normal @ target)) / along
        x, y, z = (target + distance * direction).tolist()
        return x, y, z
    entry_mm = current_entry(room.record)
    if entry_mm is None:
        raise ReachUnknownError("the needle's direction is not known: no entry point is set")
    return entry_mm
