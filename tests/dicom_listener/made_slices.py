"""Slices made for a test, and the hold that they belong to: no processes."""

import time
from datetime import datetime
from typing import Any

import numpy as np
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian

from case_record.record import CaseRecord
from dicom_slice.geometry import SliceGeometry
from dicom_slice.header import Rescale, Slice
from dicom_slice.quirks import MR_IMAGE, Kind
from dicom_slice.times import AcquisitionInterval

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
