"""What images say of where the stages truly stand: how far off their counts are.

The count of an axis without encoder drifts with every move. An image does not: from one look to
another the fiducial has gone as far as the stages carried it, whatever was counted in between. So
the first look of a calibration is kept as a reference, with what was known of the counts then, and
every later look corrects them; what is not known of a count stops growing with the number of moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from service.procedure.calibration import Calibration

# The image Jacobian has learned counted millimetres, which are off by the step lengths' error.
SCALE_ERROR = 0.05
SIGMAS = 3.0


@dataclass(frozen=True)
class Look:
    """The fiducials in the image plane (n,), mm, while the axes counted and were known so."""

    axes: tuple[str, ...]
    plane_mm: tuple[float, ...]
    row_direction: tuple[float, ...]
    col_direction: tuple[float, ...]
    counted_um: Mapping[str, int]
    correction_um: Mapping[str, int]
    bound_um: Mapping[str, int]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Look:
        listed = ("axes", "plane_mm", "row_direction", "col_direction")
        return cls(**{**value, **{name: tuple(value[name]) for name in listed}})


def look_of(
    calibration: Calibration,
    counted_um: Mapping[str, int],
    correction_um: Mapping[str, int],
    bound_um: Mapping[str, int],
) -> Look:
    axes = calibration.jacobian.axes
    return Look(
        axes,
        tuple(calibration.estimate.plane_mm.tolist()),
        tuple(calibration.plane.row_direction),
        tuple(calibration.plane.col_direction),
        {axis: counted_um[axis] for axis in axes},
        {axis: correction_um.get(axis, 0) for axis in axes},
        {axis: bound_um[axis] for axis in axes},
    )


def is_comparable(reference: Look, now: Look) -> bool:
    """Whether both are of the same axes, seen in the same plane."""
    directions = (reference.row_direction, reference.col_direction)
    here = (now.row_direction, now.col_direction)
    return reference.axes == now.axes and bool(np.allclose(directions, here, atol=1e-3))


def corrections(
    reference: Look, now: Look, calibration: Calibration
) -> tuple[dict[str, int], dict[str, int]] | None:
    """By axis, what to add to its count, and within how much that is true, µm.

    None if it contradicts what is known of an axis: then something else has moved (the table, the
    patient's fiducial), or the axis was declared anew.
    """
    seen_mm = np.array(now.plane_mm) - np.array(reference.plane_mm)
    gone_mm = np.linalg.solve(calibration.jacobian.mean_columns, seen_mm)
    spread = np.linalg.inv(calibration.jacobian.mean_columns)
    sigma_mm = np.sqrt(np.diag(spread @ calibration.estimate.covariance_mm2 @ spread.T))
    correction_um, within_um = {}, {}
    for number, axis in enumerate(reference.axes):
        was_um = reference.counted_um[axis] + reference.correction_um[axis]
        off_um = was_um + gone_mm[number] * 1000 - now.counted_um[axis]
        unsure_um = SCALE_ERROR * abs(gone_mm[number]) * 1000 + SIGMAS * sigma_mm[number] * 1000
        bound_um = reference.bound_um[axis] + unsure_um
        if abs(off_um - now.correction_um[axis]) > bound_um + now.bound_um[axis]:
            return None
        if bound_um < now.bound_um[axis]:
            correction_um[axis] = round(off_um)
            within_um[axis] = int(np.ceil(bound_um))
    return correction_um, within_um
