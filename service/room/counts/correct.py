"""Tells the bridge, after every procedure that looked, what the images say of its counts."""

from __future__ import annotations

from case_record.record import CaseRecord
from robot_bridge.client.client import BridgeError, BridgeStatus
from service.procedure.calibration import Calibration
from service.procedure.plan import SAME_PLACE_UM
from service.room.counts.look import Look, corrections, is_comparable, look_of
from service.room.link import RoomLink

STAGE_REFERENCE = "stage_reference"
COUNT_CORRECTED = "count_corrected"
_SERVICE = "service"


def correct_counts(record: CaseRecord, link: RoomLink, calibration: Calibration) -> None:
    """What was seen at the end of a procedure, against the reference that is in the record."""
    status = link.status
    if status is None or not _stands_where_it_was_seen(status, calibration):
        return
    here = look_of(calibration, status.positions_um, status.correction_um, status.bound_um)
    event = record.last_event(STAGE_REFERENCE)
    reference = None if event is None else Look.from_json(event.body)
    found = None
    if reference is not None and is_comparable(reference, here):
        found = corrections(reference, here, calibration)
    if found is None:
        record.append_event(STAGE_REFERENCE, here.to_json(), source=_SERVICE)
        return
    correction_um, within_um = found
    if not correction_um:
        return
    try:
        link.client.correct_position(correction_um, within_um, based_on_motion=status.last_motion)
    except BridgeError:
        return  # known no better than before; the next look says it again
    body = {"correction_um": correction_um, "within_um": within_um}
    record.append_event(COUNT_CORRECTED, body, source=_SERVICE)


def _stands_where_it_was_seen(status: BridgeStatus, calibration: Calibration) -> bool:
    if status.moving:
        return False
    return all(
        axis in status.certain_axes
        and axis in status.bound_um
        and abs(status.positions_um[axis] - at_um) <= SAME_PLACE_UM
        for axis, at_um in calibration.estimate.setpoints_um.items()
    )
