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
SMALLEST_ANGLE_DEG = 60.0
_CHANGE_SIGMAS = 5.0


class CalibrationError(Exception):
    """The moves of a calibration do not give an image Jacobian that could be right."""

    def __init__(self, text: str, code: str = "calibration") -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, eq=False)
class ImageJacobian:
    """Estimate with covariance.

    axes: names of the n axes, in the order of the columns: two for one fiducial, four for two.
    columns: (n, 2n), mm/mm; columns for (axis 0 growing, axis 0 shrinking, axis 1 growing, ...),
        rows for (row direction, column direction), of the first fiducial and then of the second.
    covariance: (2n², 2n²) of `columns.ravel()`.
    """

    axes: tuple[str, ...]
    columns: Array
    covariance: Array

    @classmethod
    def unknown(cls, axes: tuple[str, ...], direction_asymmetry: float = 0.05) -> ImageJacobian:
        """Nothing is known but that both directions of an axis agree to `direction_asymmetry`."""
        pair = np.full((2, 2), _VAGUE_SCALE**2) + np.eye(2) * direction_asymmetry**2
        covariance = np.kron(np.eye(len(axes) ** 2), pair).astype(np.float64)
        return cls(axes, np.zeros((len(axes), 2 * len(axes))), covariance)

    @property
    def mean_columns(self) -> Array:
        """(n, n): per axis, the mean of its two directions."""
        return np.asarray((self.columns[:, 0::2] + self.columns[:, 1::2]) / 2)

    def displacement(self, change_mm: Mapping[str, float]) -> tuple[Array, Array]:
        """Return the displacement (n,) mm for a setpoint change, and its covariance."""
        regressors = self._regressors(change_mm)
        observe = np.kron(np.eye(len(self.axes)), regressors)
        return self.columns @ regressors, observe @ self.covariance @ observe.T

    def setpoint_change_mm(self, displacement_mm: Array) -> dict[str, float]:
        """Return the setpoint change that displaces the fiducials by `displacement_mm` (n,)."""
        count = len(self.axes)
        for choice in product((0, 1), repeat=count):
            matrix = self.columns[:, [2 * axis + down for axis, down in enumerate(choice)]]
            if abs(np.linalg.det(matrix)) < 1e-3:
                raise CalibrationError("the image Jacobian is singular: two axes act alike")
            change = np.linalg.solve(matrix, displacement_mm)
            if np.all(change * np.where(choice, -1, 1) >= 0):
                return dict(zip(self.axes, change.tolist(), strict=True))
        # the columns of both directions differ so much that no choice fits: take their mean
        change = np.linalg.solve(self.mean_columns, displacement_mm)
        return dict(zip(self.axes, change.tolist(), strict=True))

    def updated(
        self, change_mm: Mapping[str, float], displacement_mm: Array, noise_mm2: Array
    ) -> ImageJacobian:
        """Learn from one move: recursive least squares with the noise (n, n) of the displacement.

        Short moves carry little weight by themselves, because their noise is the same.
        """
        observe = np.kron(np.eye(len(self.axes)), self._regressors(change_mm))
        innovation = displacement_mm - observe @ self.columns.ravel()
        innovation_covariance = observe @ self.covariance @ observe.T + noise_mm2
        gain = np.linalg.solve(innovation_covariance, observe @ self.covariance).T
        columns = self.columns.ravel() + gain @ innovation
        rest = np.eye(len(self.covariance)) - gain @ observe
        covariance = rest @ self.covariance @ rest.T + gain @ noise_mm2 @ gain.T
        return ImageJacobian(self.axes, columns.reshape(self.columns.shape), covariance)

    def check_is_of_same_robot(
        self, last: ImageJacobian, scale_error: float, *, same_mount: bool
    ) -> None:
        """Raise CalibrationError where this is not `last` within what both can be wrong by.

        same_mount: the robot has not been mounted anew since, so that directions compare as well;
        otherwise lengths and angles do. scale_error: of one move's length, as a fraction.
        """
        if last.axes != self.axes:
            return
        mine, others = self.mean_columns, last.mean_columns
        if not same_mount:
            mine, others = _shape(mine), _shape(others)
        for index, axis in enumerate(self.axes):
            length = float(np.linalg.norm(others[:, index]))
            change = float(np.linalg.norm(mine[:, index] - others[:, index]))
            allowed = _CHANGE_SIGMAS * np.sqrt(2.0) * scale_error * length
            if not change <= allowed:
                raise CalibrationError(
                    f"axis {axis}: the fiducial's motion differs from the last calibration of "
                    f"this robot by {change:.3f} mm per mm (allowed {allowed:.3f}): check "
                    "for something loose or in the way, and that the stages are where "
                    "they were declared"
                )

    def check(self) -> None:
        """Raise CalibrationError unless each of two axes moves the fiducial about 1 mm per mm."""
        lengths = np.linalg.norm(self.columns, axis=0)
        low, high = _SCALE_RANGE
        for index, length in enumerate(lengths):
            if not low <= length <= high:
                raise CalibrationError(
                    f"axis {self.axes[index // 2]}: the fiducial moved {length:.2f} mm per mm of "
                    f"setpoint, expected {low} to {high}; did the robot move?"
                )
        cosine = abs(self.columns[:, 0] @ self.columns[:, 2]) / (lengths[0] * lengths[2])
        angle_deg = float(np.degrees(np.arccos(min(1.0, cosine))))
        if not angle_deg >= SMALLEST_ANGLE_DEG:
            raise CalibrationError(
                f"axes {self.axes[0]} and {self.axes[1]} move the fiducial along lines only "
                f"{angle_deg:.0f}° apart, expected at least {SMALLEST_ANGLE_DEG:.0f}°"
            )

    def _regressors(self, change_mm: Mapping[str, float]) -> Array:
        changes = (float(change_mm.get(axis, 0.0)) for axis in self.axes)
        return np.array([part for change in changes for part in (max(change, 0), min(change, 0))])

    def to_json(self) -> dict[str, Any]:
        return {
            "axes": list(self.axes),
            "columns": self.columns.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ImageJacobian:
        return cls(tuple(value["axes"]), np.array(value["columns"]), np.array(value["covariance"]))


def _shape(columns: Array) -> Array:
    """Each stage's two columns turned and mirrored into a standard pose: what is left is lengths
    and angles.
    """
    stages = (columns[:, at : at + 2] for at in range(0, columns.shape[1], 2))
    return np.hstack([np.linalg.cholesky(stage.T @ stage).T for stage in stages])
