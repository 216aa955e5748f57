"""What the record keeps of a measurement, and what is read back from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dicom_slice.geometry import SliceGeometry
from sr_engine.localization import Localization
from sr_engine.psf import Psf
from sr_engine.views import Frames, Learnt

TEMPLATE = "template"


@dataclass(frozen=True, eq=False)
class Found:
    """A localization, and what it rests on.

    learnt: the template, where it is one's; why_not: why it is not, though one was asked for.
    """

    by: Localization
    learnt: Learnt | None = None
    why_not: str = ""


def describe_result(frames: Frames, answer: Found) -> dict[str, Any]:
    """Return what the record keeps of a localization, JSON-ready; see `case_record.rows`."""
    geometry, found = frames.geometry, answer.by
    spacing = np.array(geometry.spacing_mm)
    covariance = np.asarray(found.covariance_px2)
    centre = np.asarray(found.centre_px)
    # the newest slice is what the page shows: say where the fiducial is in that one
    shown_px = centre + frames.shifts_px[-1]
    return {
        "slice_id": frames.slices[-1].slice_id,
        "slice_ids": [row.slice_id for row in frames.slices],
        "centre_px": shown_px.tolist(),
        "reference_px": centre.tolist(),
        "sigma_px": np.sqrt(np.diag(covariance)).tolist(),
        "covariance_px2": covariance.tolist(),
        "radius_px": float(found.radius_px),
        "snr": float(found.snr),
        "chi2_per_dof": float(found.chi2_per_dof),
        "residuals_px": np.asarray(found.residuals_px).tolist(),
        "method": found.method,
        "n_frames": int(found.n_frames),
        "patient_mm": geometry.patient_from_pixel(centre).tolist(),
        "plane_mm": plane_mm(geometry, centre).tolist(),
        "covariance_mm2": (covariance * np.outer(spacing, spacing)).tolist(),
        "plane": {
            "row_direction": list(geometry.row_direction),
            "col_direction": list(geometry.col_direction),
            "spacing_mm": list(geometry.spacing_mm),
        },
        "scan_s": sum(_scan_s(row.header) for row in frames.slices),
        **_in_mm("systematic_mm", found.systematic_px, spacing),
        **_in_mm("common_mm", found.common_px, spacing),
        **({} if answer.learnt is None else {TEMPLATE: _described(answer.learnt)}),
        **({} if not answer.why_not else {"why_no_template": answer.why_not}),
    }


def _in_mm(
    name: str, std_px: NDArray[np.float64] | None, spacing_mm: NDArray[np.float64]
) -> dict[str, Any]:
    """What is common to several places, std (row, col): see `Localization`."""
    return {} if std_px is None else {name: (np.asarray(std_px) * spacing_mm).tolist()}


def _described(learnt: Learnt) -> dict[str, Any]:
    """A template, by the slices that it was learnt from, and where it finds the fiducial there."""
    spacing = np.array(learnt.views[0].frames.geometry.spacing_mm)
    places = [
        {
            "measurement_id": view.measurement_id,
            "slice_ids": [row.slice_id for row in view.frames.slices],
            "plane_mm": plane_mm(view.frames.geometry, np.asarray(place.centre_px)).tolist(),
            "covariance_mm2": (place.covariance_px2 * np.outer(spacing, spacing)).tolist(),
        }
        for view, place in zip(learnt.views, learnt.places, strict=True)
    ]
    own = np.sqrt(np.diag(learnt.template.common_px2)) * spacing
    return {"frames": learnt.template.n_frames, "sigma_mm": own.tolist(), "views": places}


def _scan_s(header: Mapping[str, Any]) -> float:
    """How long the scanner took for this slice, by its own clock; 0 where it does not say."""
    interval = header.get("interval") or {}
    start_s, end_s = interval.get("start_s"), interval.get("end_s")
    return 0.0 if start_s is None or end_s is None else float(end_s - start_s)


def recorded_point_spread(result: Mapping[str, Any] | None) -> Psf | None:
    """What a recorded measurement was made with; None where its record does not say."""
    recorded = (result or {}).get("point_spread")
    if recorded is None:
        return None
    return Psf(recorded["kind"], tuple(recorded["parameters"]), tuple(recorded["acquired"]))


def plane_mm(geometry: SliceGeometry, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """A pixel (row, col) in the image plane, mm from the patient's origin."""
    position = np.array(geometry.position_mm)
    origin_mm = np.array([position @ geometry.row_direction, position @ geometry.col_direction])
    return np.asarray(origin_mm + pixel * np.array(geometry.spacing_mm))
