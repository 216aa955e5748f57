"""Calibration: the image Jacobian from an origin and one long move of each axis, and the way back.

The paper uses three points: an origin, 15 mm along x, 15 mm along y. The way back to the origin is
measured as well: it gives the step length of the other direction, and it is the first move that can
be checked against a prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from service.procedure.estimate import FiducialEstimate, MotionNoise
from service.procedure.jacobian import CalibrationError, ImageJacobian
from service.procedure.plane import ImagePlane
from service.procedure.sensing import (
    Expectation,
    ProcedureFailedError,
    ValidationGate,
    check_prediction,
    estimate_from,
    measure_here,
    measure_shift_set,
    move,
)
from service.procedure.steps import Measured, MoveTo, ProcedureSteps

_ASYMMETRY_CHECK_SIGMA = 5.0
# twice what the directions of an axis are taken to differ by: a stage that was driven into its stop
# comes back further than it went out
_LARGEST_ASYMMETRY = 0.10


@dataclass(frozen=True)
class CalibrationArguments:
    """last: this robot's last image Jacobian; same_mount: it was not mounted anew since."""

    axes: tuple[str, str]
    origin_um: Mapping[str, int]
    move_um: int
    shifts_px: tuple[tuple[float, float], ...]
    gate: ValidationGate
    method: str = "ml"
    last: Mapping[str, Any] | None = None
    same_mount: bool = False


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


class Seen(Protocol):
    """What one look of a calibration gives, of one fiducial or of two."""

    @property
    def measurement_id(self) -> int: ...

    @property
    def plane(self) -> ImagePlane: ...

    def at(self, setpoints_um: Mapping[str, int]) -> FiducialEstimate: ...


@dataclass(frozen=True, eq=False)
class OneSeen:
    """One fiducial at one hold."""

    measured: Measured

    @property
    def measurement_id(self) -> int:
        return self.measured.measurement_id

    @property
    def plane(self) -> ImagePlane:
        return ImagePlane.from_json(self.measured.plane)

    def at(self, setpoints_um: Mapping[str, int]) -> FiducialEstimate:
        return estimate_from(self.measured, setpoints_um)


SeenThere = TypeVar("SeenThere", bound=Seen)
# of the place before and, where there is one, of the prediction for this place
LookThere = Callable[[FiducialEstimate | None, FiducialEstimate | None], ProcedureSteps[SeenThere]]


def calibrate(arguments: CalibrationArguments) -> ProcedureSteps[Calibration]:
    """Run the calibration; raises ProcedureFailedError when the moves do not explain the images."""

    def look(
        before: FiducialEstimate | None, predicted: FiducialEstimate | None
    ) -> ProcedureSteps[OneSeen]:
        expectation = _expectation(before, predicted, arguments)
        return OneSeen((yield from measure_here(arguments.method, expectation))[1])

    found = yield from drive_and_learn(
        _places(arguments),
        ImageJacobian.unknown(arguments.axes),
        replace(arguments.gate, gate_sigma=_ASYMMETRY_CHECK_SIGMA),
        look,
        _check,
    )
    check_is_as_last(found, arguments.last, arguments.gate, same_mount=arguments.same_mount)
    return (yield from _refine(found, arguments))


def check_is_as_last(
    found: Calibration, last: Mapping[str, Any] | None, gate: ValidationGate, *, same_mount: bool
) -> None:
    """Refuse what is not as the last image Jacobian (JSON) of this robot, if there was one."""
    if last is None:
        return
    before, scale_error = ImageJacobian.from_json(last), gate.scale_error
    _refuse(
        lambda: found.jacobian.check_is_of_same_robot(before, scale_error, same_mount=same_mount)
    )


def drive_and_learn(
    places: Sequence[Mapping[str, int]],
    jacobian: ImageJacobian,
    gate: ValidationGate,
    look: LookThere[SeenThere],
    check: Callable[[ImageJacobian], None],
) -> ProcedureSteps[Calibration]:
    """Drive to each place, look, and learn from each move; the last one is predicted.

    The last place is the way back: `check` must be content before it is driven, and what is seen
    there must be what was predicted.
    """
    first: FiducialEstimate | None = None
    before: FiducialEstimate | None = None
    plane: ImagePlane | None = None
    for number, setpoints_um in enumerate(places):
        last = number == len(places) - 1
        if last:
            check(jacobian)
        moved = yield from move(
            MoveTo(dict(setpoints_um), f"calibration {number + 1}/{len(places)}")
        )
        predicted = None
        if last and before is not None:
            predicted = before.moved_to(moved.readback_um, jacobian, gate.noise)
        seen = yield from look(before, predicted)
        plane = _checked_plane(plane, seen.plane)
        here = seen.at(moved.readback_um)
        if predicted is not None:
            check_prediction(predicted, here, gate)
        if before is not None:
            jacobian = learn_from_move(jacobian, before, here, gate.noise)
        before, first = here, first or here
    assert before is not None
    assert plane is not None
    check(jacobian)
    assert first is not None
    _refuse(lambda: _check_there_and_back(jacobian, first, before, places))
    return Calibration(jacobian, before, plane, seen.measurement_id)


def _check_there_and_back(
    jacobian: ImageJacobian,
    first: FiducialEstimate,
    last: FiducialEstimate,
    places: Sequence[Mapping[str, int]],
) -> None:
    """Where the fiducial is not back where it was, an axis went another way out than back."""
    seen_mm = np.linalg.solve(jacobian.mean_columns, last.plane_mm - first.plane_mm)
    for axis, moved_mm in zip(jacobian.axes, seen_mm.tolist(), strict=True):
        said_mm = (last.setpoints_um[axis] - first.setpoints_um[axis]) / 1000
        way_mm = max(abs(place[axis] - first.setpoints_um[axis]) for place in places) / 1000
        if not abs(moved_mm - said_mm) <= _LARGEST_ASYMMETRY * way_mm:
            raise CalibrationError(
                f"axis {axis}: moving {way_mm:g} mm out and back differed by "
                f"{abs(moved_mm - said_mm):.2f} mm ({_LARGEST_ASYMMETRY * way_mm:.2f} "
                "allowed): did a stage hit its stop, or was it not where it was declared?"
            )


def _check(jacobian: ImageJacobian) -> None:
    _refuse(jacobian.check)


def _refuse(check: Callable[[], None]) -> None:
    try:
        check()
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
    predicted: FiducialEstimate | None,
    arguments: CalibrationArguments,
) -> Expectation | None:
    if before is None:
        return None
    if predicted is not None:
        return arguments.gate.around(predicted)
    # which way the axis points in the image is not known yet: anywhere around the last place
    return Expectation(before.plane_mm, abs(arguments.move_um) / 1000 * 1.3)


def _checked_plane(plane: ImagePlane | None, this: ImagePlane) -> ImagePlane:
    if plane is not None and not this.is_parallel_to(plane):
        raise ProcedureFailedError(
            "plane_changed", "the slice orientation changed during the procedure: rescan as before"
        )
    return plane or this


def _refine(found: Calibration, arguments: CalibrationArguments) -> ProcedureSteps[Calibration]:
    """Measure once more with the commanded shifts around the origin, if any are wanted."""
    if len(arguments.shifts_px) < 2:
        return found
    expectation = arguments.gate.around(found.estimate)
    shifted = yield from measure_shift_set(
        found.estimate,
        arguments.shifts_px,
        found.jacobian,
        found.plane,
        arguments.method,
        expectation,
        arguments.gate.noise,
    )
    # all that was known before has been through the same moves: nothing to add
    return replace(found, estimate=shifted.estimate, measurement_id=shifted.measured.measurement_id)
