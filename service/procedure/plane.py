"""The image plane of a case: which two patient directions rows and columns grow along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PARALLEL = 1e-3


@dataclass(frozen=True)
class ImagePlane:
    """Unit vectors in patient coordinates (LPS) and pixel spacing (between rows, columns) in mm."""

    row_direction: tuple[float, float, float]
    col_direction: tuple[float, float, float]
    spacing_mm: tuple[float, float]

    def from_patient(self, patient_mm: Sequence[float]) -> NDArray[np.float64]:
        """Patient mm (3,) -> plane mm (2,): projections onto row and column direction."""
        point = np.asarray(patient_mm, dtype=float)
        return np.array(
            [point @ np.array(self.row_direction), point @ np.array(self.col_direction)]
        )

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector (3,), patient LPS: column direction x row direction."""
        return np.cross(self.col_direction, self.row_direction)

    def direction(self, plane_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Plane mm (2,) -> the vector (3,) in the plane through the patient's origin."""
        rows, cols = np.array(self.row_direction), np.array(self.col_direction)
        return np.asarray(plane_mm[0] * rows + plane_mm[1] * cols)

    def is_parallel_to(self, other: ImagePlane) -> bool:
        """True if a position in the other plane's coordinates means the same here."""
        pairs = (
            (self.row_direction, other.row_direction),
            (self.col_direction, other.col_direction),
        )
        return all(np.linalg.norm(np.subtract(a, b)) < _PARALLEL for a, b in pairs)

    def to_json(self) -> dict[str, Any]:
        return {
            "row_direction": list(self.row_direction),
            "col_direction": list(self.col_direction),
            "spacing_mm": list(self.spacing_mm),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ImagePlane:
        r0, r1, r2 = value["row_direction"]
        c0, c1, c2 = value["col_direction"]
        between_rows, between_cols = value["spacing_mm"]
        return cls((r0, r1, r2), (c0, c1, c2), (between_rows, between_cols))
