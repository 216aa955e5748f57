"""A slice of the bench as DICOM: what it is, and nothing that it is not.

A camera's picture is no MR image. It is written as a Secondary Capture Image (the one class for
"digitized from elsewhere" that every archive takes) of modality XC (external camera), extended by
the attributes of the image plane, the frame of reference and the acquisition's time, which PS3.2
allows as a Standard Extended SOP Class. `[listener] camera_slices` lets such slices count.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import (
    PYDICOM_IMPLEMENTATION_UID,
    ExplicitVRLittleEndian,
    SecondaryCaptureImageStorage,
    generate_uid,
)
from pydicom.valuerep import format_number_as_ds

STEPS_PER_LEVEL = 16  # an average of 8-bit pictures is finer than their steps


@dataclass(frozen=True)
class BenchStudy:
    """One session at the bench: the camera has not been moved in it."""

    study_uid: str
    frame_of_reference_uid: str
    started_s: float
    station: str

    @classmethod
    def new(cls, started_s: float, station: str) -> BenchStudy:
        return cls(generate_uid(), generate_uid(), started_s, station)


@dataclass(frozen=True)
class BenchAcquisition:
    """Instants in seconds since the epoch; numbers count from 1."""

    series_uid: str
    series_number: int
    instance_number: int
    acquisition_number: int
    from_s: float
    to_s: float
    averages: int


def write_bench_slice(
    pixels: NDArray[np.float64],
    pixel_mm: float,
    study: BenchStudy,
    acquisition: BenchAcquisition,
    description: str,
) -> Dataset:
    """pixels (rows, cols), about 0 to 255, stored in sixteenths; the slice lies coronal.

    Coordinates: the middle of the slice is the origin, columns grow towards the patient's left,
    rows towards the feet.
    """
    dataset = Dataset()
    dataset.SpecificCharacterSet = "ISO_IR 192"
    dataset.SOPClassUID = SecondaryCaptureImageStorage
    dataset.SOPInstanceUID = generate_uid()
    dataset.Modality, dataset.ConversionType = "XC", "DV"
    dataset.ImageType = ["ORIGINAL", "PRIMARY"]
    _add_study(dataset, study)
    dataset.SeriesInstanceUID = acquisition.series_uid
    dataset.SeriesNumber = acquisition.series_number
    dataset.SeriesDescription = description
    dataset.InstanceNumber = acquisition.instance_number
    dataset.AcquisitionNumber = acquisition.acquisition_number
    _add_times(dataset, acquisition)
    _add_plane(dataset, pixels.shape, pixel_mm)
    _add_pixels(dataset, pixels)
    dataset.BurnedInAnnotation = "NO"
    dataset.DerivationDescription = f"mean of {acquisition.averages} pictures, resampled"
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = dataset.SOPClassUID
    meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.ImplementationClassUID = PYDICOM_IMPLEMENTATION_UID
    dataset.file_meta = meta
    return dataset


def _utc(instant_s: float) -> datetime:
    return datetime.fromtimestamp(instant_s, UTC)


def _add_study(dataset: Dataset, study: BenchStudy) -> None:
    started = _utc(study.started_s)
    dataset.PatientName, dataset.PatientID = "Bench^Camera", "BENCH"
    dataset.PatientBirthDate, dataset.PatientSex = "", ""
    dataset.StudyInstanceUID = study.study_uid
    dataset.StudyDate, dataset.StudyTime = started.strftime("%Y%m%d"), started.strftime("%H%M%S")
    dataset.StudyID, dataset.AccessionNumber, dataset.ReferringPhysicianName = "1", "", ""
    dataset.StudyDescription = "Needle guide on the bench"
    dataset.FrameOfReferenceUID = study.frame_of_reference_uid
    dataset.PositionReferenceIndicator = ""
    dataset.StationName = study.station
    dataset.Manufacturer = "AutoSPINe bench camera"


def _add_times(dataset: Dataset, acquisition: BenchAcquisition) -> None:
    began, ended = _utc(acquisition.from_s), _utc(acquisition.to_s)
    dataset.TimezoneOffsetFromUTC = "+0000"
    dataset.AcquisitionDateTime = began.strftime("%Y%m%d%H%M%S.%f")
    dataset.AcquisitionDate = began.strftime("%Y%m%d")
    dataset.AcquisitionTime = began.strftime("%H%M%S.%f")
    dataset.AcquisitionDuration = acquisition.to_s - acquisition.from_s
    # the camera's clock is this computer's
    dataset.AcquisitionTimeSynchronized = "Y"
    dataset.ContentDate, dataset.ContentTime = ended.strftime("%Y%m%d"), ended.strftime("%H%M%S.%f")


def _add_plane(dataset: Dataset, shape: tuple[int, ...], pixel_mm: float) -> None:
    x, z = (-(n - 1) / 2 * pixel_mm for n in (shape[1], shape[0]))
    dataset.ImagePositionPatient = [_ds(x), "0", _ds(-z)]
    dataset.ImageOrientationPatient = ["1", "0", "0", "0", "0", "-1"]
    dataset.PixelSpacing = [_ds(pixel_mm), _ds(pixel_mm)]
    dataset.SliceThickness = "1"


def _ds(value: float) -> str:
    return str(format_number_as_ds(float(value) + 0.0))


def _add_pixels(dataset: Dataset, pixels: NDArray[np.float64]) -> None:
    """Colour differences have noise of either sign on grey: stored signed."""
    stored = np.clip(np.rint(pixels * STEPS_PER_LEVEL), -32768, 32767).astype("<i2")
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = "MONOCHROME2"
    dataset.Rows, dataset.Columns = stored.shape
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 16, 15
    dataset.PixelRepresentation = 1
    dataset.RescaleSlope, dataset.RescaleIntercept = _ds(1 / STEPS_PER_LEVEL), "0"
    dataset.RescaleType = "US"
    top = max(float(pixels.max()), 1.0)
    dataset.WindowCenter, dataset.WindowWidth = _ds(top / 2), _ds(top)
    dataset.PixelData = stored.tobytes()
