"""The frames that a room's template is learnt from, and whether it applies to others.

A template belongs to one way of taking slices: another spacing, orientation, place along the
normal, bandwidth or encoding shows the same object otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from case_record.rows import SliceRow
from dicom_slice.geometry import SliceGeometry
from dicom_slice.protocol import other_protocol
from sr_engine.errors import EngineError, TemplateError
from sr_engine.localization import Localization
from sr_engine.localize import combined
from sr_engine.template.learn import Template
from sr_engine.template.poses import learn_from_places

Array = NDArray[np.float64]

SAME_SLICE_MM = 0.5
_CAMERA = "camera"
_SAME_DIRECTION = 1e-3
_SAME_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Frames:
    """What a measurement is made from: frames of one geometry, and their known shifts.

    pixels: (N, rows, cols); shifts_px: (N, 2), displacement from the reference pose.
    """

    pixels: NDArray[np.float64]
    shifts_px: NDArray[np.float64]
    geometry: SliceGeometry
    slices: tuple[SliceRow, ...]


@dataclass(frozen=True, eq=False)
class View:
    """An earlier measurement: its frames, and where it found the fiducial in the reference pose."""

    measurement_id: int
    frames: Frames
    reference_px: Array


@dataclass(frozen=True, eq=False)
class Learnt:
    """A template, and where by it the fiducial was in each of its views."""

    template: Template
    views: tuple[View, ...]
    places: tuple[Localization, ...]


def why_unlike(one: Frames, other: Frames) -> str:
    """What shows the fiducial otherwise in the other's slices; empty if nothing does."""
    a, b = one.geometry, other.geometry
    if a.shape != b.shape or not np.allclose(a.spacing_mm, b.spacing_mm, rtol=_SAME_SHARE):
        return f"pixels or a matrix of another size ({_size(b)} instead of {_size(a)})"
    for name in ("row_direction", "col_direction"):
        if not np.allclose(getattr(a, name), getattr(b, name), atol=_SAME_DIRECTION):
            return "another orientation"
    apart_mm = float(a.normal @ (np.array(b.position_mm) - np.array(a.position_mm)))
    if not abs(apart_mm) <= SAME_SLICE_MM:
        return f"a place {apart_mm:+.1f} mm along the slice normal"
    return other_protocol(one.slices[0].header, other.slices[0].header)


def _size(geometry: SliceGeometry) -> str:
    (rows, cols), (row_mm, col_mm) = geometry.shape, geometry.spacing_mm
    return f"{rows} x {cols} of {row_mm:g} x {col_mm:g} mm"


class Templates:
    """Templates, each learnt once from the slices that it rests on."""

    def __init__(self) -> None:
        self._known: dict[tuple[tuple[str, int], ...], Learnt | TemplateError] = {}

    def of(self, views: Sequence[View], radius_px: tuple[float, float]) -> Learnt:
        """Raises TemplateError where the views make none, and says why."""
        key = tuple((s.sop_instance_uid, s.frame) for view in views for s in view.frames.slices)
        if key not in self._known:
            try:
                self._known[key] = _learnt(views, radius_px)
            except EngineError as error:
                self._known[key] = TemplateError(str(error))
        known = self._known[key]
        if isinstance(known, TemplateError):
            raise known
        return known


def _learnt(views: Sequence[View], radius_px: tuple[float, float]) -> Learnt:
    if not views:
        raise TemplateError("no measurement was named to learn a template from")
    if any(row.header.get("kind") == _CAMERA for view in views for row in view.frames.slices):
        # its pixels fold what is finer than they are: sigma would be too small (by a quarter)
        raise TemplateError("a template needs band-limited images, and a camera's are not")
    for view in views[1:]:
        if other := why_unlike(views[0].frames, view.frames):
            raise TemplateError(
                f"measurement {view.measurement_id} has slices with {other}: not the same protocol"
            )
    pixels = np.concatenate([view.frames.pixels for view in views])
    places = np.concatenate([view.reference_px + view.frames.shifts_px for view in views])
    template, fits = learn_from_places(pixels, places, radius_px=radius_px)
    found, begin = [], 0
    for view in views:
        end = begin + len(view.frames.pixels)
        found.append(
            combined(
                fits[begin:end],
                view.frames.shifts_px,
                template.radius_px,
                0.0,
                method="template",
                systematic_px=template.systematic_px,
            )
        )
        begin = end
    return Learnt(template, tuple(views), tuple(found))
