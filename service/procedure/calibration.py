"""Calibration: the image Jacobian from an origin and one long move of each axis, and the way back.

The paper uses three points: an origin, 15 mm along x, 15 mm along y. The way back to the origin is
measured as well: it gives the step length of the other direction, and it is the first move that can
be checked against a prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, TypeVar

import numpy as np
from scipy.linalg import block_diag

from service.procedure.estimate import FiducialEstimate, MotionNoise
from service.procedure.jacobian import CalibrationError, ImageJacobian
from service.procedure.observe import (
    ML,
    TEMPLATE,
    Expectation,
    ProcedureFailedError,
    ValidationGate,
    check_prediction,
    estimate_from,
    measure_here,
    measure_shift_set,
    measure_step,
    move,
)
from service.procedure.plane import ImagePlane
from service.procedure.steps import HoldShift, Measured, MoveTo, ProcedureSteps, ask

DISC = "disc"
_ASYMMETRY_CHECK_SIGMA = 5.0
# twice what the directions of an axis are taken to differ by: a stage that was driven into its stop
# comes back further than it went out
_LARGEST_ASYMMETRY = 0.10
Templates = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class CalibrationArguments:
    """last: this robot's last image Jacobian; same_mount: it was not mounted anew since.

    localization: what is fitted once the fiducial was seen: its own image ("template") or "disc".
    """

    axes: tuple[str, str]
    origin_um: Mapping[str, int]
    move_um: int
    shifts_px: tuple[tuple[float, float], ...]
    gate: ValidationGate
    method: str = "ml"
    last: Mapping[str, Any] | None = None
    same_mount: bool = False
    localization: str = DISC


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

    def template_of(self, fiducial: int = 0) -> tuple[int, ...]:
        return self.found_by.template_of(fiducial)

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


class Seen(Protocol):
    """What one look of a calibration gives, of one fiducial or of two."""

    @property
    def measurement_id(self) -> int: ...

    @property
    def plane(self) -> ImagePlane: ...

    @property
    def all_measured(self) -> tuple[Measured, ...]:
        """Of each fiducial."""

    def at(self, setpoints_um: Mapping[str, int]) -> FiducialEstimate: ...


@dataclass(frozen=True, eq=False)
class OneSeen:
    """One fiducial at one hold."""

    measured: Measured
    hold_id: int

    @property
    def all_measured(self) -> tuple[Measured, ...]:
        return (self.measured,)

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
# at what was seen last, expected there, by the measurements that show each fiducial
LookByTemplate = Callable[
    [SeenThere, FiducialEstimate, Templates], ProcedureSteps[tuple[Measured, ...]]
]


def calibrate(arguments: CalibrationArguments) -> ProcedureSteps[Calibration]:
    """Run the calibration; raises ProcedureFailedError when the moves do not explain the images."""

    def look(
        before: FiducialEstimate | None, predicted: FiducialEstimate | None
    ) -> ProcedureSteps[OneSeen]:
        expectation = _expectation(before, predicted, arguments)
        by_template = arguments.localization == TEMPLATE and arguments.method == ML
        acquired, measured = yield from measure_here(
            arguments.method, expectation, any_shape=by_template
        )
        return OneSeen(measured, acquired.hold_id)

    def look_by_template(
        last: OneSeen, expected: FiducialEstimate, templates: Templates
    ) -> ProcedureSteps[tuple[Measured, ...]]:
        holds = (HoldShift(last.hold_id, (0.0, 0.0)),)
        expectation = arguments.gate.around(expected)
        step = measure_step(holds, arguments.method, expectation, template=templates[0])
        return ((yield from ask(step, Measured)),)

    found = yield from drive_and_learn(
        _places(arguments),
        ImageJacobian.unknown(arguments.axes),
        replace(arguments.gate, gate_sigma=_ASYMMETRY_CHECK_SIGMA),
        look,
        _check,
        look_by_template if arguments.localization == TEMPLATE else None,
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
    by_template: LookByTemplate[SeenThere] | None = None,
) -> ProcedureSteps[Calibration]:
    """Drive to each place, look, and learn from each move; the last one is predicted.

    The last place is the way back: `check` must be content before it is driven, and what is seen
    there must be what was predicted. by_template: looks once more at the last place, by the image
    that all places together show; then all of them are taken as that image finds them.
    """
    before: FiducialEstimate | None = None
    plane: ImagePlane | None = None
    learnt, stops, seen_there = jacobian, [], []
    for number, setpoints_um in enumerate(places):
        last = number == len(places) - 1
        if last:
            check(learnt)
        moved = yield from move(
            MoveTo(dict(setpoints_um), f"calibration {number + 1}/{len(places)}")
        )
        predicted = None
        if last and before is not None:
            predicted = before.moved_to(moved.readback_um, learnt, gate.noise)
        seen = yield from look(before, predicted)
        plane = _checked_plane(plane, seen.plane)
        here = seen.at(moved.readback_um)
        if predicted is not None:
            check_prediction(predicted, here, gate)
        if before is not None:
            learnt = learn_from_move(learnt, before, here, gate.noise)
        before = here
        stops.append(here)
        seen_there.append(seen)
    assert plane is not None
    known = Calibration(learnt, stops[-1], plane, seen_there[-1].measurement_id)
    if by_template is not None:
        templates = tuple(
            tuple(one.measurement_id for one in views)
            for views in zip(*(seen.all_measured for seen in seen_there), strict=True)
        )
        answers = yield from by_template(seen_there[-1], stops[-1], templates)
        known, stops = _as_templates_find(known, stops, answers, templates)
        for one, other in pairwise(stops):
            if other is stops[-1]:
                predicted = one.moved_to(other.setpoints_um, jacobian, gate.noise)
                check_prediction(predicted, other, gate)
            jacobian = learn_from_move(jacobian, one, other, gate.noise)
        known = replace(known, jacobian=jacobian, estimate=stops[-1])
    check(known.jacobian)
    _refuse(lambda: _check_there_and_back(known.jacobian, stops[0], stops[-1], places))
    return known


def _as_templates_find(
    known: Calibration,
    stops: list[FiducialEstimate],
    answers: Sequence[Measured],
    templates: Templates,
) -> tuple[Calibration, list[FiducialEstimate]]:
    """The calibration by the fiducials' own images, and where they were by them at every stop.

    As it was where a disc answered instead: then that is what the next looks are by, too.
    """
    for answer in answers:
        if not answer.ok:
            raise ProcedureFailedError(answer.reason_code, answer.reason)
    newest = max(answer.measurement_id for answer in answers)
    if any(answer.method != TEMPLATE for answer in answers):
        return replace(known, measurement_id=newest), stops
    found = []
    for number, stop in enumerate(stops):
        views = [answer.views[number] for answer in answers]
        found.append(
            FiducialEstimate(
                stop.setpoints_um,
                np.concatenate([view.plane_mm for view in views]),
                block_diag(*(view.covariance_mm2 for view in views)),
            )
        )
    found_by = FoundBy.of(answers, templates)
    return replace(known, measurement_id=newest, found_by=found_by), found


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
        found.template_of(),
    )
    # all that was known before has been through the same moves: nothing to add
    return replace(found, estimate=shifted.estimate, measurement_id=shifted.measured.measurement_id)
