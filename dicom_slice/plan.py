"""Target and entry point in what a workstation sends: a presentation state, a measurement report
(TID 1500) or a Spatial Fiducials object.

Points are taken by label, TARGET or ENTRY (also "target point", "Target 1"), never by their order.
A point is given in patient mm (LPS) of a frame of reference, or on an image that it names; a circle
on an image means its centre. What has a label and is no such point is kept with the reason, so that
nobody waits for it in vain.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from pydicom.dataset import Dataset

from dicom_slice.header import read_data_set

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
_LABEL = re.compile(r"\s*(TARGET|ENTRY)(?:[ _-]?POINT)?(?:[ _#-]*\d{1,3})?\s*", re.IGNORECASE)
_MOST_POINTS, _DEEPEST, _MOST_ITEMS = 1000, 12, 20_000
_BESIDE_PX = 2.0  # a text's anchor and the point that it names


@dataclass(frozen=True)
class OnImage:
    """A point (row, col) on an image; (0, 0) is the centre of a pixel. frame: 0 first; None: the
    image's only one."""

    sop_instance_uid: str
    frame: int | None
    row_px: float
    col_px: float


@dataclass(frozen=True)
class PlanPoint:
    """label: TARGET or ENTRY; patient_mm with its frame of reference, or else on_image, or else why
    it has no place. images: without a frame of reference, the UIDs of those whose it is.
    is_circle: it is the centre of a circle that somebody drew.
    """

    label: str
    patient_mm: tuple[float, float, float] | None = None
    frame_of_reference_uid: str = ""
    on_image: OnImage | None = None
    images: tuple[str, ...] = ()
    is_circle: bool = False
    why: str = ""


@dataclass(frozen=True)
class PlanObject:
    """kind: in words. name: what the sender calls it. why: it cannot be read."""

    kind: str
    name: str
    points: tuple[PlanPoint, ...]
    why: str = ""


def plan_in(path: Path, made_by_us: str) -> PlanObject | None:
    """The labelled points of a file; None if it is no such object, has none, or is our own.

    made_by_us: our Manufacturer, so that an archive that sends everything on proposes nothing.
    Raises UnusableError for a file that cannot be opened.
    """
    data_set, _ = read_data_set(path)
    kind = PLAN_CLASSES.get(str(data_set.get("SOPClassUID", "")))
    if kind is None or str(data_set.get("Manufacturer", "")) == made_by_us:
        return None
    name = kind
    try:
        name = str(data_set.get("ContentLabel") or data_set.get("SeriesDescription") or kind)
        found = tuple(islice(_points(data_set), _MOST_POINTS))
    except Exception as error:  # whatever pydicom raises for a damaged element
        return PlanObject(kind, name, (), f"it is damaged ({type(error).__name__})")
    return PlanObject(kind, name, found) if found else None


def label_of(*words: Any) -> str:
    """TARGET or ENTRY if one of the words is its name; else nothing."""
    for word in words:
        found = _LABEL.fullmatch(str(word)) if word else None
        if found is not None:
            return found.group(1).upper()
    return ""


def _points(data_set: Dataset) -> Iterator[PlanPoint]:
    if data_set.SOPClassUID == SPATIAL_FIDUCIALS:
        yield from _of_fiducials(data_set)
    elif data_set.SOPClassUID in _PRESENTATION_STATES:
        yield from _of_presentation(data_set)
    else:
        yield from _Report(data_set).points()


# Spatial Fiducials


def _of_fiducials(data_set: Dataset) -> Iterator[PlanPoint]:
    for each in data_set.get("FiducialSetSequence") or ():
        frame = str(each.get("FrameOfReferenceUID") or "")
        images = _uids(each.get("ReferencedImageSequence"))
        for item in each.get("FiducialSequence") or ():
            codes = item.get("FiducialIdentifierCodeSequence") or ()
            words = [item.get("FiducialIdentifier"), item.get("FiducialDescription")]
            label = label_of(*words, *(code.get("CodeMeaning") for code in codes))
            if label:
                yield from _of_fiducial(label, item, frame, images)


def _of_fiducial(
    label: str, item: Dataset, frame: str, images: tuple[str, ...]
) -> Iterator[PlanPoint]:
    shape, data = item.get("ShapeType"), item.get("ContourData")
    on_images = item.get("GraphicCoordinatesDataSequence") or ()
    if shape != "POINT":
        yield PlanPoint(label, why=f"is a {shape}, not a POINT")
    elif data:
        yield _in_space(label, data, frame, images)
    else:
        for one in on_images:
            yield _on(label, one.get("ReferencedImageSequence") or (), one.get("GraphicData"))
    if shape == "POINT" and not data and not on_images:
        yield PlanPoint(label, why="has no coordinates")


# Presentation states


def _of_presentation(data_set: Dataset) -> Iterator[PlanPoint]:
    everywhere = [
        image
        for series in data_set.get("ReferencedSeriesSequence") or ()
        for image in series.get("ReferencedImageSequence") or ()
    ]
    for annotation in data_set.get("GraphicAnnotationSequence") or ():
        images = annotation.get("ReferencedImageSequence") or everywhere
        for label, mark in _named(annotation):
            yield PlanPoint(label, why=mark) if isinstance(mark, str) else mark.on(label, images)


@dataclass(frozen=True)
class _Mark:
    """A POINT, a CIRCLE around what is meant, or a text's anchor: (column, row) in its units."""

    at: Sequence[float]
    units: Any
    radius: float = 0.0
    is_circle: bool = False

    @classmethod
    def of_graphic(cls, item: Dataset) -> _Mark:
        at = [float(value) for value in item.GraphicData]
        units = item.get("GraphicAnnotationUnits")
        if item.GraphicType == "CIRCLE":
            return cls(at[:2], units, math.dist(at[:2], at[2:]), is_circle=True)
        return cls(at, units)

    def is_at(self, anchor: _Mark) -> bool:
        beside = math.dist(self.at, anchor.at) <= self.radius + _BESIDE_PX
        return self.units == anchor.units and beside

    def on(self, label: str, images: Sequence[Dataset]) -> PlanPoint:
        if self.units == "PIXEL":
            return replace(_on(label, images, self.at), is_circle=self.is_circle)
        why = f"is given in {self.units} units: draw it on the image, in PIXEL units"
        return PlanPoint(label, why=why)


def _named(annotation: Dataset) -> Iterator[tuple[str, _Mark | str]]:
    """What has a label, or why it is none: a point, or else a circle, in a layer of that name or at
    the text's anchor; the only ones beside a text without an anchor; an anchor of nothing else.
    """
    layer = label_of(annotation.get("GraphicLayer"))
    texts = [
        (label, text)
        for text in annotation.get("TextObjectSequence") or ()
        if (label := label_of(text.get("UnformattedTextValue")))
    ]
    labels = {label for label in (layer, *(label for label, _ in texts)) if label}
    graphics: Sequence[Dataset] = ()
    if labels:
        graphics = annotation.get("GraphicObjectSequence") or ()
    drawn = [item for item in graphics if item.get("GraphicType") in ("POINT", "CIRCLE")]
    marks = [_Mark.of_graphic(item) for item in drawn]
    if layer:
        yield from ((layer, mark) for mark in _points_first(marks))
    if layer and graphics and not marks:
        yield layer, f"is a {graphics[0].get('GraphicType')}, not a POINT or a CIRCLE"
    for label, text in texts:
        if label == layer and marks:
            continue  # it says what the layer says
        if not text.get("AnchorPoint"):
            yield from ((label, mark) for mark in _points_first(marks) if len(labels) == 1)
            if not marks or len(labels) > 1:
                yield label, "is a text that points at nothing"
            continue
        units = text.get("AnchorPointAnnotationUnits")
        anchor = _Mark([float(value) for value in text.AnchorPoint], units)
        meant = [mark for mark in marks if mark.is_at(anchor)] if graphics else [anchor]
        yield from ((label, mark) for mark in _points_first(meant))
        if not meant:
            kind = (drawn or graphics)[0].get("GraphicType")
            yield label, f"has its text at one place and a {kind} at another"


def _points_first(marks: list[_Mark]) -> list[_Mark]:
    return [mark for mark in marks if not mark.is_circle] or marks


# Measurement reports


class _Report:
    """The content of a report: a tree in which items may also stand by reference to others."""

    def __init__(self, data_set: Dataset) -> None:
        self._root = data_set
        self._left = _MOST_ITEMS
        self._evidence = tuple(
            uid
            for study in data_set.get("CurrentRequestedProcedureEvidenceSequence") or ()
            for series in study.get("ReferencedSeriesSequence") or ()
            for uid in _uids(series.get("ReferencedSOPSequence"))
        )

    def points(self) -> Iterator[PlanPoint]:
        for item in self._inner(self._root):
            yield from self._below(item, [], 0)

    def _inner(self, item: Dataset) -> list[Dataset]:
        return [self._meant(one) for one in item.get("ContentSequence") or ()]

    def _meant(self, item: Dataset) -> Dataset:
        """The item itself, or the one that it refers to: its place in the tree, 1 is the root."""
        place = item.get("ReferencedContentItemIdentifier")
        if not place:
            return item
        first, *rest = [place] if isinstance(place, int) else place
        found = self._root
        for number in rest:
            if not 0 < number <= len(found.get("ContentSequence") or ()):
                return item
            found = found.ContentSequence[number - 1]
        return found if first == 1 else item

    def _below(self, item: Dataset, above: list[str], depth: int) -> Iterator[PlanPoint]:
        """A point below, or named by, a label: a tracking identifier, a finding, a concept."""
        self._left -= 1
        if self._left < 0:
            raise ValueError("more content than a plan has")
        if depth > _DEEPEST:
            return
        inner = self._inner(item)
        label = label_of(*_words(item))
        names = [*above, label] if label else above
        if item.get("ValueType") == "CONTAINER":
            own = {found for one in inner if (found := label_of(*_words(one), *_values(one)))}
            names = [*above, *own] if len(own) == 1 else names
        if names and item.get("ValueType") in ("SCOORD", "SCOORD3D"):
            yield self._point(names[-1], item, inner)
        for one in inner:
            yield from self._below(one, names, depth + 1)

    def _point(self, label: str, item: Dataset, inner: list[Dataset]) -> PlanPoint:
        kind, data = item.get("GraphicType"), item.get("GraphicData") or ()
        images = [one.ReferencedSOPSequence[0] for one in inner if one.get("ReferencedSOPSequence")]
        in_space = item.ValueType == "SCOORD3D"
        if kind == "CIRCLE" and len(data) == 4 and not in_space:
            return replace(_on(label, images, data[:2]), is_circle=True)
        if kind not in ("POINT", "MULTIPOINT") or len(data) != (3 if in_space else 2):
            return PlanPoint(label, why=f"is a {kind} of {len(data)} coordinates, not one point")
        if not in_space:
            return _on(label, images, data)
        frame = str(item.get("ReferencedFrameOfReferenceUID") or "")
        return _in_space(label, data, frame, _uids(images) or self._evidence)


def _words(item: Dataset) -> list[Any]:
    return [code.get("CodeMeaning") for code in item.get("ConceptNameCodeSequence") or ()]


def _values(item: Dataset) -> list[Any]:
    codes = item.get("ConceptCodeSequence") or ()
    return [item.get("TextValue"), *(code.get("CodeMeaning") for code in codes)]


# Pieces


def _in_space(label: str, data: Any, frame: str, images: tuple[str, ...]) -> PlanPoint:
    if len(data) != 3:
        return PlanPoint(label, why=f"needs three coordinates, has {len(data)}")
    x, y, z = (float(value) for value in data)
    return PlanPoint(label, (x, y, z), frame, images=() if frame else images)


def _on(label: str, images: Sequence[Dataset], data: Any) -> PlanPoint:
    """Graphic data are (column, row) from the outer corner of the first pixel."""
    if len(images) != 1:
        many = f"on {len(images)} images" if images else "on no image"
        return PlanPoint(label, why=f"is drawn {many}: it must be on one, to have a depth")
    if data is None or len(data) != 2:
        return PlanPoint(label, why="is not one point of a column and a row")
    col, row = (float(value) for value in data)
    frames = images[0].get("ReferencedFrameNumber")
    numbers = [frames] if isinstance(frames, int) else list(frames or ())
    if len(numbers) > 1:
        why = f"is drawn on {len(numbers)} frames: it must be on one, to have a depth"
        return PlanPoint(label, why=why)
    frame = int(numbers[0]) - 1 if numbers else None
    uid = str(images[0].ReferencedSOPInstanceUID)
    return PlanPoint(label, on_image=OnImage(uid, frame, row - 0.5, col - 0.5))


def _uids(images: Sequence[Dataset] | None) -> tuple[str, ...]:
    return tuple(str(image.ReferencedSOPInstanceUID) for image in images or ())
