"""Where things truly are: the fiducials in the patient frame for given stage positions."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.procedure.kinematics import NeedleLine
from simulator.config import Fiducial, Placement, VirtualRoom

Floats = NDArray[np.float64]

# Robot x is patient left, robot y inferior, robot z posterior: the robot stands on the back.
_NOMINAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Affine:
    """to = linear · from + offset_mm."""

    linear: Floats
    offset_mm: Floats

    def __call__(self, points_mm: Floats) -> Floats:
        """Points (..., 3) in mm."""
        return np.asarray(points_mm, dtype=float) @ self.linear.T + self.offset_mm


def patient_from_robot(placement: Placement) -> Affine:
    """How the robot stands: a rigid map, robot mm to patient LPS mm."""
    in_plane = _rotation(2, placement.rotation_deg)
    tilt = _rotation(0, placement.tilt_deg[0]) @ _rotation(2, placement.tilt_deg[1])
    return Affine(tilt @ _NOMINAL @ in_plane, np.array(placement.origin_mm))


def _rotation(axis: int, angle_deg: float) -> Floats:
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = cos
    matrix[first, second], matrix[second, first] = -sin, sin
    return matrix


def fiducial_in_robot_mm(
    fiducial: Fiducial, placement: Placement, stage_mm: Mapping[str, float]
) -> Floats:
    """Centre of one fiducial in the robot frame. Missing bottom axes stand at 0.

    The cannula is fixed in the lower ball joint and slides in the upper one, so a fiducial on the
    guide stays at its distance from the lower joint whatever the guide's angle.
    """
    top = _ball_joint_mm(placement, stage_mm["xt"], stage_mm["yt"], placement.top_plane_mm)
    if fiducial.mount == "top_stage":
        return top + np.array(fiducial.offset_mm)
    xb, yb = stage_mm.get("xb", 0.0), stage_mm.get("yb", 0.0)
    bottom = _ball_joint_mm(placement, xb, yb, placement.bottom_plane_mm)
    guide = top - bottom
    return bottom + fiducial.along_guide_mm * guide / np.linalg.norm(guide)


def _ball_joint_mm(placement: Placement, x_mm: float, y_mm: float, plane_mm: float) -> Floats:
    """Robot frame; x and y are on the stages' own scales, whose axes are not quite square."""
    skew = np.radians(placement.skew_deg)
    along_x, along_y = placement.scale[0] * x_mm, placement.scale[1] * y_mm
    return np.array([along_x + np.sin(skew) * along_y, np.cos(skew) * along_y, plane_mm])


def true_fiducials_mm(room: VirtualRoom, stage_mm: Mapping[str, float]) -> dict[str, Floats]:
    """Name of each fiducial → centre (3,) in patient LPS mm, for the true stage positions in mm."""
    to_patient = patient_from_robot(room.placement)
    return {
        fiducial.name: to_patient(fiducial_in_robot_mm(fiducial, room.placement, stage_mm))
        for fiducial in room.fiducials
    }


def true_fiducial_mm(room: VirtualRoom, stage_mm: Mapping[str, float]) -> Floats:
    """Centre (3,) of the first fiducial in patient LPS mm."""
    return true_fiducials_mm(room, stage_mm)[room.fiducials[0].name]


def true_guide(room: VirtualRoom, stage_mm: Mapping[str, float]) -> NeedleLine:
    """The guide's line in patient LPS mm, its point the lower ball joint, upwards.

    For rooms whose fiducials are on the guide: of the first two, the one further along is above.
    """
    above, below = sorted(
        (one for one in room.fiducials if one.mount == "guide"),
        key=lambda one: -one.along_guide_mm,
    )[:2]
    places = true_fiducials_mm(room, stage_mm)
    line = NeedleLine.through(places[below.name], places[above.name])
    return NeedleLine(line.at(-below.along_guide_mm), line.direction)
