"""Where the guide is now: as it was measured here, or as the robot has carried it since."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from case_record.record import CaseRecord
from room_config.load import Config
from service.procedure.arguments import gate_of, geometry_of
from service.procedure.fiducials import GuideSeenWrongError, line_of_state
from service.procedure.registry import latest_calibration
from service.room.state import ArrivalState, RoomState
from service.room.validity import Now, why_not_carried, why_not_now
from service.slicer.messages import INVALID, TRANSFORM_STATUS, VALID, Message, transform
from service.slicer.scene import axes_along, standing

Array = NDArray[np.float64]
CURRENT_POSITION = "CURRENT_POSITION"
_RAS_AXES = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Pose:
    """axes (3, 3) as columns and origin (3,), LPS mm. of: what the origin is, `needle tip`,
    `lower ball joint` or `fiducial`. measured: here; else predicted from the setpoints.
    """

    axes: Array
    origin_mm: Array
    of: str
    sigma_mm: float
    measured: bool

    def message(self, device: str, at_s: float) -> Message:
        meta = {
            TRANSFORM_STATUS: VALID,
            "Origin": self.of,
            "PoseSource": "measured" if self.measured else "predicted",
            "SigmaMm": f"{self.sigma_mm:.3f}",
        }
        return transform(device, at_s, self.axes, self.origin_mm, meta)


def pose_message(pose: Pose | None, at_s: float) -> Message:
    """The pose as a device of the scene; withdrawn where nobody knows it."""
    if pose is None:
        return transform(
            CURRENT_POSITION, at_s, np.eye(3), np.zeros(3), {TRANSFORM_STATUS: INVALID}
        )
    return pose.message(CURRENT_POSITION, at_s)


def pose_of(
    state: RoomState, record: CaseRecord | None, config: Config, present: Now
) -> Pose | None:
    """None where nobody knows: not calibrated, or more than a move has happened since it was seen.
    present: how things stand beside the record.

    With two fiducials the origin is the lower ball joint, at READY the needle's tip; with one it is
    the fiducial, and the axes are the patient's: one point has no direction.
    """
    now = standing(state)
    if now.arrival is not None and now.arrival.tip_mm is not None:
        return _arrived(now.arrival)
    seen = now.measurement
    if seen is not None and config.service.guide is None:
        sigma_mm = float(np.sqrt(np.trace(np.array(seen.covariance_mm2 or np.zeros((2, 2)))) / 2))
        return Pose(_RAS_AXES, np.array(seen.patient_mm), "fiducial", sigma_mm, True)
    if record is None or not state.robot.linked:
        return None
    return _carried(state, record, config, present)


def _arrived(arrival: ArrivalState) -> Pose:
    tip, joint = np.array(arrival.tip_mm), np.array(arrival.joint_mm)
    along = (tip - joint) / np.linalg.norm(tip - joint)
    return Pose(axes_along(along), tip, "needle tip", arrival.sigma_mm, True)


def _carried(state: RoomState, record: CaseRecord, config: Config, present: Now) -> Pose | None:
    guide = config.service.guide
    known = latest_calibration(record, guide=guide is not None)
    if known is None or present.status is None:
        return None
    here = dict(present.status.positions_um)
    measurement, newest = record.measurement(known.measurement_id), record.last_measurement("done")
    is_newest = newest is not None and newest.measurement_id == known.measurement_id
    if not (is_newest or state.procedure) or not set(known.jacobian.axes) <= set(here):
        return None  # it was looked again since, and no procedure says what that means
    if why_not_carried(record, measurement, present) is not None:
        return None
    estimate = known.estimate.moved_to(here, known.jacobian, gate_of(config).noise)
    measured = why_not_now(record, measurement, present) is None
    sigma_mm = float(np.sqrt(np.trace(estimate.covariance_mm2) / len(estimate.plane_mm)))
    if guide is None:
        seen = measurement.result or {}
        depth = float(known.plane.normal @ np.array(seen["patient_mm"])) * known.plane.normal
        place = known.plane.direction(estimate.plane_mm) + depth
        return Pose(_RAS_AXES, place, "fiducial", sigma_mm, measured)
    try:
        line = line_of_state(
            geometry_of(guide), estimate.plane_mm, known.plane, guide.lower_plane_mm
        )
    except GuideSeenWrongError:
        return None
    axes = axes_along(-np.array(line.direction))
    return Pose(axes, np.array(line.point_mm), "lower ball joint", sigma_mm, measured)
