"""Pixel index <-> patient millimetres: the one place that knows axis order and the half pixel.

Pixel (0, 0) has its centre at index (0.0, 0.0). Points are (row, col). Patient coordinates are
LPS millimetres. A DICOM header names the directions the other way about: the first triple of
ImageOrientationPatient points along increasing *column* index (DICOM PS3.3 C.7.6.2.1.1).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

_DIRECTION_TOLERANCE = 1e-3  # headers carry about six digits; oblique ones fewer


class GeometryError(ValueError):
    """Values that make no slice geometry, or points of the wrong size; one line."""


@dataclass(frozen=True)
class SliceGeometry:
    """Where the pixels of one slice are in the patient.

    position_mm: centre of pixel (0, 0), LPS.
    row_direction: unit vector along which the row index grows (second triple of the header).
    col_direction: unit vector along which the column index grows (first triple of the header).
    spacing_mm: (between rows, between columns), as in PixelSpacing.
    shape: (rows, cols).
    """

    position_mm: tuple[float, float, float]
    row_direction: tuple[float, float, float]
    col_direction: tuple[float, float, float]
    spacing_mm: tuple[float, float]
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        numbers = (*self.position_mm, *self.row_direction, *self.col_direction, *self.spacing_mm)
        if not np.all(np.isfinite(numbers)):
            raise GeometryError(f"slice geometry has a value that is not finite: {numbers}")
        if not min(self.spacing_mm) > 0:
            raise GeometryError(f"pixel spacing must be positive, is {self.spacing_mm} mm")
        if not min(self.shape) > 0:
            raise GeometryError(f"a slice needs rows and columns, has {self.shape}")
        row, col = np.array(self.row_direction), np.array(self.col_direction)
        skew = max(abs(row @ row - 1), abs(col @ col - 1), abs(row @ col))
        if not skew < _DIRECTION_TOLERANCE:
            raise GeometryError(
                f"row and column directions must be orthonormal, are off by {skew:.2g}"
            )

    @classmethod
    def from_header(
        cls,
        image_position: ArrayLike,
        image_orientation: ArrayLike,
        pixel_spacing: ArrayLike,
        shape: tuple[int, int],
    ) -> "SliceGeometry":
        """Geometry from the three DICOM attributes, in the order in which DICOM writes them."""
        position = np.asarray(image_position, dtype=float).ravel()
        orientation = np.asarray(image_orientation, dtype=float).ravel()
        spacing = np.asarray(pixel_spacing, dtype=float).ravel()
        if (position.size, orientation.size, spacing.size) != (3, 6, 2):
            raise GeometryError(
                "position, orientation and spacing need 3, 6 and 2 values, have "
                f"{position.size}, {orientation.size} and {spacing.size}"
            )
        x, y, z = position.tolist()
        c0, c1, c2, r0, r1, r2 = orientation.tolist()
        between_rows, between_cols = spacing.tolist()
        return cls((x, y, z), (r0, r1, r2), (c0, c1, c2), (between_rows, between_cols), shape)

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal, column direction x row direction (the DICOM slice direction)."""
        normal = np.cross(self.col_direction, self.row_direction)
        return normal / np.linalg.norm(normal)

    @property
    def angle_to_coronal_deg(self) -> float:
        """Angle between the slice normal and the patient's antero-posterior axis, 0 to 90."""
        along_y = min(1.0, abs(float(self.normal[1])))
        return float(np.degrees(np.arccos(along_y)))

    def patient_from_pixel(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 2) in (row, col) -> (..., 3) in LPS mm."""
        points = _points(points_px, 2)
        return np.asarray(self.position_mm) + points @ self._steps_mm()

    def pixel_from_patient(
        self, points_mm: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points (..., 3) in LPS mm -> ((..., 2) in (row, col), (...) mm along the normal)."""
        offsets_mm = _points(points_mm, 3) - np.asarray(self.position_mm)
        in_plane = np.linalg.pinv(self._steps_mm())
        return offsets_mm @ in_plane, offsets_mm @ self.normal

    def finer_grid(
        self, factor: int, origin_px: tuple[float, float] | None = None
    ) -> "SliceGeometry":
        """The same field of view on a grid `factor` times as fine.

        origin_px: index (row, col) in this grid of the finer grid's pixel (0, 0). By default
        the pixels of this grid are divided where they are, so that the outer edges coincide and
        the first centre moves by the half pixel: (1/factor - 1)/2. A grid whose every
        `factor`-th sample falls on a sample of this one has origin_px = (0, 0).
        """
        if factor < 1:
            raise GeometryError(f"factor must be at least 1, is {factor}")
        half = (1 / factor - 1) / 2
        origin = (half, half) if origin_px is None else origin_px
        x, y, z = self.patient_from_pixel(origin).tolist()
        return replace(
            self,
            position_mm=(x, y, z),
            spacing_mm=(self.spacing_mm[0] / factor, self.spacing_mm[1] / factor),
            shape=(self.shape[0] * factor, self.shape[1] * factor),
        )

    def _steps_mm(self) -> NDArray[np.float64]:
        """(2, 3): patient displacement of one step in row index, and of one in column index."""
        directions = np.array([self.row_direction, self.col_direction])
        return directions * np.array(self.spacing_mm)[:, None]


def rounded_directions(directions: tuple[float, ...], written: str) -> tuple[float, ...]:
    """Direction cosines made orthonormal where only their rounding keeps them from it.

    directions: the six numbers of ImageOrientationPatient; written: as text, which shows to how
    many decimals. What is off by more than rounding explains, or needs nothing, is returned as is.
    """
    decimals = max(len(text.partition(".")[2]) for text in written.split("\\"))
    first, second = np.reshape(directions, (2, 3))
    skew = max(abs(first @ first - 1), abs(second @ second - 1), abs(first @ second))
    by_rounding = 2 * np.sqrt(3) * 0.5 * 10.0**-decimals
    if skew < _DIRECTION_TOLERANCE or decimals < 2 or not skew <= by_rounding:
        return directions
    # the nearest orthonormal pair: neither of the two is trusted more than the other
    left, _, right = np.linalg.svd(np.stack([first, second]), full_matrices=False)
    return tuple((left @ right).ravel().tolist())


def _points(points: ArrayLike, size: int) -> NDArray[np.float64]:
    array = np.asarray(points, dtype=float)
    if array.ndim == 0 or array.shape[-1] != size:
        raise GeometryError(f"points need {size} coordinates each, array has shape {array.shape}")
    return array
