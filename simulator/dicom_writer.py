"""MR images as a vendor's scanner writes them: classic MR Image Storage.

Every instant here is on the scanner's clock (seconds since the epoch); it writes them as local
time, as scanners do.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import (
    PYDICOM_IMPLEMENTATION_UID,
    UID,
    ExplicitVRLittleEndian,
    MRImageStorage,
    generate_uid,
)
from pydicom.valuerep import format_number_as_ds

from dicom_slice.geometry import SliceGeometry
from simulator.config import ScannerSettings, SliceProtocol


@dataclass(frozen=True)
class Study:
    """What all series of one examination have in common."""

    study_uid: str
    frame_of_reference_uid: str
    dimension_organization_uid: str
    started_s: float
    patient_id: str = "VIRTUAL-1"
    patient_name: str = "Phantom^Virtual"

    @classmethod
    def new(cls, started_s: float) -> "Study":
        return cls(generate_uid(), generate_uid(), generate_uid(), started_s)

    @classmethod
    def of_examination(cls, case_uid: str, table: str, started_s: float) -> "Study":
        """The same for the same case and table: a scanner that was restarted goes on with it.

        A table that was moved begins another study, and a frame of reference, of the same patient.
        """
        patient = hashlib.sha256(case_uid.encode()).hexdigest()[:8].upper()
        study, frame, dimensions = (
            generate_uid(entropy_srcs=[what, case_uid, table])
            for what in ("study", "frame of reference", "dimensions")
        )
        return cls(
            study, frame, dimensions, started_s, f"VIRTUAL-{patient}", f"Phantom^{patient.title()}"
        )


@dataclass(frozen=True)
class Series:
    """One series of the examination. image_type: values 3 and further of ImageType."""

    series_uid: str
    number: int
    description: str
    image_type: tuple[str, ...] = ("M", "ND", "NORM")
    started_s: float = 0.0

    @classmethod
    def new(
        cls, number: int, description: str, image_type: tuple[str, ...], started_s: float
    ) -> "Series":
        return cls(generate_uid(), number, description, image_type, started_s)


@dataclass(frozen=True)
class AcquisitionStamp:
    """When, and as which number, a slice was acquired; the scanner's clock."""

    started_s: float
    duration_s: float
    acquisition_number: int
    instance_number: int
    reconstructed_s: float


def write_mr_image(
    pixels: NDArray[np.float64],
    geometry: SliceGeometry,
    *,
    protocol: SliceProtocol,
    scanner: ScannerSettings,
    study: Study,
    series: Series,
    stamp: AcquisitionStamp,
    sop_instance_uid: str | None = None,
) -> Dataset:
    """A conformant MR image with its file meta information, ready to be sent.

    pixels: (rows, cols). Magnitudes are stored as 12 bits in 16, clipped at 4095; pixels of a
    phase image (image type P) are radians and are stored as 0..4095 with their rescale.
    """
    dataset = Dataset()
    dataset.SpecificCharacterSet = "ISO_IR 192"
    _add_patient_and_study(dataset, study, scanner)
    _add_series_and_equipment(dataset, series, study, scanner)
    _add_times(dataset, stamp, series, scanner)
    _add_geometry(dataset, geometry, protocol.thickness_mm)
    _add_mr_acquisition(dataset, protocol, stamp, series, geometry.shape)
    _add_pixels(dataset, pixels, is_phase="P" in series.image_type)
    dataset.SOPClassUID = MRImageStorage
    dataset.SOPInstanceUID = UID(sop_instance_uid or generate_uid())
    dataset.file_meta = file_meta_of(dataset)
    return dataset


def file_meta_of(dataset: Dataset) -> FileMetaDataset:
    """File meta information (explicit little endian) for a dataset that has its SOP UIDs."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = dataset.SOPClassUID
    meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.ImplementationClassUID = PYDICOM_IMPLEMENTATION_UID
    return meta


def ds_values(values: Sequence[float]) -> list[str]:
    """Numbers as DICOM decimal strings, each within 16 characters."""
    return [format_number_as_ds(float(value) + 0.0) for value in values]


def local_time(instant_s: float, scanner: ScannerSettings) -> datetime:
    """The wall-clock reading that a scanner in its time zone shows."""
    zone = timezone(timedelta(minutes=scanner.utc_offset_min))
    return datetime.fromtimestamp(instant_s, UTC).astimezone(zone)


def _date(instant: datetime) -> str:
    return instant.strftime("%Y%m%d")


def _time(instant: datetime) -> str:
    return instant.strftime("%H%M%S.%f")


def _add_patient_and_study(dataset: Dataset, study: Study, scanner: ScannerSettings) -> None:
    started = local_time(study.started_s, scanner)
    dataset.PatientName = study.patient_name
    dataset.PatientID = study.patient_id
    dataset.PatientBirthDate = ""
    dataset.PatientSex = "O"
    dataset.PatientWeight = "70"
    dataset.StudyInstanceUID = study.study_uid
    dataset.StudyDate, dataset.StudyTime = _date(started), _time(started)
    dataset.StudyID = "1"
    dataset.StudyDescription = "Needle guide, virtual room"
    dataset.AccessionNumber = ""
    dataset.ReferringPhysicianName = ""


def _add_series_and_equipment(
    dataset: Dataset, series: Series, study: Study, scanner: ScannerSettings
) -> None:
    started = local_time(series.started_s, scanner)
    dataset.Modality = "MR"
    dataset.SeriesInstanceUID = series.series_uid
    dataset.SeriesNumber = series.number
    dataset.SeriesDescription = series.description
    dataset.SeriesDate, dataset.SeriesTime = _date(started), _time(started)
    dataset.PatientPosition = "HFP"
    dataset.BodyPartExamined = "SPINE"
    dataset.FrameOfReferenceUID = study.frame_of_reference_uid
    dataset.PositionReferenceIndicator = ""
    dataset.Manufacturer = scanner.manufacturer
    dataset.ManufacturerModelName = scanner.model_name
    dataset.InstitutionName = "Virtual room"
    dataset.StationName = scanner.ae_title
    dataset.DeviceSerialNumber = "0"
    dataset.SoftwareVersions = "autospine simulator"


def _add_times(
    dataset: Dataset, stamp: AcquisitionStamp, series: Series, scanner: ScannerSettings
) -> None:
    started = local_time(stamp.started_s, scanner)
    content = local_time(stamp.reconstructed_s, scanner)
    dataset.ImageType = ["ORIGINAL", "PRIMARY", *series.image_type]
    dataset.AcquisitionNumber = stamp.acquisition_number
    dataset.InstanceNumber = stamp.instance_number
    if scanner.time_attributes in ("datetime", "both"):
        dataset.AcquisitionDateTime = started.strftime("%Y%m%d%H%M%S.%f")
    if scanner.time_attributes in ("date_and_time", "both"):
        dataset.AcquisitionDate, dataset.AcquisitionTime = _date(started), _time(started)
    dataset.AcquisitionDuration = stamp.duration_s
    # As on real scanners, the content and the instance come later than the data.
    dataset.ContentDate, dataset.ContentTime = _date(content), _time(content)
    dataset.InstanceCreationDate, dataset.InstanceCreationTime = _date(content), _time(content)
    if scanner.write_timezone:
        dataset.TimezoneOffsetFromUTC = started.strftime("%z")


def _add_geometry(dataset: Dataset, geometry: SliceGeometry, thickness_mm: float) -> None:
    dataset.ImagePositionPatient = ds_values(geometry.position_mm)
    dataset.ImageOrientationPatient = ds_values([*geometry.col_direction, *geometry.row_direction])
    dataset.PixelSpacing = ds_values(geometry.spacing_mm)
    dataset.SliceThickness = ds_values([thickness_mm])[0]
    dataset.SpacingBetweenSlices = ds_values([thickness_mm])[0]
    along_normal = float(np.dot(geometry.position_mm, geometry.normal))
    dataset.SliceLocation = ds_values([along_normal])[0]


def _add_mr_acquisition(
    dataset: Dataset,
    protocol: SliceProtocol,
    stamp: AcquisitionStamp,
    series: Series,
    shape: tuple[int, int],
) -> None:
    rows, cols = shape
    steps, frequency = (rows, cols) if protocol.phase_encoding == "COL" else (cols, rows)
    dataset.ScanningSequence = "GR"
    dataset.SequenceVariant = ["SP", "OSP"]
    dataset.ScanOptions = "" if protocol.window == "flat" else "FILTERED"
    dataset.MRAcquisitionType = "2D"
    dataset.SequenceName = "*fl2d1"
    dataset.ProtocolName = series.description
    # One average: repetition time × steps is the acquisition's duration.
    dataset.RepetitionTime = ds_values([1000 * stamp.duration_s / steps])[0]
    dataset.EchoTime = ds_values([protocol.echo_time_ms])[0]
    dataset.FlipAngle = ds_values([protocol.flip_angle_deg])[0]
    dataset.NumberOfAverages = "1"
    dataset.EchoTrainLength = 1
    dataset.EchoNumbers = 1
    dataset.MagneticFieldStrength = ds_values([protocol.field_t])[0]
    dataset.ImagingFrequency = ds_values([protocol.imaging_frequency_mhz])[0]
    dataset.ImagedNucleus = "1H"
    dataset.PixelBandwidth = ds_values([protocol.bandwidth_hz_px])[0]
    dataset.NumberOfPhaseEncodingSteps = steps
    dataset.InPlanePhaseEncodingDirection = protocol.phase_encoding
    # (frequency rows, frequency columns, phase rows, phase columns); 0 where not used
    along_cols = [0, frequency, steps, 0]
    along_rows = [frequency, 0, 0, steps]
    dataset.AcquisitionMatrix = along_cols if protocol.phase_encoding == "COL" else along_rows
    dataset.PercentSampling = "100"
    dataset.PercentPhaseFieldOfView = "100"
    dataset.ReceiveCoilName = "Spine"
    dataset.TransmitCoilName = "Body"


def _add_pixels(dataset: Dataset, pixels: NDArray[np.float64], is_phase: bool) -> None:
    slope, intercept = (2 * np.pi / 4096, -np.pi) if is_phase else (1.0, 0.0)
    stored = np.clip(np.rint((pixels - intercept) / slope), 0, 4095).astype("<u2")
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = "MONOCHROME2"
    dataset.Rows, dataset.Columns = stored.shape
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 12, 11
    dataset.PixelRepresentation = 0
    dataset.SmallestImagePixelValue = int(stored.min())
    dataset.LargestImagePixelValue = int(stored.max())
    if is_phase:
        dataset.RescaleSlope, dataset.RescaleIntercept = ds_values([slope, intercept])
        dataset.RescaleType = "US"
    window = max(float(stored.max()), 1.0)
    dataset.WindowCenter, dataset.WindowWidth = ds_values([window / 2, window])
    dataset.PixelData = stored.tobytes()
