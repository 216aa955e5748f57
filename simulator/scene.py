"""Where things truly are: the fiducials in the patient frame for given stage positions."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    """The placement as an affine map, robot mm to patient LPS mm; the planes stay `z` of the robot."""
    skew = np.radians(placement.skew_deg)
    axes = np.array([[1.0, np.sin(skew), 0.0], [0.0, np.cos(skew), 0.0], [0.0, 0.0, 1.0]])
    in_plane = _rotation(2, placement.rotation_deg)
    tilt = _rotation(0, placement.tilt_deg[0]) @ _rotation(2, placement.tilt_deg[1])
    linear = tilt @ _NOMINAL @ in_plane @ axes @ np.diag([*placement.scale, 1.0])
    return Affine(linear, np.array(placement.origin_mm))


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
    top = np.array([stage_mm["xt"], stage_mm["yt"], placement.top_plane_mm])
    if fiducial.mount == "top_stage":
        return top + np.array(fiducial.offset_mm)
    bottom = np.array([stage_mm.get("xb", 0.0), stage_mm.get("yb", 0.0), placement.bottom_plane_mm])
    guide = top - bottom
    return bottom + fiducial.along_guide_mm * guide / np.linalg.norm(guide)


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
