"""Fiducial and target, and the displacement between them, drawn over an image: a grayscale
softcopy presentation state.

It is drawn over the reconstruction if there is one, else over the slice that the page showed. Its
coordinates (PIXEL) are (column, row) from the outer corner of the first pixel, half a pixel beyond
its centre.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from highdicom.pr import (
    GraphicAnnotation,
    GraphicLayer,
    GraphicObject,
    GrayscaleSoftcopyPresentationState,
    TextObject,
)
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian

from service.dicom_out.content import ReportContent
from service.dicom_out.identity import (
    MAKER,
    RESEARCH,
    SERIES_NUMBERS,
    output_uid,
    series_uid,
    software_version,
    stamp,
    subject_of,
)
from service.dicom_out.image import fine_geometry, has_image, image_of
from service.dicom_out.source import source_of
from service.procedure.estimate import axis_sigma

FIDUCIAL = GraphicLayer("FIDUCIAL", 1, "Measured position of the fiducial")
TARGET = GraphicLayer("TARGET", 2, "Target position of the fiducial")
PLAN = GraphicLayer("PLAN", 3, "Displacement from the fiducial to its target")
NOTES = GraphicLayer("NOTES", 4, "Description in words")
_CROSS = 0.5  # of the radius
_HEAD = 0.25  # of the arrow's length
_SERIAL = "-"


@dataclass(frozen=True, eq=False)
class Drawing:
    """All in pixels (row, col) of the image, (0, 0) at the centre of its first pixel."""

    image: Dataset
    frame: int | None
    centre_px: NDArray[np.float64]
    radius_px: float
    target_px: NDArray[np.float64] | None

    @property
    def target_is_inside(self) -> bool:
        if self.target_px is None:
            return False
        shape = np.array([self.image.Rows, self.image.Columns])
        reach = _CROSS * self.radius_px
        inside = (self.target_px > reach) & (self.target_px < shape - 1 - reach)
        return bool(np.all(inside))


def presentation_of(finding: ReportContent) -> Dataset:
    """The presentation state; the same for the same record."""
    drawing = _drawing(finding)
    subject, number = subject_of(finding)
    image = drawing.image
    made = GrayscaleSoftcopyPresentationState(
        referenced_images=[image],
        series_instance_uid=series_uid(finding, "presentation", image),
        series_number=SERIES_NUMBERS["presentation"],
        sop_instance_uid=output_uid(finding, f"{subject}-{number}-presentation"),
        instance_number=10 * number + ("measurement", "approach", "puncture").index(subject),
        manufacturer=MAKER,
        manufacturer_model_name=MAKER,
        software_versions=software_version(),
        device_serial_number=_SERIAL,
        content_label="AUTOSPINE",
        content_description=f"Fiducial and target, {subject} {number}",
        graphic_layers=[FIDUCIAL, TARGET, PLAN, NOTES],
        graphic_annotations=list(_annotations(finding, drawing)),
        transfer_syntax_uid=ExplicitVRLittleEndian,
    )
    for keyword in ("BodyPartExamined", "Laterality"):
        if keyword in image:
            made[keyword] = image[keyword]
    stamp(made, finding, "presentation", "AutoSPINe overlays (research)")
    made.PresentationCreationDate, made.PresentationCreationTime = (
        made.ContentDate,
        made.ContentTime,
    )
    for keyword in ("ContentDate", "ContentTime"):  # not of this kind of object
        del made[keyword]
    return made


def _drawing(finding: ReportContent) -> Drawing:
    displacement_mm = finding.displacement_mm
    if has_image(finding):
        image, frame = image_of(finding), None
        factor = image.Rows // finding.geometry.shape[0]
        geometry = fine_geometry(finding, factor)
        centre_px = geometry.pixel_from_patient(finding.result["patient_mm"])[0]
    else:
        image = source_of(finding, finding.shown)
        many = int(image.get("NumberOfFrames") or 1) > 1
        frame = finding.slices[finding.shown].frame + 1 if many else None
        geometry = finding.geometry
        centre_px = np.array(finding.result["centre_px"], dtype=float)
    spacing = np.array(geometry.spacing_mm)
    return Drawing(
        image=image,
        frame=frame,
        centre_px=centre_px,
        radius_px=finding.radius_mm / float(spacing.mean()),
        target_px=None if displacement_mm is None else centre_px + displacement_mm / spacing,
    )


def _annotations(finding: ReportContent, drawing: Drawing) -> Iterator[GraphicAnnotation]:
    centre_px, radius_px, target_px = drawing.centre_px, drawing.radius_px, drawing.target_px
    arm = np.array([_CROSS * radius_px, 0.0])
    cross = [_line(centre_px - turn, centre_px + turn) for turn in (arm, arm[::-1])]
    rim_px = centre_px + np.array([0.0, radius_px])
    circle = GraphicObject("CIRCLE", _pixel(centre_px, rim_px), "PIXEL")
    yield _on(FIDUCIAL, drawing, [circle, *cross])
    if target_px is not None and drawing.target_is_inside:
        slant = _CROSS * radius_px * np.array([1.0, 1.0]) / np.sqrt(2)
        slants = [_line(target_px - turn, target_px + turn) for turn in (slant, slant * [1, -1])]
        yield _on(TARGET, drawing, slants)
        yield _on(PLAN, drawing, list(_arrow(centre_px, target_px)))
    words = TextObject(
        text_value=_words(finding, drawing),
        units="DISPLAY",
        bounding_box=(0.02, 0.02, 0.75, 0.14),
        text_justification="LEFT",
    )
    yield GraphicAnnotation(
        [drawing.image], NOTES, referenced_frame_number=drawing.frame, text_objects=[words]
    )


def _on(layer: GraphicLayer, drawing: Drawing, objects: list[GraphicObject]) -> GraphicAnnotation:
    return GraphicAnnotation(
        [drawing.image], layer, referenced_frame_number=drawing.frame, graphic_objects=objects
    )


def _pixel(*points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) points (row, col) from pixel centres -> (column, row) from the outer corner."""
    return np.array(points_px)[:, ::-1] + 0.5


def _line(*points_px: NDArray[np.float64]) -> GraphicObject:
    return GraphicObject("POLYLINE", _pixel(*points_px), "PIXEL")


def _arrow(from_px: NDArray[np.float64], to_px: NDArray[np.float64]) -> Iterator[GraphicObject]:
    """However short it is: viewers zoom."""
    yield _line(from_px, to_px)
    back = (from_px - to_px) * _HEAD
    side = np.array([-back[1], back[0]]) / 2
    yield _line(to_px + back + side, to_px, to_px + back - side)


def _words(finding: ReportContent, drawing: Drawing) -> str:
    place = " ".join(f"{value:.3f}" for value in finding.result["patient_mm"])
    sigma_um = 1000 * axis_sigma(finding.result["covariance_mm2"])
    lines = [RESEARCH, f"Fiducial at {place} mm (LPS), standard deviation {sigma_um:.0f} um"]
    distance = finding.distance
    if distance is not None:
        of = "Needle tip" if distance.of == "tip" else "Fiducial"
        line = f"{of} {1000 * distance.error_mm:.0f} +- {1000 * distance.sigma_mm:.0f} um off"
        if distance.probability is not None:
            tolerance_um = 1000 * (distance.tolerance_mm or 0.0)
            line += f", P(below {tolerance_um:.0f} um) = {distance.probability:.3f}"
        lines.append(line)
    if drawing.target_px is not None and not drawing.target_is_inside:
        lines.append("The target lies outside this image")
    return "\r\n".join(lines)
