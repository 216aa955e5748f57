"""The worker's point spread: recognised or configured, recorded, and used again by a replay.

Slices are DICOM files of the virtual room with a filter over k-space.
"""

import numpy as np
import pytest

from case_record.record import CaseRecord
from room_config.imaging import PointSpreadConfig
from service.cli.replay import replay_measurements
from service.procedure.steps import Acquire, HoldShift, Measure
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from sr_engine.request import PointSpreads
from sr_engine.worker import Known, measure
from studies.offline_room import MrImaging
from studies.recorded_room import RecordedRoom

FILTERED = VirtualRoom.model_validate({"protocol": {"window": "hamming"}})


@pytest.fixture
def room(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        yield RecordedRoom(record, MrImaging(FILTERED), StageParameters(), 3)


def measured(room, psfs=None):
    """The record's row of one measurement of four slices where the robot stands."""
    hold = room.record.open_hold()
    room.execute(Acquire(4))
    step = Measure((HoldShift(hold.hold_id, (0.0, 0.0)),), "ml")
    room.execute(step)
    number = room.record.last_measurement().measurement_id
    if psfs is not None:
        again = room.record.measurement(number)
        number = room.record.request_measurement("ml", again.hold_ids, again.request)
        measure(room.record, room.record.measurement(number), 2, Known(psfs))
    return room.record.measurement(number)


def test_the_scanners_filter_is_recognised_and_recorded(room):
    row = measured(room)
    assert row.result["point_spread"]["kind"] == "hamming"
    assert row.result["point_spread"]["acquired"] == [1.0, 1.0]


def test_a_replay_measures_with_the_recorded_point_spread(room):
    configured = PointSpreads(PointSpreadConfig(kind="flat"))
    recognised, forced = measured(room), measured(room, configured)
    apart_mm = np.linalg.norm(
        np.subtract(recognised.result["covariance_mm2"], forced.result["covariance_mm2"])
    )
    assert apart_mm > 0, "the two point spreads make a difference"
    again = list(replay_measurements(room.record, None))
    assert [row.difference_mm for row in again] == [0.0, 0.0, 0.0]


def test_a_configured_point_spread_is_taken_as_it_is(room):
    configured = PointSpreadConfig(kind="fermi", parameters=(0.8, 0.1), acquired=(0.75, 1.0))
    row = measured(room, PointSpreads(configured))
    assert row.result["point_spread"] == {
        "kind": "fermi",
        "parameters": [0.8, 0.1],
        "acquired": [0.75, 1.0],
    }
