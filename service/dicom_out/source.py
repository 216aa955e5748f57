"""Headers of the slices that an output rests on, so that what is written can be strict.

Scanners leave out patient attributes, write sexes that DICOM does not know, and keep the geometry
of multi-frame images in functional groups. The files themselves are never changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pydicom
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence as DicomSequence
from pydicom.valuerep import format_number_as_ds

from dicom_slice.geometry import SliceGeometry
from service.dicom_out.content import ReportContent
from service.dicom_out.errors import OutputError

_EMPTY_IF_MISSING = (
    "PatientName",
    "PatientID",
    "PatientBirthDate",
    "PatientSex",
    "StudyID",
    "StudyDate",
    "StudyTime",
    "AccessionNumber",
    "ReferringPhysicianName",
)
_SEXES = ("M", "F", "O")
# character sets that highdicom and pydicom both write; not 149 (Korean) and 58 (Chinese)
_ONE_BYTE = (13, 100, 101, 109, 110, 126, 127, 138, 144, 148, 166)
_ALONE = {"ISO_IR 192", "GB18030", *(f"ISO_IR {number}" for number in _ONE_BYTE)}
_KANJI = {"ISO 2022 IR 87", "ISO 2022 IR 159"}
_EXTENDED = {"ISO 2022 IR 6", *(f"ISO 2022 IR {number}" for number in _ONE_BYTE), *_KANJI}
_SHARED, _EACH = "SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"
_RESCALE = "PixelValueTransformationSequence"


def source_of(finding: ReportContent, index: int) -> Dataset:
    """Header of a slice, without pixels; of a multi-frame image as if all frames were that one."""
    dataset = pydicom.dcmread(finding.files[index], stop_before_pixels=True)
    _needs(dataset, "StudyInstanceUID", "SeriesInstanceUID")
    tidy_patient(dataset)
    header = finding.slices[index].header
    if _SHARED in dataset or _EACH in dataset:
        _share_rescale(dataset, header["rescale"])
    if "PixelSpacing" not in dataset:
        _add_geometry(dataset, finding.geometry)
    if not dataset.get("SliceThickness"):
        _add_thickness(dataset, header.get("slice_thickness_mm"))
    return dataset


def tidy_patient(dataset: Dataset) -> None:
    """Attributes that must be there are, if only empty; a sex that DICOM does not know is empty; a
    character set that cannot be written, or is not said, becomes UTF-8.
    """
    for name in _EMPTY_IF_MISSING:
        if name not in dataset:
            setattr(dataset, name, None)
    if dataset.PatientSex not in _SEXES:
        dataset.PatientSex = None
    found = dataset.get("SpecificCharacterSet")
    kept = _charset_kept([found] if isinstance(found, str) else list(found or ()))
    if kept != found:
        in_other_charset(dataset, kept)


def in_other_charset(dataset: Dataset, charset: str | list[str]) -> None:
    """What was read and not looked at yet is decoded first."""
    for _ in dataset.iterall():
        pass
    dataset.SpecificCharacterSet = charset


def _charset_kept(words: list[str]) -> str | list[str]:
    """As declared, with the default alphabet before others by its name; or UTF-8."""
    if len(words) == 1 and words[0] in _ALONE:
        return words[0]
    if len(words) > 1:
        words[0] = words[0] or "ISO 2022 IR 6"
        if _EXTENDED.issuperset(words) and words[0] not in _KANJI:
            return words
    return "ISO_IR 192"


def frame_of_reference(dataset: Dataset) -> str:
    """Raises OutputError where there is none: no place in the patient can be told then."""
    _needs(dataset, "FrameOfReferenceUID")
    return str(dataset.FrameOfReferenceUID)


def _needs(dataset: Dataset, *names: str) -> None:
    for name in names:
        if not dataset.get(name):
            raise OutputError(f"slice {dataset.get('SOPInstanceUID', '')} has no {name}")


def _share_rescale(dataset: Dataset, rescale: Mapping[str, Any]) -> None:
    """A presentation state has one rescale for all frames: that of the frame it is drawn over."""
    for group in dataset.get(_EACH) or ():
        if _RESCALE in group:
            del group[_RESCALE]
    item = Dataset()
    item.RescaleSlope = format_number_as_ds(float(rescale["slope"]))
    item.RescaleIntercept = format_number_as_ds(float(rescale["intercept"]))
    item.RescaleType = "US"
    if not dataset.get(_SHARED):
        setattr(dataset, _SHARED, DicomSequence([Dataset()]))
    setattr(dataset[_SHARED].value[0], _RESCALE, DicomSequence([item]))


def _add_thickness(dataset: Dataset, thickness_mm: float | None) -> None:
    if thickness_mm:
        dataset.SliceThickness = format_number_as_ds(float(thickness_mm))
    elif "SliceThickness" in dataset:
        del dataset.SliceThickness


def _add_geometry(dataset: Dataset, geometry: SliceGeometry) -> None:
    dataset.PixelSpacing = [format_number_as_ds(value) for value in geometry.spacing_mm]
    dataset.ImagePositionPatient = [format_number_as_ds(value) for value in geometry.position_mm]
    directions = (*geometry.col_direction, *geometry.row_direction)
    dataset.ImageOrientationPatient = [format_number_as_ds(float(v)) for v in directions]
