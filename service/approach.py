"""Approach: measure, plan, move, until the fiducial is at the target with enough certainty.

The `adaptive` strategy: one slice a place, every earlier measurement carried along through the
known moves, and more slices at the same place only where the bound says that they will decide.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.calibration import Calibration, learn_from_move
from service.estimate import FiducialEstimate, MotionNoise, probability_within
from service.plan import Plan, PlanRefusedError, Travel, plan_move
from service.plane import ImagePlane
from service.sensing import (
    Expectation,
    ProcedureFailedError,
    check_prediction,
    estimate_from,
    measure_again,
    measure_here,
    move,
)
from service.steps import Acquired, Answered, AskOperator, Measured, MoveTo, ProcedureSteps, ask

CONFIRM = "confirm"
REJECT = "reject"
_MOST_FRAMES = 6
_WORTH_MORE_FRAMES = 0.6


@dataclass(frozen=True)
class ApproachArguments:
    """target_mm is in the image plane of the calibration."""

    target_mm: tuple[float, float]
    travel_um: Mapping[str, tuple[int, int]]
    tolerance_mm: float
    confidence: float
    max_iterations: int
    confirm_moves: bool
    position_gate_mm: float
    gate_sigma: float
    repeatability_mm: float
    scale_error: float

    @property
    def noise(self) -> MotionNoise:
        return MotionNoise(self.repeatability_mm, self.scale_error)

    @property
    def travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self.travel_um.items()}


@dataclass(frozen=True, eq=False)
class Arrival:
    """READY: the fiducial is at the target; the calibration goes on with what was learnt."""

    calibration: Calibration
    error_mm: float
    sigma_mm: float
    probability: float
    iterations: int
    frames: int
    scan_s: float
    measurement_id: int

    def to_json(self) -> dict[str, Any]:
        numbers = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {**numbers, "calibration": self.calibration.to_json()}


@dataclass(frozen=True, eq=False)
class _Standing:
    """Where an approach stands after a measurement."""

    calibration: Calibration
    acquired: Acquired
    measured: Measured
    prior: FiducialEstimate | None
    frames: int
    scan_s: float


def approach(arguments: ApproachArguments, start: Calibration) -> ProcedureSteps[Arrival]:
    """Bring the fiducial to the target; raises ProcedureFailedError when that does not succeed."""
    standing = yield from _look(arguments, start, start.estimate, 0, 0.0)
    for iteration in range(arguments.max_iterations + 1):
        standing = yield from _more_frames(arguments, standing)
        probability = _probability(arguments, standing.calibration.estimate)
        if probability >= arguments.confidence:
            return _arrival(arguments, standing, probability, iteration)
        if iteration == arguments.max_iterations:
            break
        plan = _plan(arguments, standing, iteration)
        yield from _confirm(arguments, plan)
        standing = yield from _go(arguments, standing, plan)
    raise ProcedureFailedError(
        "not_converged",
        f"the target was not reached in {arguments.max_iterations} moves: the error is "
        f"{np.linalg.norm(_error(arguments, standing.calibration.estimate)):.3f} mm",
    )


def _look(
    arguments: ApproachArguments,
    calibration: Calibration,
    predicted: FiducialEstimate,
    frames: int,
    scan_s: float,
) -> ProcedureSteps[_Standing]:
    expectation = Expectation.of(predicted, arguments.position_gate_mm, arguments.gate_sigma)
    acquired, measured = yield from measure_here(predicted.setpoints_um, "ml", expectation)
    if not ImagePlane.from_json(measured.plane).is_parallel_to(calibration.plane):
        raise ProcedureFailedError(
            "plane_changed", "the slice orientation is not that of the calibration"
        )
    check_prediction(predicted, measured, arguments.gate_sigma, arguments.noise)
    fused = predicted.fused_with(np.array(measured.plane_mm), np.array(measured.covariance_mm2))
    learnt = Calibration(calibration.jacobian, fused, calibration.plane, measured.measurement_id)
    return _Standing(
        learnt, acquired, measured, predicted, frames + measured.frames, scan_s + measured.scan_s
    )


def _more_frames(arguments: ApproachArguments, standing: _Standing) -> ProcedureSteps[_Standing]:
    """Take more slices here, if so many as are needed would make this the place to puncture."""
    wanted = frames_that_decide(arguments, standing.calibration.estimate, standing.measured)
    if wanted <= standing.measured.frames or standing.prior is None:
        return standing
    expectation = Expectation.of(standing.prior, arguments.position_gate_mm, arguments.gate_sigma)
    acquired, measured = yield from measure_again(
        standing.acquired, "ml", expectation, frames=wanted
    )
    fused = standing.prior.fused_with(
        np.array(measured.plane_mm), np.array(measured.covariance_mm2)
    )
    calibration = standing.calibration
    return _Standing(
        Calibration(calibration.jacobian, fused, calibration.plane, measured.measurement_id),
        acquired,
        measured,
        standing.prior,
        standing.frames + measured.frames - standing.measured.frames,
        standing.scan_s + measured.scan_s - standing.measured.scan_s,
    )


def frames_that_decide(
    arguments: ApproachArguments, estimate: FiducialEstimate, measured: Measured
) -> int:
    """Return how many slices at this hold would be enough to say READY, or the present number.

    The bound scales as one over the number of frames; the error found so far is taken as the error.
    Where the error itself is most of the tolerance, a move is worth more than another slice.
    """
    error = _error(arguments, estimate)
    if np.linalg.norm(error) > _WORTH_MORE_FRAMES * arguments.tolerance_mm:
        return measured.frames
    for frames in range(measured.frames, _MOST_FRAMES + 1):
        covariance = estimate.covariance_mm2 * (measured.frames / frames)
        if probability_within(error, covariance, arguments.tolerance_mm) >= arguments.confidence:
            return frames
    return measured.frames


def _go(arguments: ApproachArguments, standing: _Standing, plan: Plan) -> ProcedureSteps[_Standing]:
    calibration = standing.calibration
    before = estimate_from(standing.measured, calibration.estimate.setpoints_um)
    moved = yield from move(
        MoveTo(dict(plan.setpoints_um), "approach", rests_on=plan.measurement_id)
    )
    predicted = calibration.estimate.moved_to(
        moved.readback_um, calibration.jacobian, arguments.noise
    )
    after = yield from _look(arguments, calibration, predicted, standing.frames, standing.scan_s)
    jacobian = learn_from_move(
        calibration.jacobian,
        before,
        estimate_from(after.measured, moved.readback_um),
        arguments.noise,
    )
    learnt = Calibration(
        jacobian,
        after.calibration.estimate,
        calibration.plane,
        after.calibration.measurement_id,
    )
    return _Standing(
        learnt, after.acquired, after.measured, after.prior, after.frames, after.scan_s
    )


def _plan(arguments: ApproachArguments, standing: _Standing, iteration: int) -> Plan:
    calibration = standing.calibration
    try:
        return plan_move(
            calibration.estimate,
            np.array(arguments.target_mm),
            calibration.jacobian,
            arguments.travel,
            measurement_id=calibration.measurement_id,
            plan_id=f"{calibration.measurement_id}.{iteration}",
        )
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error


def _confirm(arguments: ApproachArguments, plan: Plan) -> ProcedureSteps[None]:
    if not arguments.confirm_moves:
        return
    row, col = plan.displacement_mm
    question = f"Move the fiducial by ({row:+.3f}, {col:+.3f}) mm (row, col)?"
    answer = yield from ask(AskOperator(question, (CONFIRM, REJECT), plan.to_json()), Answered)
    if answer.choice != CONFIRM:
        raise ProcedureFailedError("rejected", f"the move was rejected by {answer.who}")


def _error(arguments: ApproachArguments, estimate: FiducialEstimate) -> np.ndarray:
    return np.array(arguments.target_mm) - estimate.plane_mm


def _probability(arguments: ApproachArguments, estimate: FiducialEstimate) -> float:
    return probability_within(
        _error(arguments, estimate), estimate.covariance_mm2, arguments.tolerance_mm
    )


def _arrival(
    arguments: ApproachArguments, standing: _Standing, probability: float, iterations: int
) -> Arrival:
    estimate = standing.calibration.estimate
    return Arrival(
        standing.calibration,
        float(np.linalg.norm(_error(arguments, estimate))),
        float(np.sqrt(np.trace(estimate.covariance_mm2) / 2)),
        probability,
        iterations,
        standing.frames,
        standing.scan_s,
        standing.measured.measurement_id,
    )
