"""From an error in millimetres to absolute setpoints, checked before anybody has to confirm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import CalibrationError, ImageJacobian

Array = NDArray[np.float64]
PLAN_VOID = "plan_void"
# a readback may differ by so much between two looks at a stage that stands
SAME_PLACE_UM = 20


class PlanRefusedError(Exception):
    """The move would break a rule; the text names the rule and the numbers."""


@dataclass(frozen=True)
class Travel:
    """Travel limits of one axis, integer micrometres, both ends allowed.

    unsure_um: what was taken off both ends because it is not known better where the axis stands.
    """

    min_um: int
    max_um: int
    unsure_um: int = 0


@dataclass(frozen=True)
class PlanPart:
    """How far one thing is from where it should be, image plane, with its standard deviation."""

    name: str
    row_mm: float
    col_mm: float
    sigma_mm: float


@dataclass(frozen=True)
class Plan:
    """A move that was worked out but not made.

    It is void as soon as the robot stands elsewhere than at `from_um`, or a newer measurement than
    `measurement_id` exists. parts: with two fiducials, what is off by how much before the move.
    """

    plan_id: str
    measurement_id: int
    from_um: Mapping[str, int]
    setpoints_um: Mapping[str, int]
    displacement_mm: tuple[float, float]
    parts: tuple[PlanPart, ...] = ()

    def to_json(self) -> dict[str, Any]:
        value = asdict(self)
        if not self.parts:  # as plans of one fiducial have always been recorded
            del value["parts"]
        return value


def plan_move(
    estimate: FiducialEstimate,
    target_mm: Array,
    jacobian: ImageJacobian,
    travel: Mapping[str, Travel],
    *,
    measurement_id: int,
    plan_id: str,
) -> Plan:
    """Return the move that brings the fiducial from `estimate` to `target_mm` (image plane).

    Raises PlanRefusedError if an axis would leave its travel, naming axis, setpoint and limits, or
    if the image Jacobian leads to no move.
    """
    displacement = target_mm - estimate.plane_mm
    try:
        change_mm = jacobian.setpoint_change_mm(displacement)
    except CalibrationError as error:
        raise PlanRefusedError(f"{error}: calibrate again") from error
    setpoints_um = dict(estimate.setpoints_um)
    for axis, change in change_mm.items():
        setpoints_um[axis] += round(change * 1000.0)
    setpoints_um = held_inside(setpoints_um, estimate.setpoints_um, travel)
    check_travel(setpoints_um, travel)
    return Plan(
        plan_id,
        measurement_id,
        dict(estimate.setpoints_um),
        setpoints_um,
        (float(displacement[0]), float(displacement[1])),
    )


def why_void(
    from_um: Mapping[str, int],
    rests_on: int | None,
    positions_um: Mapping[str, int],
    newest_measurement_id: int | None,
) -> str:
    """Say why a plan may not be carried out any more; empty if it may."""
    for axis, planned_um in from_um.items():
        at_um = positions_um.get(axis)
        if at_um is None or not abs(at_um - planned_um) <= SAME_PLACE_UM:
            return (
                f"the plan was made with axis {axis} at {planned_um / 1000:.3f} mm; it is "
                f"now at {'an unknown position' if at_um is None else f'{at_um / 1000:.3f} mm'}"
            )
    newer = rests_on is not None and (newest_measurement_id or 0) > rests_on
    if newer:
        return (
            f"the plan rests on measurement {rests_on}; there is a newer one "
            f"({newest_measurement_id})"
        )
    return ""


def held_inside(
    setpoints_um: Mapping[str, int], from_um: Mapping[str, int], travel: Mapping[str, Travel]
) -> dict[str, int]:
    """Return the setpoints with every axis that stays at the very end of its travel put inside it.

    An encoder may read a little beyond the end that was reached; that must not hold up the others.
    """
    held = dict(setpoints_um)
    for axis, limits in travel.items():
        if axis not in held or abs(held[axis] - from_um.get(axis, held[axis])) > SAME_PLACE_UM:
            continue
        inside_um = min(max(held[axis], limits.min_um), limits.max_um)
        if abs(inside_um - held[axis]) <= SAME_PLACE_UM:
            held[axis] = inside_um
    return held


def check_travel(setpoints_um: Mapping[str, int], travel: Mapping[str, Travel]) -> None:
    """Raise PlanRefusedError unless every setpoint lies inside the travel of its axis."""
    for axis, setpoint_um in setpoints_um.items():
        if axis not in travel:
            raise PlanRefusedError(f"axis {axis} has no travel limits")
        limits = travel[axis]
        if not limits.min_um <= setpoint_um <= limits.max_um:
            unsure = (
                f" (its position is known only to within {limits.unsure_um / 1000:.3f} mm, and the "
                "travel is narrowed by that: measure, home it or declare its position)"
            )
            raise PlanRefusedError(
                f"axis {axis}: setpoint {setpoint_um / 1000:.3f} mm is outside its travel "
                f"{limits.min_um / 1000:.3f} to {limits.max_um / 1000:.3f} mm"
                f"{unsure if limits.unsure_um else ''}"
            )
