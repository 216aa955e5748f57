"""The fiducials that follow the robot: one on a stage with two axes, or the guide's two with four.

The state is (row, col) of every fiducial, mm in the image plane. Those of the guide are seen in a
slice each, the upper one first; the guide's direction along the slice normal follows from the known
distance between them. The needle's tip is where the guide's line is `tip_beyond_mm` below the lower
ball joint; in the image plane it is linear in the state, so its covariance is exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import SMALLEST_ANGLE_DEG, CalibrationError, ImageJacobian
from service.procedure.kinematics import NeedleLine
from service.procedure.plane import ImagePlane

Array = NDArray[np.float64]
_STEEPEST_SINE = 0.9
_SHARE_TOLERANCE = 0.35


class GuideSeenWrongError(ValueError):
    """Two places that the guide's fiducials cannot have at once."""


@dataclass(frozen=True)
class OneFiducial:
    """One fiducial that goes with a stage and its two axes; what is judged is itself.

    name, judged_name: as the operator calls what is seen, and what is brought to its target.
    slice_positions_mm: along the slice normal, of each fiducial's slice; None: as the protocol has
    it. judged: (2, n) each, from the state to a point in the image plane that must be within the
    tolerance; the error is that of the first. worth_more_frames: up to this share of the tolerance
    in error another slice is worth more than a move.
    """

    name: ClassVar[str] = "fiducial"
    judged_name: ClassVar[str] = "fiducial"
    names: ClassVar[tuple[str, ...]] = ("fiducial",)
    slice_positions_mm: ClassVar[tuple[float | None, ...]] = (None,)
    judged: ClassVar[tuple[Array, ...]] = (np.eye(2),)
    worth_more_frames: ClassVar[float] = 0.6

    def reach_mm(self, move_um: float, position_gate_mm: float) -> float:
        """How far a fiducial may go with an axis of which nothing is known yet."""
        return move_um / 1000 * 1.3

    def check(self, jacobian: ImageJacobian) -> None:
        """Raise CalibrationError for an image Jacobian that these fiducials cannot have."""
        jacobian.check()


ONE_FIDUCIAL = OneFiducial()


@dataclass(frozen=True)
class GuideGeometry:
    """What is known of the guide beforehand; distances along it from the lower ball joint. See
    `OneFiducial` for what else there is of both.

    slice_positions_mm: along the slice normal, of the slices that show (upper, lower) fiducial.
    tip_beyond_mm: how far below the lower ball joint the needle's tip is judged.
    """

    upper_along_mm: float
    lower_along_mm: float
    joints_apart_mm: float
    slice_positions_mm: tuple[float, float]
    tip_beyond_mm: float = 80.0
    name: ClassVar[str] = "guide"
    judged_name: ClassVar[str] = "needle's tip"
    names: ClassVar[tuple[str, ...]] = ("upper", "lower")
    worth_more_frames: ClassVar[float] = np.inf

    def __post_init__(self) -> None:
        if not self.upper_along_mm > self.lower_along_mm > 0:
            raise ValueError("the upper fiducial must be above the lower one, both above the joint")

    @property
    def judged(self) -> tuple[Array, ...]:
        """The tip, and the lower fiducial."""
        return self.tip_from_fiducials, np.eye(4)[2:]

    @property
    def between_mm(self) -> float:
        return self.upper_along_mm - self.lower_along_mm

    @property
    def tip_from_fiducials(self) -> Array:
        """(2, 4): the tip in the image plane from the state, linear."""
        lever = (self.lower_along_mm + self.tip_beyond_mm) / self.between_mm
        return np.hstack([-lever * np.eye(2), (1 + lever) * np.eye(2)])

    def reach_mm(self, move_um: float, position_gate_mm: float) -> float:
        lever = max(1.0, self.upper_along_mm / self.joints_apart_mm)
        return max(position_gate_mm, 1.4 * lever * move_um / 1000)

    def check(self, jacobian: ImageJacobian) -> None:
        """Each stage must move each fiducial by the share of the lever that it must have.

        Two fiducials that were taken for each other, one that was lost, and an axis that does not
        move all show here.
        """
        matrix = jacobian.mean_columns
        alongs = (self.upper_along_mm, self.lower_along_mm)
        shares = np.array([along / self.joints_apart_mm for along in alongs])
        swapped = shares[::-1]
        found = np.array(
            [[np.linalg.norm(matrix[2 * f : 2 * f + 2, a]) for a in (0, 1)] for f in (0, 1)]
        )
        if np.all(np.abs(found - swapped[:, None]) < np.abs(found - shares[:, None])):
            raise CalibrationError(
                "the two fiducials appear to be swapped: check the slice positions of the upper "
                "and the lower one",
                "fiducials_swapped",
            )
        for number, axis in enumerate(jacobian.axes):
            for fiducial, (name, share) in enumerate(zip(self.names, shares, strict=True)):
                expected = abs(share if number < 2 else 1 - share)
                length = float(np.linalg.norm(matrix[2 * fiducial : 2 * fiducial + 2, number]))
                if not abs(length - expected) <= _SHARE_TOLERANCE:
                    raise CalibrationError(
                        f"axis {axis}: the {name} fiducial moved {length:.2f} mm per mm of "
                        f"setpoint, expected {expected:.2f}; did the robot move?"
                    )
        for pair in ((0, 1), (2, 3)):
            _check_angle(jacobian, pair, shares if pair == (0, 1) else 1 - shares)


Geometry = OneFiducial | GuideGeometry


def _check_angle(jacobian: ImageJacobian, pair: tuple[int, int], shares: Array) -> None:
    """Refuse two axes of one stage that move the guide along (nearly) one line."""
    matrix = jacobian.mean_columns
    # seen by the fiducial that this stage moves most
    rows = slice(0, 2) if abs(shares[0]) >= abs(shares[1]) else slice(2, 4)
    one, other = (matrix[rows, number] for number in pair)
    cosine = abs(float(one @ other)) / float(np.linalg.norm(one) * np.linalg.norm(other))
    angle_deg = float(np.degrees(np.arccos(min(1.0, cosine))))
    if not angle_deg >= SMALLEST_ANGLE_DEG:
        first, second = (jacobian.axes[number] for number in pair)
        raise CalibrationError(
            f"axes {first} and {second} move the guide along lines only {angle_deg:.0f}° apart, "
            f"expected at least {SMALLEST_ANGLE_DEG:.0f}°: are two axis cables swapped?"
        )


def judged_point(geometry: Geometry, estimate: FiducialEstimate) -> tuple[Array, Array]:
    """The point that is judged (2,) in the image plane, and its covariance (2, 2)."""
    lever = geometry.judged[0]
    return lever @ estimate.plane_mm, lever @ estimate.covariance_mm2 @ lever.T


def state_on_line(
    geometry: GuideGeometry, lower_joint_mm: Array, direction: Array, plane: ImagePlane
) -> Array:
    """The state (4,) of a guide whose lower joint and direction (patient mm, upwards) are given."""
    places = [
        plane.from_patient((lower_joint_mm + along * direction).tolist())
        for along in (geometry.upper_along_mm, geometry.lower_along_mm)
    ]
    return np.concatenate(places)


def line_of_state(
    geometry: GuideGeometry, state_mm: Array, plane: ImagePlane, lower_plane_mm: float
) -> NeedleLine:
    """The guide's line in patient mm (LPS), its point the lower ball joint, upwards.

    state_mm: (4,). lower_plane_mm: of the lower ball joint along the slice normal. Raises
    GuideSeenWrongError where the fiducials are further apart than they are on the guide.
    """
    across = (state_mm[:2] - state_mm[2:]) / geometry.between_mm
    sine = float(np.linalg.norm(across))
    if not sine < _STEEPEST_SINE:
        raise GuideSeenWrongError(
            f"the fiducials appear {sine * geometry.between_mm:.1f} mm apart in the slice plane, "
            f"which is impossible with {geometry.between_mm:.1f} mm between them on the guide"
        )
    upper_mm, lower_mm = geometry.slice_positions_mm
    along_normal = np.sign(upper_mm - lower_mm) * np.sqrt(1.0 - sine**2)
    direction = plane.direction(across) + along_normal * plane.normal
    foot = state_mm[2:] - geometry.lower_along_mm * across
    return NeedleLine(plane.direction(foot) + lower_plane_mm * plane.normal, direction)


@dataclass(frozen=True)
class NeedleSeen:
    """Where the needle is to go by the guide as it is seen; patient mm (LPS).

    joint_mm: the lower ball joint. tip_mm: `tip_below_joint_mm` below it on the guide's line.
    """

    joint_mm: tuple[float, float, float]
    tip_mm: tuple[float, float, float]
    tip_below_joint_mm: float

    def to_json(self) -> dict[str, Any]:
        return {
            "joint_mm": list(self.joint_mm),
            "tip_mm": list(self.tip_mm),
            "tip_below_joint_mm": self.tip_below_joint_mm,
        }


def needle_seen(
    geometry: Geometry, estimate: FiducialEstimate, plane: ImagePlane, lower_plane_mm: float
) -> NeedleSeen | None:
    """None of one fiducial: a point has no direction. Raises GuideSeenWrongError."""
    if isinstance(geometry, OneFiducial):
        return None
    line = line_of_state(geometry, estimate.plane_mm, plane, lower_plane_mm)
    joint_x, joint_y, joint_z = line.point_mm.tolist()
    x, y, z = line.at(-geometry.tip_beyond_mm).tolist()
    return NeedleSeen((joint_x, joint_y, joint_z), (x, y, z), geometry.tip_beyond_mm)


def geometry_from_json(value: Mapping[str, Any] | None) -> Geometry:
    """From what the record has: nothing of one fiducial."""
    if not value:
        return ONE_FIDUCIAL
    upper_mm, lower_mm = value["slice_positions_mm"]
    return GuideGeometry(**{**value, "slice_positions_mm": (upper_mm, lower_mm)})
