"""Each fault does what its line in the table says, and nothing happens without one."""

import time
from datetime import datetime

import numpy as np
import pytest
from neighbours import Page, Receiver, Running, Stages, Start
from pydicom.dataset import Dataset

from simulator.faults import FAULTS, corrupt, distorted, jumped_clock_s, strike

ALWAYS = {"fault_probability": 1.0}


def arrivals(running: Running, receiver: Receiver, count: int) -> list[str]:
    """SOP instance UIDs in the order of arrival; nothing more comes in the half second after."""
    receiver.wait_for(count)
    time.sleep(0.5)
    return [str(dataset.SOPInstanceUID) for dataset in receiver.arrived]


def acquired(running: Running) -> list[str]:
    return [line["sop_instance_uid"] for line in running.truth()]


def test_without_a_fault_each_slice_comes_once_in_order_and_soon(
    start: Start, page: Page, receiver: Receiver
) -> None:
    running = start()
    page.ask_for("r1", count=4)
    assert arrivals(running, receiver, 4) == acquired(running)
    assert all(line["faults"] == [] for line in running.truth())
    assert receiver.arrived_at_s[-1] - receiver.arrived_at_s[0] < 2.0


def test_late_slices_come_seconds_after_their_reconstruction(
    start: Start, page: Page, receiver: Receiver
) -> None:
    running = start(faults=["late"], **ALWAYS)
    page.ask_for("r1")
    (line,) = running.wait_for_truth(1)
    receiver.wait_for(1)
    assert time.time() - line["ended_s"] > 1.9


def test_duplicates_are_the_same_bytes_under_the_same_uid(
    start: Start, page: Page, receiver: Receiver
) -> None:
    running = start(faults=["duplicate"], **ALWAYS)
    page.ask_for("r1")
    first, second = arrivals(running, receiver, 2)
    assert first == second
    assert receiver.arrived[0] == receiver.arrived[1]


def test_slices_out_of_order_come_after_the_one_that_was_acquired_later(
    start: Start, page: Page, receiver: Receiver
) -> None:
    running = start(faults=["out_of_order"], fault_probability=0.5, seed=4)
    page.ask_for("r1", count=6)
    running.wait_for_truth(6)
    came = arrivals(running, receiver, 6)
    order = acquired(running)
    assert sorted(came) == sorted(order), "nothing is lost"
    assert came != order
    for earlier, later in zip(running.truth(), running.truth()[1:], strict=False):
        if "out_of_order" in earlier["faults"] and "out_of_order" not in later["faults"]:
            uids = earlier["sop_instance_uid"], later["sop_instance_uid"]
            assert came.index(uids[0]) > came.index(uids[1])


def test_missing_slices_never_come_but_are_in_the_truth(
    start: Start, page: Page, receiver: Receiver
) -> None:
    running = start(faults=["missing"], fault_probability=0.5, seed=2)
    page.ask_for("r1", count=6)
    truth = running.wait_for_truth(6)
    kept = [line["sop_instance_uid"] for line in truth if "missing" not in line["faults"]]
    assert 0 < len(kept) < 6
    assert arrivals(running, receiver, len(kept)) == kept


def test_corrupted_slices_are_cut_short_or_overwritten_around_the_fiducial() -> None:
    kinds = set()
    for seed in range(12):
        rng = np.random.default_rng(seed)
        dataset = Dataset()
        dataset.Rows, dataset.Columns = 60, 80
        dataset.PixelData = np.zeros((60, 80), "<u2").tobytes()
        corrupt(dataset, (20.0, 50.0), rng)
        if len(dataset.PixelData) < 9600:
            kinds.add("short")
            assert len(dataset.PixelData) % 2 == 0
            continue
        kinds.add("overwritten")
        rows, cols = np.nonzero(np.frombuffer(dataset.PixelData, "<u2").reshape(60, 80))
        assert rows.min() <= 20 <= rows.max()
        assert cols.min() <= 50 <= cols.max()
        assert np.ptp(rows) <= 15
    assert kinds == {"short", "overwritten"}


def test_corrupted_slices_are_sent(start: Start, page: Page, receiver: Receiver) -> None:
    start(faults=["corrupted"], seed=1, **ALWAYS)
    page.ask_for("r1", count=6)
    arrived = receiver.wait_for(6)
    lengths = {len(dataset.PixelData) for dataset in arrived}
    assert any(length < 2 * 128 * 128 for length in lengths)
    assert 2 * 128 * 128 in lengths


def test_a_wrong_orientation_is_an_axial_slice(
    start: Start, page: Page, receiver: Receiver
) -> None:
    start(faults=["wrong_orientation"], **ALWAYS)
    page.ask_for("r1")
    (dataset,) = receiver.wait_for(1)
    assert list(dataset.ImageOrientationPatient) == [1, 0, 0, 0, 1, 0]


def test_the_clock_jumps_once(start: Start, page: Page, receiver: Receiver) -> None:
    running = start(faults=["clock_jump"], fault_probability=0.5, seed=9)
    page.ask_for("r1", count=6)
    arrived = receiver.wait_for(6)
    (jump,) = running.wait_for_truth(1, "clock_jump")
    offsets = [
        datetime.strptime(d.AcquisitionDateTime + "+0000", "%Y%m%d%H%M%S.%f%z").timestamp()
        - line["started_s"]
        for d, line in zip(arrived, running.truth(), strict=True)
    ]
    steps = np.diff([37.2, *offsets])
    assert np.count_nonzero(np.abs(steps) > 1) == 1
    assert steps[np.argmax(np.abs(steps))] == pytest.approx(jump["by_s"], abs=1e-4)


def test_clock_jumps_go_both_ways_from_seconds_to_an_hour() -> None:
    jumps = np.array([jumped_clock_s(np.random.default_rng(seed)) for seed in range(200)])
    assert (np.abs(jumps) >= 5).all()
    assert (np.abs(jumps) <= 3600).all()
    assert 60 < (jumps > 0).sum() < 140


def test_extra_series_come_with_the_slice(start: Start, page: Page, receiver: Receiver) -> None:
    running = start(faults=["extra_series"], **ALWAYS)
    page.ask_for("r1")
    arrived = receiver.wait_for(6)
    (line,) = running.wait_for_truth(1)
    wanted = next(d for d in arrived if d.SOPInstanceUID == line["sop_instance_uid"])
    others = [d for d in arrived if d is not wanted]
    assert len({d.SOPInstanceUID for d in arrived}) == 6
    assert wanted.SeriesInstanceUID not in {d.SeriesInstanceUID for d in others}
    types = sorted("\\".join(d.ImageType[2:]) for d in others)
    assert types == ["M\\DIS2D\\NORM", *["M\\ND\\LOCALIZER"] * 3, "P\\ND"]
    localizers = [d for d in others if "LOCALIZER" in d.ImageType]
    assert len({tuple(d.ImageOrientationPatient) for d in localizers}) == 3
    twin = next(d for d in others if "DIS2D" in d.ImageType)
    assert twin.AcquisitionNumber == wanted.AcquisitionNumber
    assert twin.AcquisitionDateTime == wanted.AcquisitionDateTime
    assert not np.array_equal(twin.pixel_array, wanted.pixel_array)


def test_a_distortion_correction_leaves_the_middle_and_moves_the_border() -> None:
    image = np.zeros((90, 120))
    image[44:47, 59:62] = image[5:8, 6:9] = 1000.0
    corrected = distorted(image)
    rows, cols = np.indices(image.shape)

    def centre(pixels: np.ndarray, top: slice, left: slice) -> np.ndarray:
        part = pixels[top, left]
        axes = rows[top, left], cols[top, left]
        return np.array([(part * axis).sum() / part.sum() for axis in axes])

    middle = slice(30, 60), slice(40, 80)
    corner = slice(0, 20), slice(0, 20)
    assert np.allclose(centre(corrected, *middle), centre(image, *middle), atol=0.02)
    assert np.linalg.norm(centre(corrected, *corner) - centre(image, *corner)) > 0.2


def test_motion_during_scan_is_an_acquisition_that_nobody_asked_for(
    start: Start, stages: Stages, page: Page, receiver: Receiver
) -> None:
    running = start(faults=["motion_during_scan"], **ALWAYS)
    page.wait_until_asked()
    assert running.truth() == []
    stages.go(0.5, xt=6.0, yt=0.0)
    running.wait_for_truth(2)
    time.sleep(0.5)  # the motion itself
    page.wait_until_asked(10)
    stopped = len(running.truth())
    page.wait_until_asked(20)
    truth = running.truth()
    assert len(truth) == stopped, "it ends with the motion"
    assert all(line["request_id"] is None for line in truth)
    assert any(line["travel_mm"] > 0.2 for line in truth)
    assert all(line["faults"] == ["motion_during_scan"] for line in truth)
    receiver.wait_for(stopped)


def test_faults_strike_as_often_as_stated_and_alike_for_the_same_seed() -> None:
    rng = np.random.default_rng(0)
    struck = [strike(FAULTS, 0.3, rng) for _ in range(1000)]
    for name in FAULTS:
        assert 240 < sum(name in faults for faults in struck) < 360
    again = np.random.default_rng(0)
    assert [strike(FAULTS, 0.3, again) for _ in range(1000)] == struck
    assert strike(FAULTS, 0.0, rng) == frozenset()
