"""How the robot moves the fiducial in the image, as the last calibration of a case measured it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from case_record.connection import CaseRecordError
from case_record.record import CaseRecord
from service.commissioning.acceptance import Item
from service.commissioning.evidence import CommissioningError
from service.procedure.jacobian import SMALLEST_ANGLE_DEG, CalibrationError, ImageJacobian
from service.procedure.registry import latest_calibration

_LIMIT = f"0.6 to 1.6 mm per mm, axes at least {SMALLEST_ANGLE_DEG:.0f}° apart"


def jacobian_of_case(folder: Path) -> ImageJacobian:
    """Raises CommissioningError where the case has no calibration that is still valid."""
    try:
        with CaseRecord(folder, read_only=True) as record:
            found = latest_calibration(record) or latest_calibration(record, guide=True)
    except CaseRecordError as error:
        raise CommissioningError(f"{folder}: {error}") from None
    if found is None:
        raise CommissioningError(f"{folder}: the case has no valid calibration; calibrate in it")
    return found.jacobian


def jacobian_items(jacobian: ImageJacobian, case: str) -> list[Item]:
    """One line an axis. A length is 1 where the pixel size and the scale of the axis are right."""
    try:
        jacobian.check()
        passed = True
    except CalibrationError:
        passed = False
    lengths, sigmas = _lengths(jacobian)
    return [
        Item(
            f"Image Jacobian, {axis} (calibration of {case})",
            f"{lengths[2 * index]:.3f} ± {sigmas[2 * index]:.3f} mm per mm out, "
            f"{lengths[2 * index + 1]:.3f} ± {sigmas[2 * index + 1]:.3f} back",
            _LIMIT,
            passed,
        )
        for index, axis in enumerate(jacobian.axes)
    ]


def _lengths(jacobian: ImageJacobian) -> tuple[list[float], list[float]]:
    """Of each column, with the standard deviation of its length."""
    rows, columns = jacobian.columns.shape
    lengths = np.linalg.norm(jacobian.columns, axis=0)
    covariance = jacobian.covariance.reshape(rows, columns, rows, columns)
    sigmas = []
    for column, length in enumerate(lengths):
        along = jacobian.columns[:, column] / length
        variance = along @ covariance[:, column, :, column] @ along
        sigmas.append(float(np.sqrt(variance)))
    return lengths.tolist(), sigmas
