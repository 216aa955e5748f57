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

# what the derived image shares with its sources
_KEPT = (
    "SpecificCharacterSet",
    "StudyDate",
    "StudyTime",
    "AccessionNumber",
    "ReferringPhysicianName",
    "StudyDescription",
    "PatientName",
    "PatientID",
    "PatientBirthDate",
    "PatientSex",
    "StudyInstanceUID",
    "StudyID",
    "FrameOfReferenceUID",
    "PositionReferenceIndicator",
    "PatientPosition",
    "SliceThickness",
    "ScanningSequence",
    "SequenceVariant",
    "ScanOptions",
    "MRAcquisitionType",
    "RepetitionTime",
    "EchoTime",
    "EchoTrainLength",
    "MagneticFieldStrength",
    "ImagingFrequency",
    "Laterality",
)
_MUST_BE_THERE = ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyID",
                  "StudyDate", "StudyTime", "AccessionNumber", "ReferringPhysicianName",
                  "PositionReferenceIndicator", "RepetitionTime", "EchoTime", "EchoTrainLength",
                  "ScanOptions", "MRAcquisitionType")  # fmt: skip
_FULL_SCALE = 4095


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
    """Twelve bits over the whole range; ringing below zero is kept by the intercept."""
    low, high = float(made.image.min()), float(made.image.max())
    slope = max(high - low, 1e-12) / _FULL_SCALE
    stored = np.round((made.image - low) / slope).astype("<u2")
    derived.SamplesPerPixel = 1
    derived.PhotometricInterpretation = "MONOCHROME2"
    derived.Rows, derived.Columns = stored.shape
    derived.BitsAllocated = 16
    derived.BitsStored = 12
    derived.HighBit = 11
    derived.PixelRepresentation = 0
    derived.RescaleSlope = format_number_as_ds(slope)
    derived.RescaleIntercept = format_number_as_ds(low)
    derived.RescaleType = "US"
    derived.WindowCenter = format_number_as_ds((low + high) / 2)
    derived.WindowWidth = format_number_as_ds(max(high - low, 1e-6))
    derived.PixelData = stored.tobytes()
