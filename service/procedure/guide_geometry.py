"""The guide as it is seen: two fiducials, the line through them, and where the needle's tip goes.

The state is (row, col) of the upper and (row, col) of the lower fiducial, mm in the image plane,
each seen in a slice of its own. The guide's direction along the slice normal follows from the known
distance between the fiducials. The tip is where the guide's line is `tip_beyond_mm` below the lower
ball joint; in the image plane it is linear in the state, so its covariance is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.procedure.estimate import FiducialEstimate
from service.procedure.kinematics import NeedleLine
from service.procedure.plane import ImagePlane

Array = NDArray[np.float64]
_STEEPEST_SINE = 0.9


class GuideSeenWrongError(ValueError):
    """Two places that the guide's fiducials cannot have at once."""


@dataclass(frozen=True)
class GuideGeometry:
    """What is known of the guide beforehand; distances along it from the lower ball joint.

    slice_positions_mm: along the slice normal, of the slices that show (upper, lower) fiducial.
    tip_beyond_mm: how far below the lower ball joint the needle's tip is judged.
    """

    upper_along_mm: float
    lower_along_mm: float
    joints_apart_mm: float
    slice_positions_mm: tuple[float, float]
    tip_beyond_mm: float = 80.0

    def __post_init__(self) -> None:
        if not self.upper_along_mm > self.lower_along_mm > 0:
            raise ValueError("the upper fiducial must be above the lower one, both above the joint")

    @property
    def between_mm(self) -> float:
        return self.upper_along_mm - self.lower_along_mm

    @property
    def tip_from_fiducials(self) -> Array:
        """(2, 4): the tip in the image plane from the state, linear."""
        lever = (self.lower_along_mm + self.tip_beyond_mm) / self.between_mm
        return np.hstack([-lever * np.eye(2), (1 + lever) * np.eye(2)])


def tip_of(geometry: GuideGeometry, estimate: FiducialEstimate) -> tuple[Array, Array]:
    """The tip (2,) in the image plane and its covariance (2, 2)."""
    lever = geometry.tip_from_fiducials
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
