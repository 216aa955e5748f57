"""A requested measurement: its slices, their point spread, and the fit. No I/O here.

The one policy of localization: what steers, what is replayed, and what the studies count is asked
for and answered here. Beside the engine's numerics it knows slices as the record describes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast, get_args

import numpy as np
import structlog
from numpy.typing import NDArray

from case_record.rows import SliceRow
from dicom_slice.geometry import SliceGeometry
from room_config.imaging import PointSpreadConfig
from sr_engine.checks import refuse_non_square
from sr_engine.errors import (
    InconsistentFramesError,
    NoRoundObjectError,
    NotConvergedError,
    ObjectAtBorderError,
    OutsideGateError,
    TemplateError,
    TemplateMismatchError,
)
from sr_engine.hough import HoughSettings
from sr_engine.localization import Localization
from sr_engine.localize import SEARCH_PX, localize
from sr_engine.paper import PaperMethod, PaperSettings, localize_paper
from sr_engine.psf import Psf
from sr_engine.recognise import psf_of_noise
from sr_engine.result import TEMPLATE, Found, plane_mm
from sr_engine.template.outline import SIGMA_PX, compact_object
from sr_engine.template.poses import localize_by_template
from sr_engine.views import SAME_SLICE_MM, Frames, Learnt, Templates, View, why_unlike

_SAME_PLACE = 1e-6
_BUT_NO_DISC = (NoRoundObjectError, NotConvergedError, InconsistentFramesError)
log = structlog.get_logger()


class UnusableSlicesError(Exception):
    """The slices of a measurement do not belong together, or cannot be read."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class PointSpreads:
    """The point spread of any slices: the configured one, or recognised once for each series."""

    def __init__(self, configured: PointSpreadConfig | None = None) -> None:
        self._configured = None
        if configured is not None:
            self._configured = Psf(configured.kind, configured.parameters, configured.acquired)
        self._recognised: dict[tuple[str, tuple[int, int]], Psf] = {}

    def of(self, frames: Frames) -> Psf:
        """Recognised in the noise of the first frame that is seen of a series."""
        if self._configured is not None:
            return self._configured
        series = str(frames.slices[0].header.get("series_instance_uid", ""))
        key = (series, frames.geometry.shape)
        if key not in self._recognised:
            psf = self._recognised[key] = psf_of_noise(frames.pixels[0])
            log.info("point spread", series=series, kind=psf.kind, acquired=psf.acquired)
        return self._recognised[key]


def is_at_position(row: SliceRow, slice_position_mm: float | None) -> bool:
    """True if the middle of the slice is there along its normal; None is everywhere."""
    if slice_position_mm is None:
        return True
    geometry = geometry_of(row.header)
    return abs(float(geometry.normal @ geometry.position_mm) - slice_position_mm) <= SAME_SLICE_MM


def geometry_of(header: Mapping[str, Any]) -> SliceGeometry:
    """Return the slice geometry from the header as the record keeps it."""
    geometry = header["geometry"]
    return SliceGeometry(
        position_mm=tuple(geometry["position_mm"]),
        row_direction=tuple(geometry["row_direction"]),
        col_direction=tuple(geometry["col_direction"]),
        spacing_mm=tuple(geometry["spacing_mm"]),
        shape=tuple(geometry["shape"]),
    )


def localize_request(
    frames: Frames,
    method: str,
    request: Mapping[str, Any],
    psf: Psf | None = None,
    views: Sequence[View] = (),
    templates: Templates | None = None,
) -> Found:
    """Localize the fiducial where it is expected, or anywhere if nothing is known of its place.

    request: radius_mm (low, high); expected_plane_mm and gate_mm (both None: not known);
    region_px (r0, c0, r1, c1), where to look then (None: the whole slice); shift_sigma_mm
    (standard deviation of a commanded shift, one axis); any_shape: what is no disc is found by its
    outline, roughly. views, for method "template": of the measurements that it is learnt from;
    where it does not apply the disc fit answers, and `why_not` says so. Raises an EngineError.
    """
    if method != TEMPLATE:
        return Found(_found_as_disc(frames, method, request, psf))
    templates = templates or Templates()
    radius_px = _radius_px(frames, request)
    learnt: Learnt | None = None
    try:
        learnt = templates.of(views, radius_px)
        why_not = why_unlike(views[0].frames, frames)
    except TemplateError as error:
        why_not = str(error)
    if learnt is not None and not why_not:
        return Found(_found_by_template(frames, request, learnt), learnt)
    if learnt is not None:
        why_not = f"these slices have {why_not}, which needs another template: calibrate again"
    try:
        disc = _found_as_disc(frames, "ml", request, psf)
    except _BUT_NO_DISC as error:
        raise TemplateError(f"no template: {why_not}; and no disc: {error}") from error
    if learnt is not None:  # what the two mean by the fiducial's middle differs by this
        doubt = np.diag(np.square(learnt.template.systematic_px))
        disc = replace(
            disc,
            covariance_px2=disc.covariance_px2 + doubt,
            systematic_px=learnt.template.systematic_px,
        )
    return Found(disc, why_not=why_not)


def _radius_px(frames: Frames, request: Mapping[str, Any]) -> tuple[float, float]:
    mean_mm = float(np.mean(frames.geometry.spacing_mm))
    low_mm, high_mm = request["radius_mm"]
    return low_mm / mean_mm, high_mm / mean_mm


def _found_by_template(frames: Frames, request: Mapping[str, Any], learnt: Learnt) -> Localization:
    spacing = np.array(frames.geometry.spacing_mm)
    mean_mm = float(np.mean(spacing))
    shift_sigma_px = float(request.get("shift_sigma_mm", 0.0)) / mean_mm
    try:
        if request["expected_plane_mm"] is None:
            region = _whole_pixels(frames.geometry.shape, request.get("region_px"))
            return localize_by_template(
                frames.pixels,
                frames.shifts_px,
                learnt.template,
                region=region,
                shift_sigma_px=shift_sigma_px,
            )
        expected_px = _expected_px(frames, request)
        gate_px = float(request["gate_mm"]) / mean_mm
        found = localize_by_template(
            frames.pixels,
            frames.shifts_px,
            learnt.template,
            start_px=expected_px,
            gate_px=gate_px,
            shift_sigma_px=shift_sigma_px,
        )
    except (TemplateMismatchError, NoRoundObjectError, NotConvergedError) as error:
        raise TemplateMismatchError(
            f"{error}: the fiducial does not look as in the slices of the calibration. Take the "
            "slice again; if that does not help (a bubble has moved, the slice lies elsewhere), "
            "calibrate again"
        ) from error
    _refuse_outside(found, expected_px, gate_px, mean_mm)
    return found


def _expected_px(frames: Frames, request: Mapping[str, Any]) -> NDArray[np.float64]:
    expected_mm = np.array(request["expected_plane_mm"])
    origin_mm = plane_mm(frames.geometry, np.zeros(2))
    return np.asarray((expected_mm - origin_mm) / np.array(frames.geometry.spacing_mm))


def _refuse_outside(
    found: Localization, expected_px: NDArray[np.float64], gate_px: float, mean_mm: float
) -> None:
    miss_px = float(np.linalg.norm(np.asarray(found.centre_px) - expected_px))
    if not miss_px <= gate_px:
        raise OutsideGateError(
            f"the object found is {miss_px * mean_mm:.1f} mm from where the fiducial is "
            f"expected (limit {gate_px * mean_mm:.1f} mm)"
        )


def _found_as_disc(
    frames: Frames, method: str, request: Mapping[str, Any], psf: Psf | None
) -> Localization:
    refuse_non_square(frames.geometry.spacing_mm)
    mean_mm = float(np.mean(frames.geometry.spacing_mm))
    radius_px = _radius_px(frames, request)
    expected_px, gate_px = None, math.inf
    region: Sequence[float] | None = request.get("region_px")
    if request["expected_plane_mm"] is not None:
        expected_px = _expected_px(frames, request)
        gate_px = float(request["gate_mm"]) / mean_mm
        reach = gate_px + 2 * radius_px[1]
        region = (*(expected_px - reach), *(expected_px + reach))
    try:
        if expected_px is None:
            start_px = _start_anywhere(frames, method, radius_px, region)
        elif (
            region is not None and gate_px > SEARCH_PX
        ):  # the engine looks no further than that from a start
            start_px = _start_in_region(frames, method, radius_px, region)
        else:
            start_px = expected_px
        found = _localize_by(method, frames, start_px, radius_px, request, psf)
    except _BUT_NO_DISC as error:
        if not request.get("any_shape"):
            raise
        found = _found_by_outline(frames, radius_px, region, error)
    if expected_px is not None:
        _refuse_outside(found, expected_px, gate_px, mean_mm)
    if found.systematic_px is not None:
        # a calibration by discs knows no common part, so it counts in full, for any target
        common = found.systematic_px
        whole = found.covariance_px2 + np.diag(np.square(common))
        found = replace(found, covariance_px2=whole, systematic_px=None, common_px=common)
    return found


def _found_by_outline(
    frames: Frames,
    radius_px: tuple[float, float],
    region_px: Sequence[float] | None,
    no_disc: Exception,
) -> Localization:
    """Of one compact object of whatever shape, the mean over the frames, roughly."""
    r0, c0, r1, c1 = _whole_pixels(frames.geometry.shape, region_px)
    try:
        seen = [compact_object(frame[r0:r1, c0:c1], radius_px) for frame in frames.pixels]
    except NoRoundObjectError as error:
        raise NoRoundObjectError(f"{no_disc}; {error}") from error
    corner = np.array([r0, c0])
    centres = np.array([centre for centre, _ in seen]) + corner - frames.shifts_px
    count = len(seen)
    return Localization(
        centre_px=centres.mean(axis=0),
        covariance_px2=np.eye(2) * SIGMA_PX**2,
        radius_px=float(np.mean([radius for _, radius in seen])),
        amplitude=0.0,
        background=0.0,
        snr=0.0,
        sigma=0.0,
        chi2_per_dof=1.0,
        n_frames=count,
        method="outline",
        residuals_px=centres - centres.mean(axis=0),
        psf=None,
    )


def _localize_by(
    method: str,
    frames: Frames,
    start_px: NDArray[np.float64] | None,
    radius_px: tuple[float, float],
    request: Mapping[str, Any],
    psf: Psf | None,
) -> Localization:
    if method in get_args(PaperMethod):
        return localize_paper(
            frames.pixels,
            frames.shifts_px,
            cast(PaperMethod, method),
            start_px=start_px,
            settings=PaperSettings(HoughSettings(radius_px)),
        )
    mean_mm = float(np.mean(frames.geometry.spacing_mm))
    return localize(
        frames.pixels,
        frames.shifts_px,
        start_px=start_px,
        radius_px=radius_px,
        method=method,
        psf=psf,
        shift_sigma_px=float(request.get("shift_sigma_mm", 0.0)) / mean_mm,
    )


def _start_anywhere(
    frames: Frames,
    method: str,
    radius_px: tuple[float, float],
    region_px: Sequence[float] | None,
) -> NDArray[np.float64] | None:
    """None where the method's own search over the whole slice serves."""
    if region_px is not None:
        return _start_in_region(frames, method, radius_px, region_px)
    if method in get_args(PaperMethod):  # a circle transform takes any edge that is round
        rows, cols = frames.geometry.shape
        return _start_in_region(frames, method, radius_px, (0, 0, rows, cols))
    return None


def _start_in_region(
    frames: Frames, method: str, radius_px: tuple[float, float], region_px: Sequence[float]
) -> NDArray[np.float64]:
    """The one round object of the first frame that lies in the region, in the reference pose."""
    r0, c0, r1, c1 = _whole_pixels(frames.geometry.shape, region_px)
    part = frames.pixels[0, r0:r1, c0:c1]
    try:
        centre_px = np.asarray(localize(part, radius_px=radius_px).centre_px)
    except _BUT_NO_DISC:
        if method not in get_args(PaperMethod):
            raise
        centre_px = compact_object(part, radius_px)[0]  # what is a circle there, it finds itself
    return centre_px + np.array([r0, c0]) - frames.shifts_px[0]


def _whole_pixels(
    shape: tuple[int, int], region_px: Sequence[float] | None
) -> tuple[int, int, int, int]:
    """A region (r0, c0, r1, c1) in whole pixels, as far as it lies in the slice; None: all of it.

    Raises ObjectAtBorderError where nothing of it does.
    """
    rows, cols = shape
    if region_px is None:
        return 0, 0, rows, cols
    r0, c0 = (max(0, math.floor(value)) for value in region_px[:2])
    r1, c1 = min(rows, math.ceil(region_px[2]) + 1), min(cols, math.ceil(region_px[3]) + 1)
    if r1 <= r0 or c1 <= c0:
        raise ObjectAtBorderError(
            f"rows {r0} to {r1}, columns {c0} to {c1}, where the fiducial is looked for, lie "
            f"outside the {rows} x {cols} slice"
        )
    return r0, c0, r1, c1


def common_geometry(slices: list[SliceRow]) -> SliceGeometry:
    first = geometry_of(slices[0].header)
    for row in slices[1:]:
        other = geometry_of(row.header)
        same = other.shape == first.shape and all(
            np.allclose(getattr(other, name), getattr(first, name), atol=_SAME_PLACE)
            for name in ("position_mm", "row_direction", "col_direction", "spacing_mm")
        )
        if not same:
            raise UnusableSlicesError(
                "geometry_changed",
                f"slice {row.sop_instance_uid} is not at the same position as slice "
                f"{slices[0].sop_instance_uid} of the same measurement",
            )
    return first
