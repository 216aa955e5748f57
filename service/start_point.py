"""From where a procedure starts: what is known of the fiducial, carried to where the robot is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from case_record.record import CaseRecord
from service.calibration import Calibration
from service.estimate import MotionNoise

POSITION_DECLARED = "position_declared"
# what may have moved the robot unseen, or made its count another one, per axis
_UNSEEN_MOVE_MM = 5.0


def start_point(
    record: CaseRecord,
    calibration: Calibration,
    positions_um: Mapping[str, int],
    noise: MotionNoise,
) -> Calibration:
    """Return the calibration as it holds where the robot stands now.

    If anything happened since its last measurement, the fiducial's place is as good as unknown: a
    procedure that starts from it looks before it moves.
    """
    estimate = calibration.estimate
    here = dict(positions_um)
    if dict(estimate.setpoints_um) == here and is_untouched(record, calibration.measurement_id):
        return calibration
    moved = estimate.moved_to(here, calibration.jacobian, noise)
    unseen = np.eye(len(moved.plane_mm)) * _UNSEEN_MOVE_MM**2
    return replace(
        calibration, estimate=replace(moved, covariance_mm2=moved.covariance_mm2 + unseen)
    )


def is_untouched(record: CaseRecord, measurement_id: int) -> bool:
    """True if since this measurement there was no other one, no move, and no declared position.

    A robot that was restarted counts from zero wherever it stands: that its positions are the same
    numbers as before says nothing then.
    """
    newest = record.last_measurement("done")
    if newest is not None and newest.measurement_id != measurement_id:
        return False
    since_s = record.measurement(measurement_id).finished_s
    if since_s is None:
        return False
    declared = record.last_event(POSITION_DECLARED)
    if declared is not None and declared.wall_s > since_s:
        return False
    return all(move.sent_s <= since_s for move in record.moves())
