"""Calibration: the image Jacobian from an origin and one long move of each axis, and the way back.

The paper uses three points: an origin, 15 mm along x, 15 mm along y. The way back to the origin is
measured as well: it gives the step length of the other direction, and it is the first move that can
be checked against a prediction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.estimate import FiducialEstimate, MotionNoise
from service.jacobian import CalibrationError, ImageJacobian
from service.plane import ImagePlane
from service.sensing import (
    Expectation,
    ProcedureFailedError,
    check_prediction,
    estimate_from,
    measure_here,
    measure_shift_set,
    move,
)
from service.steps import Measured, MoveTo, ProcedureSteps

_ASYMMETRY_CHECK_SIGMA = 5.0


@dataclass(frozen=True)
class CalibrationArguments:
    axes: tuple[str, str]
    origin_um: Mapping[str, int]
    move_um: int
    shifts_px: tuple[tuple[float, float], ...]
    position_gate_mm: float
    gate_sigma: float
    repeatability_mm: float
    scale_error: float
    method: str = "ml"

    @property
    def noise(self) -> MotionNoise:
        return MotionNoise(self.repeatability_mm, self.scale_error)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What later procedures start from."""

    jacobian: ImageJacobian
    estimate: FiducialEstimate
    plane: ImagePlane
    measurement_id: int

    def to_json(self) -> dict[str, Any]:
        return {
            "jacobian": self.jacobian.to_json(),
            "estimate": self.estimate.to_json(),
            "plane": self.plane.to_json(),
            "measurement_id": self.measurement_id,
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Calibration:
        return cls(
            ImageJacobian.from_json(value["jacobian"]),
            FiducialEstimate.from_json(value["estimate"]),
            ImagePlane.from_json(value["plane"]),
            value["measurement_id"],
        )


def calibrate(arguments: CalibrationArguments) -> ProcedureSteps[Calibration]:
    """Run the calibration; raises ProcedureFailedError when the moves do not explain the images."""
    places = _places(arguments)
    jacobian = ImageJacobian.unknown(arguments.axes)
    noise = arguments.noise
    before: FiducialEstimate | None = None
    plane: ImagePlane | None = None
    for number, setpoints_um in enumerate(places):
        if number == len(places) - 1:
            _check(jacobian)
        moved = yield from move(MoveTo(setpoints_um, f"calibration {number + 1}/{len(places)}"))
        expectation = _expectation(before, moved.readback_um, jacobian, arguments, number)
        _, measured = yield from measure_here(arguments.method, expectation)
        plane = _checked_plane(plane, measured)
        here = estimate_from(measured, moved.readback_um)
        if before is not None:
            if number == len(places) - 1:
                predicted = before.moved_to(moved.readback_um, jacobian, noise)
                check_prediction(predicted, here, _ASYMMETRY_CHECK_SIGMA, noise)
            jacobian = learn_from_move(jacobian, before, here, noise)
        before = here
    assert before is not None
    assert plane is not None
    _check(jacobian)
    return (yield from _refine(before, jacobian, plane, measured, arguments))


def _check(jacobian: ImageJacobian) -> None:
    try:
        jacobian.check()
    except CalibrationError as error:
        raise ProcedureFailedError("calibration", str(error)) from error


def learn_from_move(
    jacobian: ImageJacobian,
    before: FiducialEstimate,
    after: FiducialEstimate,
    noise: MotionNoise,
) -> ImageJacobian:
    """Update the image Jacobian with a move whose both ends were measured."""
    change_mm = {
        axis: (after.setpoints_um[axis] - before.setpoints_um[axis]) / 1000.0
        for axis in jacobian.axes
    }
    scatter = max(noise.variance_mm2(change_mm[axis]) for axis in jacobian.axes)
    noise_mm2 = before.covariance_mm2 + after.covariance_mm2 + np.eye(len(jacobian.axes)) * scatter
    return jacobian.updated(change_mm, after.plane_mm - before.plane_mm, noise_mm2)


def _places(arguments: CalibrationArguments) -> list[dict[str, int]]:
    first, second = arguments.axes
    origin = dict(arguments.origin_um)
    along_first = {**origin, first: origin[first] + arguments.move_um}
    along_both = {**along_first, second: origin[second] + arguments.move_um}
    return [origin, along_first, along_both, origin]


def _expectation(
    before: FiducialEstimate | None,
    setpoints_um: Mapping[str, int],
    jacobian: ImageJacobian,
    arguments: CalibrationArguments,
    number: int,
) -> Expectation | None:
    if before is None:
        return None
    if number == len(_places(arguments)) - 1:
        predicted = before.moved_to(setpoints_um, jacobian, arguments.noise)
        return Expectation.of(predicted, arguments.position_gate_mm, arguments.gate_sigma)
    # which way the axis points in the image is not known yet: anywhere around the last place
    return Expectation(before.plane_mm, abs(arguments.move_um) / 1000 * 1.3)


def _checked_plane(plane: ImagePlane | None, measured: Measured) -> ImagePlane:
    this = ImagePlane.from_json(measured.plane)
    if plane is not None and not this.is_parallel_to(plane):
        raise ProcedureFailedError(
            "plane_changed", "the slice orientation changed during the procedure: rescan as before"
        )
    return plane or this


def _refine(
    estimate: FiducialEstimate,
    jacobian: ImageJacobian,
    plane: ImagePlane,
    last: Measured,
    arguments: CalibrationArguments,
) -> ProcedureSteps[Calibration]:
    """Measure once more with the commanded shifts around the origin, if any are wanted."""
    measurement_id = last.measurement_id
    if len(arguments.shifts_px) > 1:
        expectation = Expectation.of(estimate, arguments.position_gate_mm, arguments.gate_sigma)
        found = yield from measure_shift_set(
            estimate,
            arguments.shifts_px,
            jacobian,
            plane,
            arguments.method,
            expectation,
            arguments.noise,
        )
        # all that was known before has been through the same moves: nothing to add
        estimate, measurement_id = found.estimate, found.measured.measurement_id
    return Calibration(jacobian, estimate, plane, measurement_id)
