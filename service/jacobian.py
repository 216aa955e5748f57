"""The image Jacobian: how the fiducial moves in the image plane when an axis setpoint moves.

Everything is in millimetres of the image plane (along increasing row, along increasing column) per
millimetre of axis setpoint, so that it does not depend on pixel size: the Jacobian of a
super-resolution image is this one divided by its spacing.

A Piezo LEGS step is not equally long in both directions, so each axis has two columns: one for
growing and one for shrinking setpoints. They are estimated together; a prior says that they differ
by a few per cent, so a move in one direction teaches most of the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_VAGUE_SCALE = 2.0
_SCALE_RANGE = (0.6, 1.6)
_SMALLEST_ANGLE_DEG = 60.0


class CalibrationError(Exception):
    """The moves of a calibration do not give an image Jacobian that could be right."""


@dataclass(frozen=True, eq=False)
class ImageJacobian:
    """Estimate with covariance.

    axes: names of the two axes, in the order of the columns.
    columns: (2, 4), mm/mm; columns for (axis 0 growing, axis 0 shrinking, axis 1 growing, axis 1
        shrinking), rows for (row direction, column direction).
    covariance: (8, 8) of `columns.ravel()`.
    """

    axes: tuple[str, str]
    columns: Array
    covariance: Array

    @classmethod
    def unknown(cls, axes: tuple[str, str], direction_asymmetry: float = 0.05) -> ImageJacobian:
        """Nothing is known but that both directions of an axis agree to `direction_asymmetry`."""
        pair = np.full((2, 2), _VAGUE_SCALE**2) + np.eye(2) * direction_asymmetry**2
        covariance = np.kron(np.eye(4), pair).astype(np.float64)
        return cls(axes, np.zeros((2, 4)), covariance)

    def displacement(self, change_mm: Mapping[str, float]) -> tuple[Array, Array]:
        """Return the fiducial's displacement (2,) mm for a setpoint change, and its covariance."""
        regressors = self._regressors(change_mm)
        observe = np.kron(np.eye(2), regressors)
        return self.columns @ regressors, observe @ self.covariance @ observe.T

    def setpoint_change_mm(self, displacement_mm: Array) -> dict[str, float]:
        """Return the setpoint change that displaces the fiducial by `displacement_mm` (2,)."""
        for choice in product((0, 1), (2, 3)):
            matrix = self.columns[:, choice]
            if abs(np.linalg.det(matrix)) < 1e-3:
                raise CalibrationError("the image Jacobian is singular: two axes act alike")
            change = np.linalg.solve(matrix, displacement_mm)
            signs = np.array([1 if index % 2 == 0 else -1 for index in choice])
            if np.all(change * signs >= 0):
                return dict(zip(self.axes, change.tolist(), strict=True))
        # the columns of both directions differ so much that no choice fits: take their mean
        matrix = (self.columns[:, (0, 2)] + self.columns[:, (1, 3)]) / 2
        return dict(zip(self.axes, np.linalg.solve(matrix, displacement_mm).tolist(), strict=True))

    def updated(
        self, change_mm: Mapping[str, float], displacement_mm: Array, noise_mm2: Array
    ) -> ImageJacobian:
        """Learn from one move: recursive least squares with the noise (2, 2) of the displacement.

        Short moves carry little weight by themselves, because their noise is the same.
        """
        observe = np.kron(np.eye(2), self._regressors(change_mm))
        innovation = displacement_mm - observe @ self.columns.ravel()
        innovation_covariance = observe @ self.covariance @ observe.T + noise_mm2
        gain = np.linalg.solve(innovation_covariance, observe @ self.covariance).T
        columns = self.columns.ravel() + gain @ innovation
        rest = np.eye(8) - gain @ observe
        covariance = rest @ self.covariance @ rest.T + gain @ noise_mm2 @ gain.T
        return ImageJacobian(self.axes, columns.reshape(2, 4), covariance)

    def check(self) -> None:
        """Raise CalibrationError unless every axis moves the fiducial about 1 mm per mm."""
        lengths = np.linalg.norm(self.columns, axis=0)
        low, high = _SCALE_RANGE
        for index, length in enumerate(lengths):
            if not low <= length <= high:
                raise CalibrationError(
                    f"axis {self.axes[index // 2]}: the fiducial moved {length:.2f} mm per mm of "
                    f"setpoint, expected {low} to {high}; was the move seen?"
                )
        cosine = abs(self.columns[:, 0] @ self.columns[:, 2]) / (lengths[0] * lengths[2])
        angle_deg = float(np.degrees(np.arccos(min(1.0, cosine))))
        if not angle_deg >= _SMALLEST_ANGLE_DEG:
            raise CalibrationError(
                f"axes {self.axes[0]} and {self.axes[1]} move the fiducial along lines only "
                f"{angle_deg:.0f}° apart, expected at least {_SMALLEST_ANGLE_DEG:.0f}°"
            )

    def _regressors(self, change_mm: Mapping[str, float]) -> Array:
        first, second = (float(change_mm.get(axis, 0.0)) for axis in self.axes)
        return np.array([max(first, 0.0), min(first, 0.0), max(second, 0.0), min(second, 0.0)])

    def to_json(self) -> dict[str, Any]:
        return {
            "axes": list(self.axes),
            "columns": self.columns.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ImageJacobian:
        first, second = value["axes"]
        return cls((first, second), np.array(value["columns"]), np.array(value["covariance"]))
