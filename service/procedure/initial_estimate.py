"""From where a procedure starts: what is known of the fiducial, carried to where the robot is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from case_record.record import CaseRecord
from case_record.rows import Measurement
from service.procedure.calibration import Calibration
from service.procedure.estimate import MotionNoise
from service.procedure.scan_frame import (
    frame_of,
    newest_frame,
    other_place_since,
    others_since,
    seen_seq,
)

POSITION_DECLARED = "position_declared"
# what may have moved the robot unseen, or made its count another one, per axis
_UNSEEN_MOVE_MM = 5.0


def start_point(
    record: CaseRecord,
    calibration: Calibration,
    positions_um: Mapping[str, int],
    noise: MotionNoise,
    *,
    stood: bool = True,
) -> Calibration:
    """Return the calibration as it holds where the robot stands now.

    stood: as far as the robot's bridge knows, it has not moved since the last measurement. If
    anything happened since then, the fiducial's place is as good as unknown: a
    procedure that starts from it looks before it moves.
    """
    estimate = calibration.estimate
    here = dict(positions_um)
    if (
        stood
        and dict(estimate.setpoints_um) == here
        and is_untouched(record, calibration.measurement_id)
    ):
        return calibration
    moved = estimate.moved_to(here, calibration.jacobian, noise)
    unseen = np.eye(len(moved.plane_mm)) * _UNSEEN_MOVE_MM**2
    return replace(
        calibration, estimate=replace(moved, covariance_mm2=moved.covariance_mm2 + unseen)
    )


def is_proven(record: CaseRecord, start: Calibration, positions_um: Mapping[str, int]) -> bool:
    """True if the fiducial of this start was seen to move with the robot, and nothing since speaks
    against it: it stands where it was seen, was not lost, and is in the same scan.

    Every procedure that comes to its end ends with a fiducial that is proven, see `identity`.
    """
    here = dict(start.estimate.setpoints_um) == dict(positions_um)
    if not here or not is_untouched(record, start.measurement_id):
        return False
    newest = record.last_measurement()
    return newest is not None and newest.measurement_id == start.measurement_id


def is_untouched(record: CaseRecord, measurement_id: int) -> bool:
    """True if since this measurement there was no other one, no move, no declared position, and
    no slice of another study, frame of reference or protocol.

    A robot that was restarted counts from zero wherever it stands: that its positions are the same
    numbers as before says nothing then.
    """
    newest = record.last_measurement("done")
    if newest is not None and newest.measurement_id != measurement_id:
        return False
    measurement = record.measurement(measurement_id)
    since = measurement.requested_seq
    if not measurement.finished_seq or _is_another_scan(record, measurement):
        return False
    declared = record.last_event(POSITION_DECLARED)
    if declared is not None and declared.seq > since:
        return False
    return record.last_sent_seq() <= since


def _is_another_scan(record: CaseRecord, measurement: Measurement) -> bool:
    frame, newest = frame_of(record, measurement), newest_frame(record)
    if frame is None or newest is None:
        return False
    since = seen_seq(record, measurement)
    return bool(
        frame.other_protocol(newest)
        or other_place_since(record, since, frame)
        or others_since(record, since)
    )


def positions_to_declare(record: CaseRecord, positions_um: Mapping[str, int]) -> dict[str, int]:
    """Where axes are taken to stand after a restart, each by its own count, or by the record.

    positions_um: the counts of the axes in question. Controllers without encoders that were
    switched off count from zero wherever they stand. Were that taken for the truth, the travel
    limits would wander with every restart. So where a count is zero and the record knows better,
    the record is believed; of a move that came to no end, half of it. It is a guess either way.
    """
    holds, moves = record.holds(), record.moves()
    if not holds:
        return dict(positions_um)
    known = dict(holds[-1].readback_um)
    last = moves[-1] if moves else None
    if last is not None and last.ended_s is None and last.sent_seq > holds[-1].begun_seq:
        if all(setpoint_um == 0 for setpoint_um in last.setpoints_um.values()):
            return dict(positions_um)  # it may well be there
        known = {
            axis: (at_um + last.setpoints_um.get(axis, at_um)) // 2 for axis, at_um in known.items()
        }
    return {axis: at_um or known.get(axis, at_um) for axis, at_um in positions_um.items()}
