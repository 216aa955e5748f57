"""The parallel-plane mechanism: two X-Y stages, a ball joint on each, a needle guide through both.

Frames: `base` (the robot's own, mm) and one frame a stage, whose x-y plane the ball joint moves in.
The cannula is fixed in the lower ball joint and slides through the upper one, so a fiducial on the
guide stays at its distance from the *lower* joint whatever the guide's angle. Distances along the
guide count from the lower joint, positive towards the upper one (and beyond it).
Reference: the paper, section II.B; its 0T_b is printed as 0T_t.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
TOP_AXES, BOTTOM_AXES = ("xt", "yt"), ("xb", "yb")
AXES = (*TOP_AXES, *BOTTOM_AXES)
_PARALLEL_SINE = 1e-6


class KinematicsError(ValueError):
    """The mechanism cannot do, or cannot be, what was asked; the text says what and where."""


class OutOfReachError(KinematicsError):
    """A stage would have to leave its travel."""


@dataclass(frozen=True, eq=False)
class NeedleLine:
    """A straight line in space: a point (3,) mm and a unit direction (3,), upwards for a guide."""

    point_mm: Array
    direction: Array

    @classmethod
    def through(cls, lower_mm: ArrayLike, upper_mm: ArrayLike) -> NeedleLine:
        """From a lower to an upper point; raises KinematicsError where they are the same."""
        lower, upper = np.asarray(lower_mm, dtype=float), np.asarray(upper_mm, dtype=float)
        length = float(np.linalg.norm(upper - lower))
        if not length > 1e-9:
            raise KinematicsError(f"two points {length:g} mm apart do not define a line")
        return cls(lower, (upper - lower) / length)

    def at(self, distance_mm: float) -> Array:
        return np.asarray(self.point_mm + distance_mm * self.direction)

    def distance_to_mm(self, point_mm: ArrayLike) -> float:
        offset = np.asarray(point_mm, dtype=float) - self.point_mm
        return float(np.linalg.norm(offset - (offset @ self.direction) * self.direction))


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Where the stages are, and how far they go.

    base_from_top, base_from_bottom: (4, 4) homogeneous, rigid; the ball joint of a stage at (x, y)
        is base_from_stage @ (x, y, 0, 1).
    travel_mm: per axis (low, high), both ends allowed.
    guide_face_mm: distance along the guide at which the needle enters it; depth counts from there.
    """

    base_from_top: Array
    base_from_bottom: Array
    travel_mm: Mapping[str, tuple[float, float]]
    guide_face_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("base_from_top", "base_from_bottom"):
            matrix = getattr(self, name)
            if np.shape(matrix) != (4, 4) or not np.all(np.isfinite(matrix)):
                raise KinematicsError(f"{name} must be 4 x 4 finite numbers")
            turn = matrix[:3, :3]
            rigid = np.allclose(turn @ turn.T, np.eye(3), atol=1e-6)
            if not rigid or not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-9):
                raise KinematicsError(f"{name} is not a rigid transform")
        for axis in AXES:
            if axis not in self.travel_mm:
                raise KinematicsError(f"axis {axis} has no travel limits")
            low, high = self.travel_mm[axis]
            if not low < high:
                raise KinematicsError(f"axis {axis}: travel {low} to {high} mm is empty")


def parallel_planes(
    separation_mm: float, travel_mm: Mapping[str, tuple[float, float]], guide_face_mm: float = 0.0
) -> Mechanism:
    """Two stages above each other, axes alike; base and bottom frame are the same."""
    if not separation_mm > 0:
        raise KinematicsError(f"the planes must differ; their separation is {separation_mm} mm")
    top = np.eye(4)
    top[2, 3] = separation_mm
    return Mechanism(top, np.eye(4), travel_mm, guide_face_mm)


# Forward


def ball_joints(mechanism: Mechanism, stage_mm: Mapping[str, float]) -> tuple[Array, Array]:
    """(upper, lower) ball joint, base mm, for stage positions of all four axes."""
    upper = mechanism.base_from_top @ (*(stage_mm[axis] for axis in TOP_AXES), 0.0, 1.0)
    lower = mechanism.base_from_bottom @ (*(stage_mm[axis] for axis in BOTTOM_AXES), 0.0, 1.0)
    return upper[:3], lower[:3]


def guide_line(mechanism: Mechanism, stage_mm: Mapping[str, float]) -> NeedleLine:
    """The guide: its point is the lower ball joint, its direction goes to the upper one."""
    upper, lower = ball_joints(mechanism, stage_mm)
    return NeedleLine.through(lower, upper)


def fiducial_mm(
    mechanism: Mechanism, stage_mm: Mapping[str, float], along_guide_mm: float
) -> Array:
    """Centre (3,) of a fiducial on the guide, base mm; it may sit anywhere along the guide."""
    return guide_line(mechanism, stage_mm).at(along_guide_mm)


def fiducial_jacobian(
    mechanism: Mechanism, stage_mm: Mapping[str, float], along_guide_mm: float
) -> Array:
    """(3, 4): d(fiducial)/d(xt, yt, xb, yb), mm/mm, analytic.

    With u the guide's direction, L the joints' distance, s the fiducial's: it moves with the upper
    joint by s/L (I - u uT), and with the lower joint by the identity less that.
    """
    upper, lower = ball_joints(mechanism, stage_mm)
    line = NeedleLine.through(lower, upper)
    across = np.eye(3) - np.outer(line.direction, line.direction)
    share = along_guide_mm / float(np.linalg.norm(upper - lower)) * across
    return np.hstack(
        [
            share @ mechanism.base_from_top[:3, :2],
            (np.eye(3) - share) @ mechanism.base_from_bottom[:3, :2],
        ]
    )


# Inverse


def stage_from_line(mechanism: Mechanism, line: NeedleLine) -> dict[str, float]:
    """Stage positions (mm, all four axes) that put the guide onto the line.

    Raises KinematicsError for a line that runs along a stage plane. Travel is not looked at.
    """
    upper = _crossing(mechanism.base_from_top, line, "upper")
    lower = _crossing(mechanism.base_from_bottom, line, "lower")
    return dict(zip(AXES, (*upper.tolist(), *lower.tolist()), strict=True))


def _crossing(base_from_stage: Array, line: NeedleLine, name: str) -> Array:
    """Where the line meets a stage's plane, in the stage's own (x, y)."""
    turn, origin = base_from_stage[:3, :3], base_from_stage[:3, 3]
    normal = turn[:, 2]
    sine = float(normal @ line.direction)
    if not abs(sine) > _PARALLEL_SINE:
        raise KinematicsError(f"the line runs along the {name} stage's plane and never crosses it")
    point = line.at(float(normal @ (origin - line.point_mm)) / sine)
    return np.asarray((turn.T @ (point - origin))[:2])


def line_from_fiducials(
    upper_mm: ArrayLike, lower_mm: ArrayLike, lower_along_guide_mm: float
) -> NeedleLine:
    """The guide's line from the centres of its two fiducials (base mm); point: the lower joint."""
    line = NeedleLine.through(lower_mm, upper_mm)
    return NeedleLine(line.at(-lower_along_guide_mm), line.direction)


def line_from_entry_and_target(entry_mm: ArrayLike, target_mm: ArrayLike) -> NeedleLine:
    """The needle's line from the entry point on the skin to the target, same frame for both."""
    return NeedleLine.through(target_mm, entry_mm)


# Workspace


def check_reach(mechanism: Mechanism, stage_mm: Mapping[str, float]) -> None:
    """Raise OutOfReachError unless every axis is inside its travel; NaN is outside."""
    for axis in AXES:
        low, high = mechanism.travel_mm[axis]
        if not low <= stage_mm[axis] <= high:
            raise OutOfReachError(
                f"axis {axis}: {stage_mm[axis]:.3f} mm is outside its travel {low:g} to {high:g} mm"
            )


def reachable_rectangle_mm(
    mechanism: Mechanism, below_mm: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Bounds ((x low, x high), (y low, y high)), lower stage frame, of where a needle can go
    `below_mm` under the lower plane. For planes that are parallel and whose axes are alike.
    """
    bottom_from_top = np.linalg.inv(mechanism.base_from_bottom) @ mechanism.base_from_top
    if not np.allclose(bottom_from_top[:3, :3], np.eye(3), atol=1e-6):
        raise KinematicsError("the stages are not parallel with like axes: ask for single lines")
    ratio = below_mm / float(bottom_from_top[2, 3])
    bounds = []
    for number, (top, bottom) in enumerate(zip(TOP_AXES, BOTTOM_AXES, strict=True)):
        offset = float(bottom_from_top[number, 3])
        (top_low, top_high), (low, high) = mechanism.travel_mm[top], mechanism.travel_mm[bottom]
        bounds.append(
            (
                (1 + ratio) * low - ratio * (top_high + offset),
                (1 + ratio) * high - ratio * (top_low + offset),
            )
        )
    return bounds[0], bounds[1]


# The needle


def depth_to_target_mm(mechanism: Mechanism, line: NeedleLine, target_mm: ArrayLike) -> float:
    """Insertion depth: from the guide's face to where the needle is nearest to the target.

    line: of the guide, its point the lower ball joint.
    """
    offset = np.asarray(target_mm, dtype=float) - line.point_mm
    return mechanism.guide_face_mm - float(offset @ line.direction)


def tip_mm(line: NeedleLine, beyond_lower_joint_mm: float) -> Array:
    """The needle's tip (3,) so far below the lower joint, along the guide."""
    return line.at(-beyond_lower_joint_mm)
