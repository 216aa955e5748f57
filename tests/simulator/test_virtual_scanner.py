"""The virtual scanner between a real HTTP server, a real C-STORE receiver and a truth server."""

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from neighbours import Page, Receiver, Stages, Start
from pydicom import dcmread

from dicom_slice.geometry import SliceGeometry
from simulator.config import VirtualRoom, VirtualRoomError
from simulator.mr_slice import acquire
from simulator.scan_operator import operate
from simulator.scene import true_fiducial_mm


def geometry_of(dataset: Any) -> SliceGeometry:
    return SliceGeometry.from_header(
        dataset.ImagePositionPatient,
        dataset.ImageOrientationPatient,
        dataset.PixelSpacing,
        (dataset.Rows, dataset.Columns),
    )


def fiducial_mm(dataset: Any) -> Any:
    """Where the bright sphere near the middle is, by its squared grey values."""
    pixels = dataset.pixel_array.astype(float)
    row, col = np.unravel_index(np.argmax(_smoothed(pixels)), pixels.shape)
    rows, cols = np.indices(pixels.shape)
    near = np.hypot(rows - row, cols - col) < 9
    weight = np.where(near & (pixels > 300), pixels, 0.0)
    centre = [(weight * rows).sum() / weight.sum(), (weight * cols).sum() / weight.sum()]
    return geometry_of(dataset).patient_from_pixel(centre)


def _smoothed(pixels: Any) -> Any:
    middle = np.zeros_like(pixels)
    middle[30:100, 30:100] = pixels[30:100, 30:100]
    return sum(np.roll(middle, (r, c), (0, 1)) for r in range(-2, 3) for c in range(-2, 3))


def test_it_acquires_what_the_page_asks_for_and_shows_the_fiducial_where_it_is(
    start: Start, stages: Stages, page: Page, receiver: Receiver
) -> None:
    stages.stand(xt=4.2, yt=-6.1)
    running = start()
    page.ask_for("r1", hold_id=7, count=3)
    arrived = receiver.wait_for(3)
    truth = running.wait_for_truth(3)
    assert [line["hold_id"] for line in truth] == [7, 7, 7]
    assert [line["sop_instance_uid"] for line in truth] == [d.SOPInstanceUID for d in arrived]
    assert [d.InstanceNumber for d in arrived] == [1, 2, 3]
    assert [d.AcquisitionNumber for d in arrived] == [1, 2, 3]
    assert len({d.SeriesInstanceUID for d in arrived}) == 1
    expected = true_fiducial_mm(running.room, {"xt": 4.2, "yt": -6.1})
    for dataset, line in zip(arrived, truth, strict=True):
        assert np.allclose(line["fiducials"]["upper"]["patient_mm"], expected)
        found = fiducial_mm(dataset)
        assert np.allclose(found[[0, 2]], expected[[0, 2]], atol=0.15)
    deliveries = running.wait_for_truth(3, "delivery")
    assert all(line["sent"] and line["attempts"] == 1 for line in deliveries)


def test_a_request_is_served_once_and_the_next_one_at_the_new_position(
    start: Start, stages: Stages, page: Page, receiver: Receiver
) -> None:
    running = start()
    page.ask_for("r1")
    receiver.wait_for(1)
    page.wait_until_asked(10)
    assert len(receiver.arrived) == 1
    stages.stand(xt=10.0, yt=0.0)
    page.ask_for("r2", hold_id=2)
    first, second = receiver.wait_for(2)
    moved = fiducial_mm(second) - fiducial_mm(first)
    assert np.linalg.norm(moved) == pytest.approx(10.03, abs=0.2)
    assert second.SeriesNumber > first.SeriesNumber
    assert [line["request_id"] for line in running.truth()] == ["r1", "r2"]


def test_the_slice_is_taken_where_it_is_asked_for(
    start: Start, page: Page, receiver: Receiver
) -> None:
    start()
    page.ask_for("r1", slice_position_mm=59.5)
    (dataset,) = receiver.wait_for(1)
    assert dataset.ImagePositionPatient[1] == pytest.approx(59.5)
    assert dataset.SliceLocation == pytest.approx(59.5)


@pytest.mark.parametrize(("offset_s", "zone_min"), [(37.2, 0), (-3600.5, 330), (0.0, -720)])
def test_the_scanners_clock_is_ours_plus_its_offset_and_reads_local_time(
    start: Start, page: Page, receiver: Receiver, offset_s: float, zone_min: int
) -> None:
    running = start({"clock_offset_s": offset_s, "utc_offset_min": zone_min})
    page.ask_for("r1")
    (dataset,) = receiver.wait_for(1)
    (line,) = running.wait_for_truth(1)
    stamp = datetime.strptime(
        dataset.AcquisitionDateTime + dataset.TimezoneOffsetFromUTC, "%Y%m%d%H%M%S.%f%z"
    ).timestamp()
    assert stamp - line["started_s"] == pytest.approx(offset_s, abs=1e-5)
    assert line["scanner_clock_s"] - line["started_s"] == pytest.approx(offset_s, abs=1e-5)
    assert dataset.AcquisitionDate + dataset.AcquisitionTime == dataset.AcquisitionDateTime
    assert dataset.AcquisitionDuration == pytest.approx(line["ended_s"] - line["started_s"])
    sign = "-" if zone_min < 0 else "+"
    hours, minutes = divmod(abs(zone_min), 60)
    assert dataset.TimezoneOffsetFromUTC == f"{sign}{hours:02d}{minutes:02d}"


def test_a_slice_taken_while_the_stages_move_is_marked_so_in_the_truth_and_is_smeared(
    start: Start, stages: Stages, page: Page, receiver: Receiver
) -> None:
    running = start({"acquisition_s": 1.0})
    page.ask_for("r1")
    receiver.wait_for(1)
    page.ask_for("r2")
    stages.go(3.0, xt=5.0, yt=5.0)
    slices = receiver.wait_for(2)
    truth = running.wait_for_truth(2)
    assert truth[0]["travel_mm"] == 0
    assert 1.0 < truth[1]["travel_mm"] < 3.0
    still, moving = (
        _distance_to_a_slice_of_a_standing_robot(running.room, line, dataset)
        for line, dataset in zip(truth, slices, strict=True)
    )
    assert still < 60, "noise of both slices: 33 times the root of two"
    assert moving > 2 * still


@pytest.mark.parametrize("sop_class", ["classic", "enhanced"])
def test_dcmtks_storescp_takes_the_slices(
    start: Start, page: Page, tmp_path: Path, sop_class: str
) -> None:
    if shutil.which("storescp") is None:
        pytest.skip("storescp (Debian package dcmtk) is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = tmp_path / "received"
    folder.mkdir()
    command = ["storescp", "-aet", "AUTOSPINE", "-od", str(folder), "-fe", ".dcm", str(port)]
    with subprocess.Popen(command) as storescp:
        try:
            _wait_until_somebody_listens(port)
            running = start({"listener_port": port, "sop_class": sop_class})
            page.ask_for("r1", count=3)
            deliveries = running.wait_for_truth(3, "delivery")
        finally:
            storescp.terminate()
    assert all(line["sent"] for line in deliveries)
    received = {dcmread(path).SOPInstanceUID for path in folder.glob("*.dcm")}
    assert received == {line["sop_instance_uid"] for line in running.truth()}


# pynetdicom leaves the socket of a refused connection to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_cannot_be_delivered_is_tried_again_in_order_until_somebody_listens(
    start: Start, page: Page, receiver: Receiver
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as hangs_up:
        hangs_up.settimeout(60)
        port = hangs_up.getsockname()[1]
        running = start({"listener_port": port})
        page.ask_for("r1", count=2)
        hangs_up.accept()[0].close()
    running.wait_for_truth(2)
    free = Receiver()
    server = free.start(port)
    try:
        arrived = free.wait_for(2)
        assert [d.InstanceNumber for d in arrived] == [1, 2]
        deliveries = running.wait_for_truth(2, "delivery")
        assert all(line["sent"] for line in deliveries)
        assert deliveries[0]["attempts"] > 1
    finally:
        server.shutdown()


def test_a_receiver_that_is_out_of_resources_gets_the_slice_again_and_one_that_refuses_does_not(
    start: Start, page: Page, receiver: Receiver
) -> None:
    receiver.statuses += [0xA700, 0xA700]
    running = start()
    page.ask_for("r1")
    receiver.wait_for(1)
    (delivery,) = running.wait_for_truth(1, "delivery")
    assert (delivery["sent"], delivery["attempts"]) == (True, 3)
    receiver.statuses += [0xC000]
    page.ask_for("r2")
    _, refused = running.wait_for_truth(2, "delivery")
    assert (refused["sent"], refused["attempts"], refused["status"]) == (False, 1, 0xC000)
    assert any(refused["sop_instance_uid"] in note for note in running.notes)


def test_a_service_that_cannot_be_understood_is_reported_once_and_asked_again(
    start: Start, page: Page, receiver: Receiver
) -> None:
    page.state = {"phase": "TARGETING"}
    running = start()
    page.wait_until_asked()
    assert [note for note in running.notes if "acquisition_request" in note] == [
        f"{page.url}: the state has no field 'acquisition_request'"
    ]
    page.status = 503
    page.wait_until_asked()
    page.status = 200
    page.ask_for("r1", count=0)
    running.wait_for_note("acquisition_request.count")
    page.ask_for("r1")
    receiver.wait_for(1)


def test_without_any_truth_nothing_is_acquired(start: Start, page: Page) -> None:
    with _unused_port() as port:
        running = start({"motors_truth_port": port})
        page.ask_for("r1")
        running.wait_for_note(f"truth at 127.0.0.1:{port}")
        page.wait_until_asked()
        assert running.truth() == []


def test_a_second_run_appends_to_the_truth_and_does_not_repeat_the_noise(
    start: Start, page: Page, receiver: Receiver
) -> None:
    running = start()
    page.ask_for("r1")
    receiver.wait_for(1)
    running.wait_for_truth(1, "delivery")
    page.state = {"acquisition_request": None}
    start()
    page.ask_for("r2")
    first, second = receiver.wait_for(2)[:2]
    assert len(running.truth()) >= 2
    assert not np.array_equal(first.pixel_array, second.pixel_array)


def test_a_truth_file_that_cannot_be_written_is_named(start: Start, tmp_path: Path) -> None:
    blocked = tmp_path / "a file"
    blocked.write_text("")
    room = VirtualRoom.model_validate(
        {
            "scanner": {
                "service_url": "http://127.0.0.1:9",
                "listener_port": 104,
                "motors_truth_port": 105,
                "truth_file": str(blocked / "truth.jsonl"),
            }
        }
    )
    with pytest.raises(VirtualRoomError, match=r"truth_file: .*a file"):
        operate(room, threading.Event(), lambda _: None)


def _distance_to_a_slice_of_a_standing_robot(
    room: VirtualRoom, line: dict[str, Any], dataset: Any
) -> float:
    """Root mean square difference near the fiducial, in grey values."""
    model = acquire(room, line["stage_mm"], np.random.default_rng(99)).magnitude
    row, col = np.rint(line["fiducials"]["upper"]["centre_px"]).astype(int)
    near = (slice(row - 7, row + 8), slice(col - 7, col + 8))
    return float(np.sqrt(np.mean((dataset.pixel_array[near] - model[near]) ** 2)))


def _wait_until_somebody_listens(port: int) -> None:
    deadline_s = time.monotonic() + 60
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return
        except ConnectionRefusedError:
            assert time.monotonic() < deadline_s
            time.sleep(0.02)


@contextmanager
def _unused_port() -> Iterator[int]:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield taken.getsockname()[1]
