"""The virtual scanner's files against the standard, by three independent readers."""

import shutil
import subprocess
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_standard import violations
from hypothesis import given
from hypothesis import strategies as st
from pydicom import dcmread
from pydicom.dataset import Dataset

from dicom_slice.geometry import SliceGeometry
from simulator.config import SliceProtocol, VirtualRoom, parse_virtual_room
from simulator.dicom_writer import AcquisitionStamp, Series, Study, ds_values, write_mr_image
from simulator.enhanced_writer import write_enhanced_mr_image
from simulator.faults import phase_of
from simulator.mr_slice import AcquiredSlice, acquire

NOW_S = 1_790_000_000.123456


def room(scanner: dict[str, Any] | None = None, **protocol: Any) -> VirtualRoom:
    table = {
        "service_url": "http://127.0.0.1:1",
        "listener_port": 104,
        "motors_truth_port": 105,
        "truth_file": "truth.jsonl",
        **(scanner or {}),
    }
    return parse_virtual_room({"scanner": table, "protocol": {"shape": [96, 128], **protocol}})


def seen_in(room: VirtualRoom) -> AcquiredSlice:
    return acquire(room, {"xt": 1.0, "yt": 2.0}, np.random.default_rng(1))


def image(
    room: VirtualRoom, pixels: Any = None, image_type: tuple[str, ...] = ("M", "ND", "NORM")
) -> Dataset:
    seen = seen_in(room)
    assert room.scanner is not None
    enhanced = room.scanner.sop_class == "enhanced"
    return (write_enhanced_mr_image if enhanced else write_mr_image)(
        seen.magnitude if pixels is None else pixels,
        seen.geometry,
        protocol=room.protocol,
        scanner=room.scanner,
        study=Study.new(NOW_S),
        series=Series.new(3, "fl2d_cor", image_type, NOW_S),
        stamp=AcquisitionStamp(NOW_S, 0.25, 17, 2, NOW_S + 0.4),
    )


VARIANTS = {
    "as it is": ({}, {}),
    "not square": ({}, {"spacing_mm": [0.9765625, 1.30208337306976], "phase_encoding": "ROW"}),
    "axial": ({}, {"orientation": "axial"}),
    "filtered": ({}, {"window": "hamming"}),
    "date and time": ({"time_attributes": "date_and_time", "write_timezone": False}, {}),
    "datetime": ({"time_attributes": "datetime"}, {}),
    "enhanced": ({"sop_class": "enhanced"}, {"phase_encoding": "ROW", "window": "fermi"}),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_images_conform_to_the_standard(variant: str, tmp_path: Path) -> None:
    scanner, protocol = VARIANTS[variant]
    dataset = image(room(scanner, **protocol))
    path = tmp_path / "slice.dcm"
    dataset.save_as(path, enforce_file_format=True)
    # The tables name functional groups that exclude each other: those are left to dciodvfy.
    found = [line for line in violations(dcmread(path)) if "functional-groups" not in line]
    assert found == []


def test_the_validator_sees_what_is_missing() -> None:
    dataset = image(room())
    del dataset.ImageType
    del dataset.ScanOptions
    dataset.Modality = ""
    del dataset.FrameOfReferenceUID
    found = " ".join(violations(dataset))
    for tag in ("0008,0008", "0018,0022", "0008,0060", "0020,0052"):
        assert tag in found


@pytest.mark.parametrize("variant", VARIANTS)
def test_dciodvfy_finds_no_error(variant: str, tmp_path: Path) -> None:
    if shutil.which("dciodvfy") is None:
        pytest.skip("dciodvfy (Debian package dicom3tools) is not installed")
    scanner, protocol = VARIANTS[variant]
    path = tmp_path / "slice.dcm"
    image(room(scanner, **protocol)).save_as(path, enforce_file_format=True)
    said = subprocess.run(["dciodvfy", str(path)], capture_output=True, text=True).stderr
    assert "MRImage" in said, "EnhancedMRImage or MRImage: it knew what to check"
    assert [line for line in said.splitlines() if line.startswith("Error")] == []


def test_dcmtk_reads_the_file_as_it_was_meant(tmp_path: Path) -> None:
    if shutil.which("dcmdump") is None:
        pytest.skip("dcmdump (Debian package dcmtk) is not installed")
    path = tmp_path / "slice.dcm"
    image(room({"utc_offset_min": 120})).save_as(path, enforce_file_format=True)
    done = subprocess.run(["dcmdump", "-v", str(path)], capture_output=True, text=True)
    assert done.returncode == 0
    assert "W:" not in done.stdout + done.stderr
    assert "E:" not in done.stdout + done.stderr
    dump = done.stdout
    stamp = time.strftime("%Y%m%d%H%M%S", time.gmtime(NOW_S + 7200))
    assert f"DT [{stamp}.123456]" in dump
    assert "SH [+0200]" in dump
    assert "IS [17]" in dump
    assert r"[1.0\0.0\0.0\0.0\0.0\-1.0]" in dump
    assert "(0018,9073) FD 0.25" in dump


def test_geometry_and_pixels_come_back_from_the_file(tmp_path: Path) -> None:
    virtual = room(spacing_mm=[0.9765625, 1.30208337306976])
    path = tmp_path / "slice.dcm"
    image(virtual).save_as(path, enforce_file_format=True)
    read = dcmread(path)
    geometry = SliceGeometry.from_header(
        read.ImagePositionPatient,
        read.ImageOrientationPatient,
        read.PixelSpacing,
        (read.Rows, read.Columns),
    )
    meant = seen_in(virtual)
    corner_px = [95.0, 127.0]
    assert np.allclose(
        geometry.patient_from_pixel(corner_px),
        meant.geometry.patient_from_pixel(corner_px),
        atol=1e-9,
    )
    assert np.abs(read.pixel_array - meant.magnitude).max() <= 0.5


def test_repetition_time_and_steps_give_the_duration_of_the_acquisition() -> None:
    for encoding, steps in (("COL", 96), ("ROW", 128)):
        dataset = image(room(phase_encoding=encoding))
        assert dataset.NumberOfPhaseEncodingSteps == steps
        assert float(dataset.RepetitionTime) * steps / 1000 == pytest.approx(0.25)
        assert dataset.InPlanePhaseEncodingDirection == encoding


def test_a_phase_image_says_that_it_is_one_and_keeps_radians() -> None:
    virtual = room()
    phase = phase_of(seen_in(virtual).signal)
    dataset = image(virtual, phase, ("P", "ND"))
    assert list(dataset.ImageType) == ["ORIGINAL", "PRIMARY", "P", "ND"]
    slope, intercept = float(dataset.RescaleSlope), float(dataset.RescaleIntercept)
    assert np.abs(dataset.pixel_array * slope + intercept - phase).max() < slope
    # MR images have no modality LUT in the standard; vendors extend it by just these three.
    extended = [line for line in violations(dataset) if "(0028,105" not in line]
    assert extended == []


def test_times_that_a_scanner_does_not_write_are_absent() -> None:
    only = image(room({"time_attributes": "datetime", "write_timezone": False}))
    assert "AcquisitionDateTime" in only
    assert "AcquisitionTime" not in only
    assert "TimezoneOffsetFromUTC" not in only
    split = image(room({"time_attributes": "date_and_time"}))
    assert "AcquisitionDateTime" not in split
    assert split.AcquisitionTime.endswith(".123456")
    assert float(split.ContentTime) > float(split.AcquisitionTime)


@given(st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=6))
def test_decimal_strings_fit_sixteen_characters_and_keep_the_micrometre(
    values: list[float],
) -> None:
    written = ds_values(values)
    assert all(len(text) <= 16 for text in written)
    assert "-0.0" not in written
    assert np.allclose([float(text) for text in written], values, rtol=0, atol=1e-6)


def test_saturated_pixels_are_clipped_to_twelve_bits() -> None:
    dataset = image(room(stored_per_signal=1e5))
    assert dataset.pixel_array.max() == 4095
    assert dataset.LargestImagePixelValue == 4095
    assert SliceProtocol().stored_per_signal * 1.5 < 4095, "not at the default"


def test_an_enhanced_image_says_frame_by_frame_what_a_classic_one_says_for_all() -> None:
    virtual = room({"sop_class": "enhanced"}, spacing_mm=[0.9, 1.1])
    classic, enhanced = image(room(spacing_mm=[0.9, 1.1])), image(virtual)
    shared = enhanced.SharedFunctionalGroupsSequence[0]
    (frame,) = enhanced.PerFrameFunctionalGroupsSequence
    assert shared.PixelMeasuresSequence[0].PixelSpacing == classic.PixelSpacing
    orientation = shared.PlaneOrientationSequence[0].ImageOrientationPatient
    assert orientation == classic.ImageOrientationPatient
    assert frame.PlanePositionSequence[0].ImagePositionPatient == classic.ImagePositionPatient
    content = frame.FrameContentSequence[0]
    assert content.FrameAcquisitionDateTime == classic.AcquisitionDateTime
    assert content.FrameAcquisitionDuration == pytest.approx(250.0)
    begin, middle = (
        datetime.strptime(text, "%Y%m%d%H%M%S.%f")
        for text in (content.FrameAcquisitionDateTime, content.FrameReferenceDateTime)
    )
    assert (middle - begin).total_seconds() == pytest.approx(0.125, abs=1e-6)
    assert "ImagePositionPatient" not in enhanced
    assert np.array_equal(enhanced.pixel_array, classic.pixel_array)
