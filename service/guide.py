"""Four degrees of freedom: two fiducials on the guide, four axes, and where the needle's tip goes.

The state is (row, col) of the upper and (row, col) of the lower fiducial, mm in the image plane,
each seen in a slice of its own. The guide's direction along the slice normal follows from the known
distance between the fiducials. The tip is where the guide's line is `tip_beyond_mm` below the lower
ball joint; in the image plane it is linear in the state, so its covariance is exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.calibration import learn_from_move
from service.estimate import FiducialEstimate, MotionNoise, probability_within
from service.jacobian import ImageJacobian
from service.plan import PlanRefusedError, Travel, check_travel
from service.plane import ImagePlane
from service.sensing import (
    Expectation,
    ProcedureFailedError,
    check_prediction,
    measure_again,
    measure_here,
    move,
)
from service.steps import (
    Acquired,
    Answered,
    AskOperator,
    Measured,
    MoveTo,
    ProcedureSteps,
    ask,
)

Array = NDArray[np.float64]
CONFIRM, REJECT = "confirm", "reject"
_FIRST_GATE = 1.4
_SHARE_TOLERANCE = 0.35
_MOST_FRAMES = 6


@dataclass(frozen=True)
class GuideGeometry:
    """What is known of the guide beforehand; distances along it from the lower ball joint.

    slice_positions_mm: along the slice normal, of the slices that show (upper, lower) fiducial.
    """

    upper_along_mm: float
    lower_along_mm: float
    joints_apart_mm: float
    slice_positions_mm: tuple[float, float]
    tip_beyond_mm: float = 80.0

    def __post_init__(self) -> None:
        if not self.upper_along_mm > self.lower_along_mm > 0:
            raise ValueError("the upper fiducial must be above the lower one, both above the joint")

    @property
    def tip_from_fiducials(self) -> Array:
        """(2, 4): the tip in the image plane from the state, linear."""
        lever = (self.lower_along_mm + self.tip_beyond_mm) / (
            self.upper_along_mm - self.lower_along_mm
        )
        return np.hstack([-lever * np.eye(2), (1 + lever) * np.eye(2)])


@dataclass(frozen=True)
class GuideArguments:
    """axes: the top stage's two, then the bottom stage's two.

    target_mm: (4,) wanted state, None for a calibration. tolerance_mm is at the tip.
    """

    axes: tuple[str, str, str, str]
    origin_um: Mapping[str, int]
    move_um: int
    geometry: GuideGeometry
    travel_um: Mapping[str, tuple[int, int]]
    position_gate_mm: float
    gate_sigma: float
    repeatability_mm: float
    scale_error: float
    target_mm: tuple[float, float, float, float] | None = None
    tolerance_mm: float = 0.25
    confidence: float = 0.95
    max_iterations: int = 8
    confirm_moves: bool = True

    @property
    def noise(self) -> MotionNoise:
        return MotionNoise(self.repeatability_mm, self.scale_error)


@dataclass(frozen=True, eq=False)
class GuideCalibration:
    """The four-axis image Jacobian and where both fiducials are."""

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
    def from_json(cls, value: Mapping[str, Any]) -> GuideCalibration:
        return cls(
            ImageJacobian.from_json(value["jacobian"]),
            FiducialEstimate.from_json(value["estimate"]),
            ImagePlane.from_json(value["plane"]),
            value["measurement_id"],
        )


@dataclass(frozen=True, eq=False)
class GuideArrival:
    """READY: error and covariance (2,), (2, 2) of the tip in the image plane."""

    calibration: GuideCalibration
    tip_error_mm: Array
    tip_covariance_mm2: Array
    probability: float
    iterations: int
    frames: int

    def to_json(self) -> dict[str, Any]:
        return {
            "calibration": self.calibration.to_json(),
            "tip_error_mm": self.tip_error_mm.tolist(),
            "tip_covariance_mm2": self.tip_covariance_mm2.tolist(),
            "probability": self.probability,
            "iterations": self.iterations,
            "frames": self.frames,
        }


@dataclass(frozen=True, eq=False)
class BothSeen:
    """Both fiducials at one hold."""

    acquired: tuple[Acquired, Acquired]
    measured: tuple[Measured, Measured]

    @property
    def frames(self) -> int:
        return sum(one.frames for one in self.measured)

    @property
    def measurement_id(self) -> int:
        return max(one.measurement_id for one in self.measured)

    def at(self, setpoints_um: Mapping[str, int]) -> FiducialEstimate:
        """The state (4,) with its covariance: the two slices have nothing in common."""
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = self.measured[0].covariance_mm2
        covariance[2:, 2:] = self.measured[1].covariance_mm2
        state = np.array([value for one in self.measured for value in one.plane_mm])
        return FiducialEstimate(dict(setpoints_um), state, covariance)


def see_both(
    geometry: GuideGeometry,
    expected: tuple[Expectation | None, Expectation | None],
    *,
    fresh: bool = False,
) -> ProcedureSteps[BothSeen]:
    """One slice of each fiducial, the upper one's first."""
    seen = []
    for number in range(2):
        position_mm = geometry.slice_positions_mm[number]
        seen.append(
            (
                yield from measure_here(
                    "ml",
                    expected[number],
                    fresh=fresh and number == 0,
                    slice_position_mm=position_mm,
                )
            )
        )
    (first, upper), (second, lower) = seen
    plane, other = (ImagePlane.from_json(one.plane) for one in (upper, lower))
    if not plane.is_parallel_to(other):
        raise ProcedureFailedError(
            "plane_changed", "the slices of the two fiducials are not parallel"
        )
    return BothSeen((first, second), (upper, lower))


def calibrate_guide(arguments: GuideArguments) -> ProcedureSteps[GuideCalibration]:
    """Move every axis once, and all of them back; learn how both fiducials follow."""
    jacobian = ImageJacobian.unknown(arguments.axes)
    places = _places(arguments)
    before: FiducialEstimate | None = None
    plane: ImagePlane | None = None
    for number, setpoints_um in enumerate(places):
        last = number == len(places) - 1
        if last:
            _check_shares(jacobian, arguments.geometry)
        moved = yield from move(MoveTo(setpoints_um, f"calibration {number + 1}/{len(places)}"))
        seen = yield from see_both(
            arguments.geometry, _first_expectations(arguments, before, jacobian, setpoints_um, last)
        )
        here = seen.at(moved.readback_um)
        if before is not None:
            if last:
                predicted = before.moved_to(moved.readback_um, jacobian, arguments.noise)
                check_prediction(predicted, here, arguments.gate_sigma, arguments.noise)
            jacobian = learn_from_move(jacobian, before, here, arguments.noise)
        before, plane = here, ImagePlane.from_json(seen.measured[0].plane)
    assert before is not None
    assert plane is not None
    _check_shares(jacobian, arguments.geometry)
    return GuideCalibration(jacobian, before, plane, seen.measurement_id)


def approach_guide(
    arguments: GuideArguments, start: GuideCalibration
) -> ProcedureSteps[GuideArrival]:
    """Bring the guide onto the wanted line, until the tip is where it should be."""
    if arguments.target_mm is None:
        raise ValueError("an approach needs a target")
    calibration, iterations, frames = start, 0, 0
    seen: BothSeen | None = None
    prior = start.estimate
    while True:
        if seen is not None:
            wanted = _frames_that_decide(arguments, calibration.estimate, seen)
            if wanted > seen.measured[0].frames:
                more = yield from _see_longer(arguments, seen, prior, wanted)
                frames += more.frames - seen.frames
                seen, calibration = more, _fused(calibration, prior, more)
        if _probability(arguments, calibration.estimate) >= arguments.confidence:
            if seen is not None:
                return _arrival(arguments, calibration, iterations, frames)
            prior = calibration.estimate
            seen = yield from see_both(arguments.geometry, _gates(arguments, prior), fresh=True)
        else:
            if iterations == arguments.max_iterations:
                raise _not_converged(arguments, calibration.estimate)
            setpoints_um = plan_guide(arguments, calibration)
            yield from _confirm(arguments, calibration, setpoints_um)
            before = calibration.estimate if seen is None else seen.at(prior.setpoints_um)
            moved = yield from move(
                MoveTo(
                    setpoints_um,
                    "approach",
                    rests_on=calibration.measurement_id,
                    from_um=dict(calibration.estimate.setpoints_um),
                )
            )
            prior = calibration.estimate.moved_to(
                moved.readback_um, calibration.jacobian, arguments.noise
            )
            iterations += 1
            seen = yield from see_both(arguments.geometry, _gates(arguments, prior))
            here = seen.at(moved.readback_um)
            check_prediction(prior, here, arguments.gate_sigma, arguments.noise)
            jacobian = learn_from_move(calibration.jacobian, before, here, arguments.noise)
            calibration = replace(calibration, jacobian=jacobian)
        frames += seen.frames
        here = seen.at(prior.setpoints_um)
        check_prediction(prior, here, arguments.gate_sigma, arguments.noise)
        calibration = _fused(calibration, prior, seen)


def plan_guide(arguments: GuideArguments, calibration: GuideCalibration) -> dict[str, int]:
    """Absolute setpoints that bring the state to the target; refused outside of the travel."""
    estimate = calibration.estimate
    change_mm = calibration.jacobian.setpoint_change_mm(
        np.array(arguments.target_mm) - estimate.plane_mm
    )
    setpoints_um = dict(estimate.setpoints_um)
    for axis, change in change_mm.items():
        setpoints_um[axis] += round(change * 1000.0)
    travel = {axis: Travel(low, high) for axis, (low, high) in arguments.travel_um.items()}
    try:
        check_travel(setpoints_um, travel)
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    return setpoints_um


def tip_of(geometry: GuideGeometry, estimate: FiducialEstimate) -> tuple[Array, Array]:
    """The tip (2,) in the image plane and its covariance (2, 2)."""
    lever = geometry.tip_from_fiducials
    return lever @ estimate.plane_mm, lever @ estimate.covariance_mm2 @ lever.T


def state_on_line(
    geometry: GuideGeometry, lower_joint_mm: Array, direction: Array, plane: ImagePlane
) -> Array:
    """The state (4,) of a guide whose lower joint and direction (patient mm, upwards) are given."""
    places = [
        plane.from_patient((lower_joint_mm + along * direction).tolist())
        for along in (geometry.upper_along_mm, geometry.lower_along_mm)
    ]
    return np.concatenate(places)


def _places(arguments: GuideArguments) -> list[dict[str, int]]:
    places = [dict(arguments.origin_um)]
    for axis in arguments.axes:
        places.append({**places[-1], axis: places[-1][axis] + arguments.move_um})
    return [*places, dict(arguments.origin_um)]


def _first_expectations(
    arguments: GuideArguments,
    before: FiducialEstimate | None,
    jacobian: ImageJacobian,
    setpoints_um: Mapping[str, int],
    last: bool,
) -> tuple[Expectation | None, Expectation | None]:
    if before is None:
        return None, None
    if last:
        return _gates(arguments, before.moved_to(setpoints_um, jacobian, arguments.noise))
    geometry = arguments.geometry
    lever = max(1.0, geometry.upper_along_mm / geometry.joints_apart_mm)
    gate_mm = max(arguments.position_gate_mm, _FIRST_GATE * lever * abs(arguments.move_um) / 1000)
    return Expectation(before.plane_mm[:2], gate_mm), Expectation(before.plane_mm[2:], gate_mm)


def _gates(
    arguments: GuideArguments, predicted: FiducialEstimate
) -> tuple[Expectation, Expectation]:
    upper, lower = (
        FiducialEstimate(
            predicted.setpoints_um, predicted.plane_mm[part], predicted.covariance_mm2[part, part]
        )
        for part in (slice(0, 2), slice(2, 4))
    )
    gate_mm, sigmas = arguments.position_gate_mm, arguments.gate_sigma
    return Expectation.of(upper, gate_mm, sigmas), Expectation.of(lower, gate_mm, sigmas)


def _check_shares(jacobian: ImageJacobian, geometry: GuideGeometry) -> None:
    """Refuse unless each stage moves each fiducial by the share of the lever that it must have.

    Two fiducials that were taken for each other, one that was lost, and an axis that does not move
    all show here.
    """
    matrix = jacobian.mean_columns
    names, alongs = ("upper", "lower"), (geometry.upper_along_mm, geometry.lower_along_mm)
    shares = np.array([along / geometry.joints_apart_mm for along in alongs])
    swapped = shares[::-1]
    found = np.array(
        [[np.linalg.norm(matrix[2 * f : 2 * f + 2, a]) for a in (0, 1)] for f in (0, 1)]
    )
    if np.all(np.abs(found - swapped[:, None]) < np.abs(found - shares[:, None])):
        raise ProcedureFailedError(
            "fiducials_swapped",
            "the two fiducials move as if they were taken for each other: check the slice "
            "positions of the upper and the lower one",
        )
    for number, axis in enumerate(jacobian.axes):
        for fiducial, (name, share) in enumerate(zip(names, shares, strict=True)):
            expected = abs(share if number < 2 else 1 - share)
            length = float(np.linalg.norm(matrix[2 * fiducial : 2 * fiducial + 2, number]))
            if not abs(length - expected) <= _SHARE_TOLERANCE:
                raise ProcedureFailedError(
                    "calibration",
                    f"axis {axis}: the {name} fiducial moved {length:.2f} mm per mm of setpoint, "
                    f"expected {expected:.2f}; was the move seen?",
                )


def _see_longer(
    arguments: GuideArguments, seen: BothSeen, prior: FiducialEstimate, frames: int
) -> ProcedureSteps[BothSeen]:
    gates = _gates(arguments, prior)
    again = []
    for number in range(2):
        again.append(
            (
                yield from measure_again(
                    seen.acquired[number],
                    "ml",
                    gates[number],
                    frames=frames,
                    slice_position_mm=arguments.geometry.slice_positions_mm[number],
                )
            )
        )
    (first, upper), (second, lower) = again
    return BothSeen((first, second), (upper, lower))


def _fused(
    calibration: GuideCalibration, prior: FiducialEstimate, seen: BothSeen
) -> GuideCalibration:
    here = seen.at(prior.setpoints_um)
    return replace(
        calibration,
        estimate=prior.fused_with(here.plane_mm, here.covariance_mm2),
        measurement_id=seen.measurement_id,
    )


def _frames_that_decide(
    arguments: GuideArguments, estimate: FiducialEstimate, seen: BothSeen
) -> int:
    """Slices of each fiducial that would be enough to say READY, or the present number."""
    present = seen.measured[0].frames
    for frames in range(present, _MOST_FRAMES + 1):
        fewer = replace(estimate, covariance_mm2=estimate.covariance_mm2 * (present / frames))
        if _probability(arguments, fewer) >= arguments.confidence:
            return frames
    return present


def _tip_error(arguments: GuideArguments, estimate: FiducialEstimate) -> tuple[Array, Array]:
    tip_mm, covariance = tip_of(arguments.geometry, estimate)
    wanted = arguments.geometry.tip_from_fiducials @ np.array(arguments.target_mm)
    return wanted - tip_mm, covariance


def _probability(arguments: GuideArguments, estimate: FiducialEstimate) -> float:
    """That the tip is within the tolerance, and the lower fiducial as well: the smaller of both."""
    error, covariance = _tip_error(arguments, estimate)
    at_tip = probability_within(error, covariance, arguments.tolerance_mm)
    lower = np.array(arguments.target_mm)[2:] - estimate.plane_mm[2:]
    at_guide = probability_within(lower, estimate.covariance_mm2[2:, 2:], arguments.tolerance_mm)
    return min(at_tip, at_guide)


def _confirm(
    arguments: GuideArguments, calibration: GuideCalibration, setpoints_um: Mapping[str, int]
) -> ProcedureSteps[None]:
    if not arguments.confirm_moves:
        return
    error, _ = _tip_error(arguments, calibration.estimate)
    plan = {
        "plan_id": f"{calibration.measurement_id}.guide",
        "measurement_id": calibration.measurement_id,
        "from_um": dict(calibration.estimate.setpoints_um),
        "setpoints_um": dict(setpoints_um),
        "displacement_mm": error.tolist(),
    }
    question = f"Move the needle's tip by ({error[0]:+.3f}, {error[1]:+.3f}) mm (row, col)?"
    answer = yield from ask(AskOperator(question, (CONFIRM, REJECT), plan), Answered)
    if answer.choice != CONFIRM:
        raise ProcedureFailedError("rejected", f"the move was rejected by {answer.who}")


def _not_converged(arguments: GuideArguments, estimate: FiducialEstimate) -> ProcedureFailedError:
    error, _ = _tip_error(arguments, estimate)
    return ProcedureFailedError(
        "not_converged",
        f"the target was not reached in {arguments.max_iterations} moves: the error of the tip is "
        f"{np.linalg.norm(error):.3f} mm",
    )


def _arrival(
    arguments: GuideArguments, calibration: GuideCalibration, iterations: int, frames: int
) -> GuideArrival:
    error, covariance = _tip_error(arguments, calibration.estimate)
    return GuideArrival(
        calibration,
        error,
        covariance,
        _probability(arguments, calibration.estimate),
        iterations,
        frames,
    )
