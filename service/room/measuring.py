"""A measurement as the procedure asks for it, and as the worker's result answers it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from service.procedure.steps import Measure, Measured, seen_before


def measure_request(
    step: Measure,
    radius_mm: tuple[float, float],
    region_px: tuple[float, float, float, float] | None = None,
) -> dict[str, Any]:
    """What the record keeps of a Measure step, for the worker (`sr_engine.worker`).

    region_px: where to look while nothing is known of the fiducial's place.
    """
    expected = step.expected_plane_mm
    template = {"template": list(step.template)} if step.template else {}
    any_shape = {"any_shape": True} if step.any_shape else {}
    return {
        "holds": [{"hold_id": h.hold_id, "shift_mm": list(h.shift_mm)} for h in step.holds],
        "expected_plane_mm": None if expected is None else list(expected),
        "gate_mm": step.gate_mm,
        "shift_sigma_mm": step.shift_sigma_mm,
        "slice_position_mm": step.slice_position_mm,
        "radius_mm": list(radius_mm),
        "region_px": None if region_px is None else list(region_px),
        **template,
        **any_shape,
    }


def measured_from_result(measurement_id: int, result: Mapping[str, Any]) -> Measured:
    """The outcome of a Measure step from what the worker wrote."""
    row, col = result["plane_mm"]
    (a, b), (c, d) = np.array(result["covariance_mm2"]).tolist()
    return Measured(
        measurement_id,
        plane_mm=(row, col),
        covariance_mm2=((a, b), (c, d)),
        plane=result["plane"],
        frames=result["n_frames"],
        scan_s=result["scan_s"],
        method=result.get("method", ""),
        systematic_mm=_pair(result.get("systematic_mm")),
        own_mm=_pair(result.get("template", {}).get("sigma_mm")),
        views=tuple(seen_before(view) for view in result.get("template", {}).get("views", ())),
        common_mm=_pair(result.get("common_mm")),
    )


def _pair(values: list[float] | None) -> tuple[float, float]:
    row, col = values or (0.0, 0.0)
    return row, col
