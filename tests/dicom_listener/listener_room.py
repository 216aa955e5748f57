"""What the listener's tests share: real slices, real processes, the real data."""

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian

from case_record.record import CaseRecord
from dicom_slice.geometry import SliceGeometry
from dicom_slice.header import Rescale, Slice
from dicom_slice.quirks import MR_IMAGE, Kind
from dicom_slice.times import AcquisitionInterval


def needs_program(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(name) is None, reason=f"{name} is not installed")


CORONAL = SliceGeometry((-40.0, 10.0, 60.0), (0, 0, -1), (1, 0, 0), (1.0, 1.25), (96, 64))


def a_slice(**changes: Any) -> Slice:
    """A usable coronal slice, acquired from 1000 to 1002 s by the scanner's clock."""
    values: dict[str, Any] = {
        "sop_instance_uid": "1.2.3",
        "sop_class_uid": MR_IMAGE,
        "frame": 0,
        "n_frames": 1,
        "shape": (96, 64),
        "geometry": CORONAL,
        "geometry_problem": "",
        "interval": AcquisitionInterval(1000.0, 1002.0, "AcquisitionDateTime"),
        "time_problem": "",
        "kind": Kind.MAGNITUDE,
        "is_mosaic": False,
        "is_localizer": False,
        "distortion_corrected": None,
        "image_type": ("ORIGINAL", "PRIMARY", "M"),
        "rescale": Rescale(),
        "photometric": "MONOCHROME2",
        "samples_per_pixel": 1,
        "has_pixels": True,
        "series_instance_uid": "1.2.4",
        "study_instance_uid": "1.2.5",
        "frame_of_reference_uid": "1.2.6",
        "series_number": 1,
        "acquisition_number": 1,
        "instance_number": 1,
        "series_description": "cor",
        "slice_thickness_mm": 3.0,
        "imaging_frequency_mhz": 123.2,
        "pixel_bandwidth_hz": 260.0,
        "phase_encoding_direction": "COL",
        "echo_time_ms": 2.0,
        "scanner": "A scanner",
        "clock_synchronized": None,
        "transfer_syntax_uid": str(ExplicitVRLittleEndian),
    }
    return Slice(**{**values, **changes})


def mr_data_set(uid: str = "1.2.826.0.1.1", *, began_s: float | None = None) -> FileDataset:
    """A classic MR image, 48 x 40, coronal, acquired in the second before `began_s` + 1."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = MR_IMAGE
    meta.MediaStorageSOPInstanceUID = uid
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data_set = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    data_set.SOPClassUID = MR_IMAGE
    data_set.SOPInstanceUID = uid
    data_set.ImageType = ["ORIGINAL", "PRIMARY", "M", "NONE"]
    data_set.Modality = "MR"
    data_set.Manufacturer = "Test"
    data_set.StudyInstanceUID = "1.2.826.0.1.2"
    data_set.SeriesInstanceUID = "1.2.826.0.1.3"
    data_set.FrameOfReferenceUID = "1.2.826.0.1.4"
    data_set.PatientName = "Doe^Jane"
    data_set.PatientID = "secret-4711"
    data_set.SeriesNumber, data_set.AcquisitionNumber, data_set.InstanceNumber = 1, 1, 1
    _set_time(data_set, time.time() - 1 if began_s is None else began_s)
    data_set.ImagePositionPatient = [-20, 10, 24]
    data_set.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
    data_set.PixelSpacing = [1, 1]
    data_set.SliceThickness = 3
    data_set.Rows, data_set.Columns = 48, 40
    data_set.SamplesPerPixel = 1
    data_set.PhotometricInterpretation = "MONOCHROME2"
    data_set.BitsAllocated, data_set.BitsStored, data_set.HighBit = 16, 12, 11
    data_set.PixelRepresentation = 0
    rows, cols = np.indices((48, 40))
    data_set.PixelData = (rows * 40 + cols).astype("<u2").tobytes()
    return data_set


def _set_time(data_set: FileDataset, began_s: float) -> None:
    data_set.AcquisitionDateTime = datetime.fromtimestamp(began_s).strftime("%Y%m%d%H%M%S.%f")
    data_set.AcquisitionDuration = 0.5


# somebody has compared the clocks, which are equal, when the room's file was written, and nobody
# sets them
COMPARED = {"clock_offset_s": 0.0, "clock_uncertainty_s": 0.1, "clock_may_be_set": False}


def write_room(folder: Path, **listener: Any) -> Path:
    """A room's TOML file whose listener takes any free port; return its path.

    Nothing is known there of the scanner's clock unless it is said.
    """
    keys = {"port": 0, "min_free_mib": 1, **listener}
    lines = [f"{key} = {json.dumps(value)}" for key, value in keys.items()]
    text = "\n".join(
        [
            "[room]",
            'name = "test"',
            'case_dir = "case"',
            "[listener]",
            *lines,
            "[service]",
            'bridge_link = "/dev/null"',
            "",
        ]
    )
    path = folder / "room.toml"
    path.write_text(text)
    return path


class ListenerProcess:
    """A real `autospine listener` and the ready line that it printed."""

    def __init__(self, config: Path, *, log: Path | None = None) -> None:
        self.log = log or config.with_name("listener.log")
        with self.log.open("ab") as stderr:
            self.process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "dicom_listener.command_line",
                    "--config",
                    str(config),
                    "--exit-with-parent",
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                cwd=Path(__file__).parents[2],
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.end()
            raise AssertionError(self.log.read_text())
        self.ready = json.loads(line)
        self.port: int = self.ready["port"]

    def kill(self) -> None:
        """As a power cut would: SIGKILL."""
        self.process.kill()
        self._reap()

    def end(self) -> int:
        with contextlib.suppress(OSError):
            assert self.process.stdin is not None
            self.process.stdin.close()
        try:
            self.process.wait(60)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._reap()
        return self.process.returncode

    def _reap(self) -> None:
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()


@contextlib.contextmanager
def listening(config: Path) -> Iterator[ListenerProcess]:
    process = ListenerProcess(config)
    try:
        yield process
    finally:
        process.end()


def wait_for(condition: Any, timeout_s: float = 120.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.02)


def begin_hold(record: CaseRecord, settled_at_s: float, expected: int = 1, set_id: int = 1) -> int:
    hold = record.begin_hold(
        set_id=set_id,
        place=0,
        setpoints_um={"xt": 0, "yt": 0},
        readback_um={"xt": 0, "yt": 0},
        shift_um={"xt": 0, "yt": 0},
        shift_px=(0.0, 0.0),
        settled_at_s=settled_at_s,
        expected_slices=expected,
    )
    return hold.hold_id
