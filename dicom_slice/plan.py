"""Target and entry point in what a workstation sends: a presentation state, a measurement report
(TID 1500) or a Spatial Fiducials object.

Points are taken by label, TARGET or ENTRY (also "target point"), never by their order. A point is
given in patient mm (LPS) of a frame of reference, or on an image that it names.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydicom.dataset import Dataset

from dicom_slice.header import read_data_set
from dicom_slice.reasons import Reason, UnusableError

SPATIAL_FIDUCIALS = "1.2.840.10008.5.1.4.1.1.66.2"
_PRESENTATION_STATES = ("1.2.840.10008.5.1.4.1.1.11.1", "1.2.840.10008.5.1.4.1.1.11.2")
_REPORTS = (
    "1.2.840.10008.5.1.4.1.1.88.22",  # Enhanced SR
    "1.2.840.10008.5.1.4.1.1.88.33",  # Comprehensive SR
    "1.2.840.10008.5.1.4.1.1.88.34",  # Comprehensive 3D SR
)
PLAN_CLASSES = {
    SPATIAL_FIDUCIALS: "Spatial Fiducials",
    **dict.fromkeys(_PRESENTATION_STATES, "presentation state"),
    **dict.fromkeys(_REPORTS, "measurement report"),
}
TARGET, ENTRY = "TARGET", "ENTRY"
_LABEL = re.compile(r"\s*(TARGET|ENTRY)(?:[ _-]?POINT)?\s*", re.IGNORECASE)
_MOST_POINTS, _DEEPEST = 1000, 12


@dataclass(frozen=True)
class OnImage:
    """A point (row, col) on a frame (0 first) of an image; (0, 0) is the centre of a pixel."""

    sop_instance_uid: str
    frame: int
    row_px: float
    col_px: float


@dataclass(frozen=True)
class PlanPoint:
    """label: TARGET or ENTRY; patient_mm with its frame of reference, or else on_image."""

    label: str
    patient_mm: tuple[float, float, float] | None = None
    frame_of_reference_uid: str = ""
    on_image: OnImage | None = None


@dataclass(frozen=True)
class PlanObject:
    """kind: in words. name: what the sender calls it."""

    kind: str
    name: str
    points: tuple[PlanPoint, ...]


def plan_in(path: Path, made_by_us: str) -> PlanObject | None:
    """The labelled points of a file; None if it is no such object, has none, or is our own.

    made_by_us: our Manufacturer, so that an archive that sends everything on proposes nothing.
    Raises UnusableError for a file that is damaged.
    """
    data_set, _ = read_data_set(path)
    kind = PLAN_CLASSES.get(str(data_set.get("SOPClassUID", "")))
    if kind is None or str(data_set.get("Manufacturer", "")) == made_by_us:
        return None
    try:
        found = tuple(_points(data_set))[:_MOST_POINTS]
        name = str(data_set.get("ContentLabel") or data_set.get("SeriesDescription") or kind)
    except UnusableError:
        raise
    except Exception as error:  # whatever pydicom raises for a damaged element
        text = f"a damaged plan ({type(error).__name__})"
        raise UnusableError(Reason.UNREADABLE, text) from error
    return PlanObject(kind, name, found) if found else None


def _points(data_set: Dataset) -> Iterator[PlanPoint]:
    if data_set.SOPClassUID == SPATIAL_FIDUCIALS:
        yield from _of_fiducials(data_set)
    elif data_set.SOPClassUID in _PRESENTATION_STATES:
        yield from _of_presentation(data_set)
    else:
        for item in data_set.get("ContentSequence") or ():
            yield from _of_content(item, [], 0)


def _of_fiducials(data_set: Dataset) -> Iterator[PlanPoint]:
    for each in data_set.get("FiducialSetSequence") or ():
        frame = str(each.get("FrameOfReferenceUID", ""))
        for item in each.get("FiducialSequence") or ():
            codes = item.get("FiducialIdentifierCodeSequence") or ()
            words = [item.get("FiducialIdentifier"), item.get("FiducialDescription")]
            label = _label(*words, *(code.get("CodeMeaning") for code in codes))
            data = item.get("ContourData")
            if label and item.get("ShapeType") == "POINT" and data and len(data) == 3:
                yield PlanPoint(label, _three(data), frame)


def _of_presentation(data_set: Dataset) -> Iterator[PlanPoint]:
    """A POINT in a layer of that name; or a text of that word, at its anchor."""
    everywhere = [
        image
        for series in data_set.get("ReferencedSeriesSequence") or ()
        for image in series.get("ReferencedImageSequence") or ()
    ]
    for annotation in data_set.get("GraphicAnnotationSequence") or ():
        images = annotation.get("ReferencedImageSequence") or everywhere
        if len(images) != 1:
            continue  # over several images: nobody can tell at which depth
        layer = _label(annotation.get("GraphicLayer"))
        for item in annotation.get("GraphicObjectSequence") or ():
            is_point = item.get("GraphicType") == "POINT"
            if layer and is_point and item.get("GraphicAnnotationUnits") == "PIXEL":
                yield PlanPoint(layer, on_image=_on(images[0], item.GraphicData))
        for text in annotation.get("TextObjectSequence") or ():
            label = _label(text.get("UnformattedTextValue"))
            at = text.get("AnchorPoint")
            if label and at and text.get("AnchorPointAnnotationUnits") == "PIXEL":
                yield PlanPoint(label, on_image=_on(images[0], at))


def _of_content(item: Dataset, above: list[str], depth: int) -> Iterator[PlanPoint]:
    """A POINT below, or named by, a label: a tracking identifier, a finding, a concept."""
    if depth > _DEEPEST:
        return
    inner = list(item.get("ContentSequence") or ())
    label = _label(*_words(item))
    names = [*above, label] if label else above
    if item.get("ValueType") == "CONTAINER":
        own = {found for one in inner if (found := _label(*_words(one), *_values(one)))}
        names = [*above, *own] if len(own) == 1 else names
    kind = item.get("GraphicType")
    if names and kind == "POINT" and item.get("ValueType") == "SCOORD3D":
        yield PlanPoint(
            names[-1], _three(item.GraphicData), str(item.get("ReferencedFrameOfReferenceUID", ""))
        )
    if names and kind == "POINT" and item.get("ValueType") == "SCOORD":
        images = [one for one in inner if one.get("ReferencedSOPSequence")]
        if len(images) == 1:
            at = _on(images[0].ReferencedSOPSequence[0], item.GraphicData)
            yield PlanPoint(names[-1], on_image=at)
    for one in inner:
        yield from _of_content(one, names, depth + 1)


def _words(item: Dataset) -> list[Any]:
    return [code.get("CodeMeaning") for code in item.get("ConceptNameCodeSequence") or ()]


def _values(item: Dataset) -> list[Any]:
    codes = item.get("ConceptCodeSequence") or ()
    return [item.get("TextValue"), *(code.get("CodeMeaning") for code in codes)]


def _label(*words: Any) -> str:
    for word in words:
        found = _LABEL.fullmatch(str(word)) if word else None
        if found is not None:
            return found.group(1).upper()
    return ""


def _on(image: Dataset, data: Any) -> OnImage:
    """Graphic data are (column, row) from the outer corner of the first pixel."""
    col, row = (float(value) for value in list(data)[:2])
    frames = image.get("ReferencedFrameNumber")
    first = frames[0] if isinstance(frames, list) or hasattr(frames, "__iter__") else frames
    frame = int(first) - 1 if first else 0
    return OnImage(str(image.ReferencedSOPInstanceUID), frame, row - 0.5, col - 0.5)


def _three(data: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in data)
    return x, y, z
