"""A known UID with other bytes: a copy in another encoding is no alarm, anything else is one."""

import copy
import time

import numpy as np
import pytest
from made_slices import begin_hold, mr_data_set
from pydicom.dataset import Dataset
from pydicom.uid import ImplicitVRLittleEndian, RLELossless
from test_intake import Desk

from case_record.rows import SliceRow


@pytest.fixture
def desk(tmp_path):
    desk = Desk(tmp_path)
    yield desk
    desk.intake.close()
    desk.record.close()


def alarms(desk: Desk) -> list[str]:
    return [event.body["alarm"] for event in desk.record.events_of_kind("alarm")]


def received_twice(desk: Desk, first: Dataset, second: Dataset, syntax: str) -> list[SliceRow]:
    begin_hold(desk.record, time.time() - 5.0, expected=3)
    (before,) = desk.receive(first)
    (after,) = desk.receive(second, syntax)
    return [before, after]


def noisy() -> Dataset:
    made = mr_data_set("1.2.826.0.9", began_s=time.time() - 1)
    shape = (made.Rows, made.Columns)
    made.PixelData = np.random.default_rng(3).integers(0, 900, shape).astype("<u2").tobytes()
    return made


@pytest.mark.parametrize("syntax", [RLELossless, ImplicitVRLittleEndian])
def test_the_same_pixels_in_another_encoding_are_the_slice_that_is_known(desk, syntax):
    first = noisy()
    other = copy.deepcopy(first)
    if syntax == RLELossless:
        other.compress(RLELossless, generate_instance_uid=False)
    else:
        other.file_meta.TransferSyntaxUID = syntax
    before, after = received_twice(desk, first, other, syntax)
    assert before.state == "assigned"
    assert (after.state, after.reason_code) == ("quarantined", "same_slice_other_encoding")
    assert alarms(desk) == []
    assert (desk.record.case_dir / after.path).exists(), "nothing that was sent is lost"


def _moved(data: Dataset) -> None:
    data.ImagePositionPatient = [1.0, 2.0, 3.0]


def _brighter(data: Dataset) -> None:
    pixels = np.frombuffer(data.PixelData, "<u2").copy()
    pixels[7] += 1
    data.PixelData = pixels.tobytes()


def _longer(data: Dataset) -> None:
    data.AcquisitionDuration = 0.7


@pytest.mark.parametrize("change", [_moved, _brighter, _longer])
def test_anything_else_under_a_known_uid_is_an_alarm(desk, change):
    first = noisy()
    other = copy.deepcopy(first)
    change(other)
    other.compress(RLELossless, generate_instance_uid=False)
    _, after = received_twice(desk, first, other, RLELossless)
    assert after.reason_code == "same_uid_other_bytes"
    assert alarms(desk) == ["same_uid_other_bytes"]
