"""The super-resolution image as a DICOM object: a derived MR image that names its sources.

MR Image Storage, DERIVED\\SECONDARY; patient, study and frame of reference are the sources',
series and instance are new; spacing and position are those of the finer grid (PS3.3 C.8.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence as DicomSequence
from pydicom.uid import ExplicitVRLittleEndian, MRImageStorage, generate_uid
from pydicom.valuerep import format_number_as_ds

from dicom_slice.geometry import SliceGeometry
from sr_engine.reconstruction.reconstruct import Reconstruction

# What the derived image shares with its sources. Of patient and study: everything, for objects of
# one study must not contradict each other. Of the series: what says which body part lies how.
SERIES_SHARED = ("BodyPartExamined", "Laterality", "PatientPosition", "ProtocolName")
_KEPT = (
    "SpecificCharacterSet",
    # patient
    "PatientName",
    "PatientID",
    "IssuerOfPatientID",
    "PatientBirthDate",
    "PatientBirthTime",
    "PatientSex",
    "OtherPatientIDs",
    "OtherPatientIDsSequence",
    "OtherPatientNames",
    "EthnicGroup",
    "PatientComments",
    "PatientIdentityRemoved",
    "DeidentificationMethod",
    "DeidentificationMethodCodeSequence",
    # study
    "StudyInstanceUID",
    "StudyDate",
    "StudyTime",
    "StudyID",
    "AccessionNumber",
    "IssuerOfAccessionNumberSequence",
    "ReferringPhysicianName",
    "StudyDescription",
    "PhysiciansOfRecord",
    "ProcedureCodeSequence",
    "AdmittingDiagnosesDescription",
    "PatientAge",
    "PatientSize",
    "PatientWeight",
    "MedicalAlerts",
    "Allergies",
    "SmokingStatus",
    "PregnancyStatus",
    "Occupation",
    "AdditionalPatientHistory",
    "PatientState",
    # series, frame of reference, place, acquisition
    *SERIES_SHARED,
    "FrameOfReferenceUID",
    "PositionReferenceIndicator",
    "SliceThickness",
    "SpacingBetweenSlices",
    "SliceLocation",
    "ScanningSequence",
    "SequenceVariant",
    "SequenceName",
    "ScanOptions",
    "MRAcquisitionType",
    "RepetitionTime",
    "EchoTime",
    "InversionTime",
    "EchoTrainLength",
    "FlipAngle",
    "MagneticFieldStrength",
    "ImagedNucleus",
    "ImagingFrequency",
)
_MUST_BE_THERE = ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyID",
                  "StudyDate", "StudyTime", "AccessionNumber", "ReferringPhysicianName",
                  "PositionReferenceIndicator", "RepetitionTime", "EchoTime", "EchoTrainLength",
                  "ScanOptions", "MRAcquisitionType")  # fmt: skip
# grey values go up to so much: 16 bits with a sign, for the ringing below zero
_LEAST_PEAK, _MOST_PEAK = 1000.0, 32000.0


def derived_image(
    made: Reconstruction, geometry: SliceGeometry, sources: Sequence[Path]
) -> Dataset:
    """Return the derived MR image; `geometry` is that of the finer grid."""
    first = pydicom.dcmread(sources[0], stop_before_pixels=True)
    derived = Dataset()
    for keyword in _KEPT:
        if keyword in first:
            derived[keyword] = first[keyword]
        elif keyword in _MUST_BE_THERE:
            setattr(derived, keyword, None)
    for keyword, value in (("ScanningSequence", "RM"), ("SequenceVariant", "NONE")):
        if keyword not in derived:
            setattr(derived, keyword, value)
    if not derived.get("BodyPartExamined") and "Laterality" not in derived:
        derived.Laterality = None  # may be of a paired part: unknown, but there
    _add_identity(derived, made, first)
    _add_geometry(derived, geometry)
    _add_sources(derived, made, sources)
    _add_pixels(derived, made)
    return derived


def _add_identity(derived: Dataset, made: Reconstruction, first: Dataset) -> None:
    derived.SOPClassUID = MRImageStorage
    derived.SOPInstanceUID = generate_uid()
    derived.SeriesInstanceUID = generate_uid()
    derived.Modality = "MR"
    derived.SeriesNumber = 9000 + int(first.get("SeriesNumber") or 0) % 1000
    derived.InstanceNumber = 1
    derived.SeriesDescription = f"AutoSPINe super-resolution x{made.factor}"
    derived.ImageType = ["DERIVED", "SECONDARY", "OTHER"]
    derived.Manufacturer = "AutoSPINe Navigator"
    derived.SoftwareVersions = version("autospine")
    derived.file_meta = FileMetaDataset()
    derived.file_meta.MediaStorageSOPClassUID = derived.SOPClassUID
    derived.file_meta.MediaStorageSOPInstanceUID = derived.SOPInstanceUID
    derived.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian


def _add_geometry(derived: Dataset, geometry: SliceGeometry) -> None:
    derived.PixelSpacing = [format_number_as_ds(value) for value in geometry.spacing_mm]
    derived.ImagePositionPatient = [format_number_as_ds(value) for value in geometry.position_mm]
    directions = (*geometry.col_direction, *geometry.row_direction)
    derived.ImageOrientationPatient = [format_number_as_ds(float(v)) for v in directions]


def _add_sources(derived: Dataset, made: Reconstruction, sources: Sequence[Path]) -> None:
    items = []
    for path in sources:
        source = pydicom.dcmread(path, stop_before_pixels=True)
        item = Dataset()
        item.ReferencedSOPClassUID = source.SOPClassUID
        item.ReferencedSOPInstanceUID = source.SOPInstanceUID
        items.append(item)
    derived.SourceImageSequence = DicomSequence(items)
    derived.DerivationDescription = (
        f"Super-resolution x{made.factor}, {made.method}, from {made.n_frames} slices at known "
        f"shifts; condition number {made.condition_number:.3g}"
    )
    equipment = Dataset()
    purpose = Dataset()
    purpose.CodeValue = "109102"
    purpose.CodingSchemeDesignator = "DCM"
    purpose.CodeMeaning = "Processing Equipment"
    equipment.PurposeOfReferenceCodeSequence = DicomSequence([purpose])
    equipment.Manufacturer = "AutoSPINe Navigator"
    equipment.SoftwareVersions = version("autospine")
    derived.ContributingEquipmentSequence = DicomSequence([equipment])


def _add_pixels(derived: Dataset, made: Reconstruction) -> None:
    """The sources' grey values as they are, so that they read the same with and without a rescale;
    of very dark or bright ones by a power of ten, which is said.
    """
    peak = float(np.abs(made.image).max())
    power = 0 if _LEAST_PEAK <= peak <= _MOST_PEAK or peak == 0 else _power_for(peak)
    scaled = made.image * 10.0**power
    if power:
        derived.DerivationDescription += f"; grey values times 1e{power}"
    low, high = float(scaled.min()), float(scaled.max())
    stored = np.round(scaled).astype("<i2")
    derived.SamplesPerPixel = 1
    derived.PhotometricInterpretation = "MONOCHROME2"
    derived.Rows, derived.Columns = stored.shape
    derived.BitsAllocated = 16
    derived.BitsStored = 16
    derived.HighBit = 15
    derived.PixelRepresentation = 1
    derived.WindowCenter = format_number_as_ds((low + high) / 2)
    derived.WindowWidth = format_number_as_ds(max(high - low, 1.0))
    derived.PixelData = stored.tobytes()


def _power_for(peak: float) -> int:
    return int(np.floor(np.log10(_MOST_PEAK / peak)))
