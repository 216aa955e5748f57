"""Virtual slices as DICOM files, for tests of what reads files."""

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from simulator.config import ScannerSettings, VirtualRoom
from simulator.dicom_writer import AcquisitionStamp, Series, Study, write_mr_image
from simulator.mr_slice import acquire

SCANNER = ScannerSettings(
    service_url="http://127.0.0.1:1",
    listener_port=11112,
    motors_truth_port=1,
    truth_file="unused",
)
STUDY = Study.new(time.time())
SERIES = Series.new(3, "test", ("M", "ND", "NORM"), time.time())


def write_slice(path: Path, room: VirtualRoom, stage_mm: Mapping[str, float], seed: int) -> None:
    """Acquire a slice of the virtual room with the stages at `stage_mm` and write it."""
    made = acquire(room, stage_mm, np.random.default_rng(seed))
    now_s = time.time()
    image = write_mr_image(
        np.abs(made.signal),
        made.geometry,
        protocol=room.protocol,
        scanner=SCANNER,
        study=STUDY,
        series=SERIES,
        stamp=AcquisitionStamp(now_s, 0.25, seed + 1, seed + 1, now_s + 0.5),
    )
    image.save_as(path, enforce_file_format=True)
