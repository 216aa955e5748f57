"""Calibration: the image Jacobian from an origin and one long move of each axis, and the way back.

The paper uses three points: an origin, 15 mm along x, 15 mm along y. The way back to the origin is
measured as well: it gives the step length of the other direction, and it is the first move that can
be checked against a prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from robot_bridge.protocol.phases import WorkPhase
from service.procedure.estimate import FiducialEstimate, MotionNoise
from service.procedure.fiducials import ONE_FIDUCIAL, Geometry
from service.procedure.jacobian import CalibrationError, ImageJacobian
from service.procedure.observe import (
    ML,
    TEMPLATE,
    Expectation,
    ProcedureFailedError,
    Seen,
    Templates,
    ValidationGate,
    check_prediction,
    estimate_from,
    move,
    see,
    see_again,
)
from service.procedure.plane import ImagePlane
from service.procedure.shift_set import measure_shift_set
from service.procedure.steps import Measured, MoveTo, ProcedureSteps

DISC = "disc"
_ASYMMETRY_CHECK_SIGMA = 5.0
# twice what the directions of an axis are taken to differ by: a stage that was driven into its stop
# comes back further than it went out
_LARGEST_ASYMMETRY = 0.10


@dataclass(frozen=True)
class CalibrationArguments:
    """last: this robot's last image Jacobian; same_mount: it was not mounted anew since.

    axes: two of a fiducial; of the guide the top stage's two, then the bottom stage's. shifts_px:
    with more than one, of one fiducial, it is measured once more with them at the end.
    localization: what is fitted once the fiducial was seen: its own image ("template") or "disc".
    """

    axes: tuple[str, ...]
    origin_um: Mapping[str, int]
    move_um: int
    shifts_px: tuple[tuple[float, float], ...]
    gate: ValidationGate
    method: str = "ml"
    last: Mapping[str, Any] | None = None
    same_mount: bool = False
    localization: str = DISC
    geometry: Geometry = ONE_FIDUCIAL


@dataclass(frozen=True)
class FoundBy:
    """How fiducials are found, and what all places found so have in common.

    templates: for each fiducial the measurements that its image is learnt from; none: a disc is
    fitted. systematic_mm: std, for each coordinate, of what is said to be the middle; own_mm: of
    that, what the noise in the template's own measurements does.
    """

    templates: tuple[tuple[int, ...], ...] = ()
    systematic_mm: tuple[float, ...] = ()
    own_mm: tuple[float, ...] = ()

    @classmethod
    def of(cls, answers: Sequence[Measured], templates: Templates) -> FoundBy:
        return cls(
            templates,
            tuple(x for answer in answers for x in answer.systematic_mm),
            tuple(x for answer in answers for x in answer.own_mm),
        )

    def template_of(self, fiducial: int) -> tuple[int, ...]:
        """The measurements that show one fiducial's image; empty where there is none."""
        return self.templates[fiducial] if self.templates else ()

    def to_json(self) -> dict[str, Any]:
        return {
            "templates": [list(ids) for ids in self.templates],
            "systematic_mm": list(self.systematic_mm),
            "own_mm": list(self.own_mm),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> FoundBy:
        return cls(
            tuple(tuple(ids) for ids in value["templates"]),
            tuple(value["systematic_mm"]),
            tuple(value["own_mm"]),
        )


BY_DISC = FoundBy()


@dataclass(frozen=True, eq=False)
class Calibration:
    """What later procedures start from."""

    jacobian: ImageJacobian
    estimate: FiducialEstimate
    plane: ImagePlane
    measurement_id: int
    found_by: FoundBy = BY_DISC

    def to_json(self) -> dict[str, Any]:
        return {
            "jacobian": self.jacobian.to_json(),
            "estimate": self.estimate.to_json(),
            "plane": self.plane.to_json(),
            "measurement_id": self.measurement_id,
            "found_by": self.found_by.to_json(),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Calibration:
        return cls(
            ImageJacobian.from_json(value["jacobian"]),
            FiducialEstimate.from_json(value["estimate"]),
            ImagePlane.from_json(value["plane"]),
            value["measurement_id"],
            FoundBy.from_json(value["found_by"]) if "found_by" in value else BY_DISC,
        )


def calibrate(arguments: CalibrationArguments) -> ProcedureSteps[Calibration]:
    """Move every axis once, and all of them back; learn how the fiducials follow.

    Raises ProcedureFailedError when the moves do not explain the images. The last place is the way
    back: the image Jacobian must be a possible one before it is driven, and what is seen there must
    be what was predicted.
    """
    gate = _gate_of_way_back(arguments)
    places = _places(arguments)
    learnt = unknown = ImageJacobian.unknown(arguments.axes)
    stops: list[FiducialEstimate] = []
    looks: list[Seen] = []
    for number, setpoints_um in enumerate(places, 1):
        last = number == len(places)
        if last:
            _check(arguments, learnt)
        purpose = f"calibration {number}/{len(places)}"
        moved = yield from move(MoveTo(setpoints_um, purpose, phase=WorkPhase.CALIBRATION))
        predicted = stops[-1].moved_to(moved.readback_um, learnt, gate.noise) if last else None
        looks.append((yield from _look(arguments, stops, predicted)))
        _check_plane(looks)
        here = looks[-1].at(moved.readback_um)
        if predicted is not None:
            check_prediction(predicted, here, gate)
        if stops:
            learnt = learn_from_move(learnt, stops[-1], here, gate.noise)
        stops.append(here)
    known = Calibration(learnt, stops[-1], looks[0].plane, looks[-1].measurement_id)
    if arguments.localization == TEMPLATE:
        known, stops = yield from _by_template(arguments, known, stops, looks)
        known = replace(known, jacobian=_learn_again(unknown, stops, gate))
    _check(arguments, known.jacobian)
    _refuse(lambda: _check_there_and_back(known.jacobian, stops[0], stops[-1], places))
    check_is_as_last(known, arguments.last, arguments.gate, same_mount=arguments.same_mount)
    return (yield from _refine(known, arguments))


def _gate_of_way_back(arguments: CalibrationArguments) -> ValidationGate:
    """With two axes what the directions of an axis may differ by is known, whatever is set."""
    if len(arguments.axes) > 2:
        return arguments.gate
    return replace(arguments.gate, gate_sigma=_ASYMMETRY_CHECK_SIGMA)


def _look(
    arguments: CalibrationArguments,
    stops: Sequence[FiducialEstimate],
    predicted: FiducialEstimate | None,
) -> ProcedureSteps[Seen]:
    geometry, gate = arguments.geometry, arguments.gate
    expected: Sequence[Expectation | None] = [None] * len(geometry.names)
    if predicted is not None:
        expected = gate.around(predicted)
    elif stops:
        # which way the axis points in the image is not known yet: anywhere around the last place
        reach_mm = geometry.reach_mm(abs(arguments.move_um), gate.position_gate_mm)
        before = stops[-1]
        expected = [Expectation(before.plane_mm[one], reach_mm) for one in before.each]
    any_shape = arguments.localization == TEMPLATE and arguments.method == ML
    return (yield from see(geometry, arguments.method, expected, any_shape=any_shape))


def _check_plane(looks: Sequence[Seen]) -> None:
    if not looks[-1].plane.is_parallel_to(looks[0].plane):
        raise ProcedureFailedError(
            "plane_changed", "the slice orientation changed during the procedure: rescan as before"
        )


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


def _by_template(
    arguments: CalibrationArguments,
    known: Calibration,
    stops: list[FiducialEstimate],
    looks: Sequence[Seen],
) -> ProcedureSteps[tuple[Calibration, list[FiducialEstimate]]]:
    """Look once more at the last place, by the image of each fiducial that all places show.

    Returns the calibration by those images, and where the fiducials were by them at every stop. As
    it was where a disc answered instead: then that is what the next looks are by, too.
    """
    templates = tuple(
        tuple(one.measurement_id for one in views)
        for views in zip(*(seen.measured for seen in looks), strict=True)
    )
    expected = arguments.gate.around(stops[-1])
    answers = yield from see_again(
        looks[-1], arguments.geometry, arguments.method, expected, templates
    )
    for answer in answers:
        if not answer.ok:
            raise ProcedureFailedError(answer.reason_code, answer.reason)
    newest = max(answer.measurement_id for answer in answers)
    if any(answer.method != TEMPLATE for answer in answers):
        return replace(known, measurement_id=newest), stops
    found = [
        estimate_from([answer.views[number] for answer in answers], stop.setpoints_um)
        for number, stop in enumerate(stops)
    ]
    found_by = FoundBy.of(answers, templates)
    known = replace(known, measurement_id=newest, found_by=found_by, estimate=found[-1])
    return known, found


def _learn_again(
    jacobian: ImageJacobian, stops: Sequence[FiducialEstimate], gate: ValidationGate
) -> ImageJacobian:
    """From all places as they were found at last; the way back is predicted again."""
    for one, other in pairwise(stops):
        if other is stops[-1]:
            check_prediction(one.moved_to(other.setpoints_um, jacobian, gate.noise), other, gate)
        jacobian = learn_from_move(jacobian, one, other, gate.noise)
    return jacobian


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


def _check(arguments: CalibrationArguments, jacobian: ImageJacobian) -> None:
    _refuse(lambda: arguments.geometry.check(jacobian))


def _refuse(check: Callable[[], None]) -> None:
    try:
        check()
    except CalibrationError as error:
        raise ProcedureFailedError(error.code, str(error)) from error


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
    places = [dict(arguments.origin_um)]
    for axis in arguments.axes:
        places.append({**places[-1], axis: places[-1][axis] + arguments.move_um})
    return [*places, dict(arguments.origin_um)]


def _refine(found: Calibration, arguments: CalibrationArguments) -> ProcedureSteps[Calibration]:
    """Measure once more with the commanded shifts around the origin, if any are wanted."""
    if len(arguments.shifts_px) < 2:
        return found
    (expected,) = arguments.gate.around(found.estimate)
    measured, estimate = yield from measure_shift_set(
        found.estimate,
        arguments.shifts_px,
        found.jacobian,
        found.plane,
        arguments.method,
        expected,
        arguments.gate.noise,
        found.found_by.template_of(0),
    )
    # all that was known before has been through the same moves: nothing to add
    return replace(found, estimate=estimate, measurement_id=measured.measurement_id)
