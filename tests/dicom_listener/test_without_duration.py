"""Slices whose header gives no duration go all the way to a measurement."""

import time

import numpy as np
import pytest
from made_slices import begin_hold, mr_data_set
from real_slices import DICOM, manifest
from test_intake import Desk

from dicom_listener.clock_offset import Comparison
from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.header import read_header
from dicom_slice.reasons import UnusableError
from sr_engine.simulate import render_disc, rician
from sr_engine.worker import measure

REQUEST = {
    "expected_plane_mm": None,
    "gate_mm": None,
    "shift_sigma_mm": 0.0,
    "slice_position_mm": None,
    "radius_mm": [2.5, 6.5],
    "region_px": None,
}


@pytest.fixture
def desk(tmp_path):
    made = Desk(tmp_path)
    made.record.start_case("a case", 0)
    yield made
    made.intake.close()
    made.record.close()


def measured(desk: Desk, hold_id: int):
    holds = [{"hold_id": hold_id, "shift_mm": [0, 0]}]
    number = desk.record.request_measurement("ml", [hold_id], {**REQUEST, "holds": holds})
    measure(desk.record, desk.record.measurement(number), 2)
    return desk.record.measurement(number)


def test_a_3d_slice_without_a_duration_is_assigned_and_measured(desk):
    hold_id = begin_hold(desk.record, time.time() - 120.0)
    data_set = mr_data_set(began_s=time.time() - 5.0)
    del data_set.AcquisitionDuration
    data_set.MRAcquisitionType = "3D"
    frame = rician(render_disc((128, 128), (60.3, 64.2), 4.0), 1 / 30, np.random.default_rng(0))
    data_set.Rows, data_set.Columns = frame.shape
    data_set.PixelData = np.rint(1000 * frame).astype("<u2").tobytes()
    (row,) = desk.receive(data_set)
    assert (row.state, row.header["interval"]["end_s"]) == ("assigned", None)
    done = measured(desk, hold_id)
    assert done.state == "done", done.reason
    assert done.result["centre_px"] == pytest.approx([60.3, 64.2], abs=0.1)
    assert done.result["scan_s"] == 0.0


def without_duration() -> list[str]:
    """Real files that are used and say nothing of how long they took."""
    found = []
    for row in manifest():
        try:
            slices = read_header(DICOM / row["path"])
        except UnusableError:
            continue
        usable = [s for s in slices if why_not_usable(s, SliceRules(None)) is None]
        if any(s.interval is not None and s.interval.end_s is None for s in usable):
            found.append(row["path"])
    return found


@pytest.mark.parametrize("path", without_duration())
def test_a_real_slice_without_a_duration_ends_in_a_measurement_or_in_the_engines_reason(
    tmp_path, path
):
    (first, *_) = (s for s in read_header(DICOM / path) if s.interval is not None)
    received_s = time.time()
    offset_s = received_s - 5.0 - first.interval.start_s
    desk = Desk(
        tmp_path,
        slices=SliceRules(coronal_tolerance_deg=None),
        comparison=Comparison(offset_s, 0.1, received_s),
    )
    desk.record.start_case("a case", 0)
    hold_id = begin_hold(desk.record, received_s - 120.0, expected=1)
    whole = (DICOM / path).read_bytes()
    start = 144 + int.from_bytes(whole[140:144], "little")
    rows = desk.receive(
        whole[start:],
        first.transfer_syntax_uid,
        sop_instance_uid=first.sop_instance_uid,
        sop_class_uid=first.sop_class_uid,
        received_s=received_s,
    )
    assert "assigned" in {row.state for row in rows}, [row.reason for row in rows]
    ended = measured(desk, hold_id)
    assert ended.state in ("done", "failed")
    assert ended.state == "done" or not ended.reason.startswith("the measurement could not be made")
    desk.intake.close()
    desk.record.close()
