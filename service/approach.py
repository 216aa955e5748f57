"""Approach: measure, plan, move, until the fiducial is at the target with enough certainty.

How it looks is the strategy's (`service.looking`). `adaptive` carries every earlier measurement
along through the known moves, plans from that, and takes more slices at one place only where the
bound says that they will decide. The paper's strategies believe the last image alone, and their
image Jacobian stays as it was calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.calibration import Calibration, learn_from_move
from service.estimate import FiducialEstimate, probability_within
from service.looking import STRATEGIES, Look, Way, look_at_fiducial, look_longer
from service.plan import Plan, PlanRefusedError, Travel, plan_move
from service.sensing import ProcedureFailedError, ValidationGate, check_prediction, move
from service.steps import Answered, AskOperator, Measured, MoveTo, ProcedureSteps, ask

CONFIRM = "confirm"
REJECT = "reject"
_MOST_FRAMES = 6
_WORTH_MORE_FRAMES = 0.6
LOOSE_MM = 0.25
PROBABILITY, PAPER = "probability", "paper"


@dataclass(frozen=True)
class ApproachArguments:
    """What an approach is told.

    target_mm: in the image plane of the calibration. stop_rule: `probability` (READY only with
    P(error < tolerance) >= confidence) or `paper` (error below one pixel of the image looked at;
    for the paper's studies). seed: of the random shift sets.
    """

    target_mm: tuple[float, float]
    travel_um: Mapping[str, tuple[int, int]]
    tolerance_mm: float
    confidence: float
    max_iterations: int
    confirm_moves: bool
    gate: ValidationGate
    strategy: str = "adaptive"
    stop_rule: str = PROBABILITY
    seed: int = 0

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
    """Where an approach stands.

    seen: the last look, if the robot has not moved since; iterations: moves made so far.
    """

    calibration: Calibration
    seen: Look | None = None
    looks: int = 0
    frames: int = 0
    scan_s: float = 0.0
    iterations: int = 0


def approach(arguments: ApproachArguments, start: Calibration) -> ProcedureSteps[Arrival]:
    """Bring the fiducial to the target; raises ProcedureFailedError when that does not succeed."""
    strategy = STRATEGIES[arguments.strategy]
    way = strategy.coarse
    standing = _Standing(start)
    if not strategy.fuses or _is_loose(arguments, start.estimate):
        standing = yield from _look(arguments, standing, way)
    while True:
        if strategy.fuses:
            standing = yield from _more_frames(arguments, standing)
        if _is_there(arguments, standing, way):
            if standing.seen is not None and way is strategy.fine:
                return _arrival(arguments, standing)
            # never READY on a prediction, nor (hybrid) on the coarse image
            way = strategy.fine
            standing = yield from _look(arguments, standing, way)
            continue
        if standing.iterations == arguments.max_iterations:
            raise _not_converged(arguments, standing)
        plan = _plan(arguments, standing)
        if arguments.confirm_moves:
            row, col = plan.displacement_mm
            yield from ask_to_confirm(
                f"Move the fiducial by ({row:+.3f}, {col:+.3f}) mm (row, col)?", plan
            )
        standing = yield from _go(arguments, standing, plan, way)


def _look(arguments: ApproachArguments, standing: _Standing, way: Way) -> ProcedureSteps[_Standing]:
    """Look from where the robot stands; what was predicted must be what is seen."""
    calibration = standing.calibration
    look = yield from look_at_fiducial(
        way,
        calibration,
        arguments.gate,
        seed=(arguments.seed, standing.looks),
        fresh=standing.seen is not None or standing.iterations == 0,
    )
    check_prediction(calibration.estimate, look.found, arguments.gate)
    estimate = look.found
    if STRATEGIES[arguments.strategy].fuses:
        estimate = calibration.estimate.fused_with(estimate.plane_mm, estimate.covariance_mm2)
    return replace(
        standing,
        calibration=replace(
            calibration, estimate=estimate, measurement_id=look.measured.measurement_id
        ),
        seen=look,
        looks=standing.looks + 1,
        frames=standing.frames + look.measured.frames,
        scan_s=standing.scan_s + look.measured.scan_s,
    )


def _more_frames(arguments: ApproachArguments, standing: _Standing) -> ProcedureSteps[_Standing]:
    """Take more slices here, if so many as are needed would make this the place to puncture."""
    seen = standing.seen
    if seen is None or seen.acquired is None:
        return standing
    wanted = frames_that_decide(arguments, standing.calibration.estimate, seen.measured)
    if wanted <= seen.measured.frames:
        return standing
    more = yield from look_longer(seen, seen.acquired, arguments.gate, frames=wanted)
    # from the prior again: the slices that are in both measurements count once
    fused = seen.prior.fused_with(more.found.plane_mm, more.found.covariance_mm2)
    return replace(
        standing,
        calibration=replace(
            standing.calibration, estimate=fused, measurement_id=more.measured.measurement_id
        ),
        seen=more,
        frames=standing.frames + more.measured.frames - seen.measured.frames,
        scan_s=standing.scan_s + more.measured.scan_s - seen.measured.scan_s,
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


def _go(
    arguments: ApproachArguments, standing: _Standing, plan: Plan, way: Way
) -> ProcedureSteps[_Standing]:
    """Carry out the plan, look, and learn from the move."""
    calibration = standing.calibration
    before = calibration.estimate if standing.seen is None else standing.seen.found
    moved = yield from move(
        MoveTo(
            dict(plan.setpoints_um),
            "approach",
            rests_on=plan.measurement_id,
            from_um=dict(plan.from_um),
        )
    )
    predicted = calibration.estimate.moved_to(
        moved.readback_um, calibration.jacobian, arguments.gate.noise
    )
    there = replace(
        standing,
        calibration=replace(calibration, estimate=predicted),
        seen=None,
        iterations=standing.iterations + 1,
    )
    after = yield from _look(arguments, there, way)
    if not STRATEGIES[arguments.strategy].fuses or after.seen is None:
        return after
    jacobian = learn_from_move(calibration.jacobian, before, after.seen.found, arguments.gate.noise)
    return replace(after, calibration=replace(after.calibration, jacobian=jacobian))


def _is_loose(arguments: ApproachArguments, estimate: FiducialEstimate) -> bool:
    """True if the start is known so badly that a plan from it would be a guess."""
    worst_mm = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance_mm2)[-1]))
    return worst_mm > max(LOOSE_MM, arguments.tolerance_mm)


def _is_there(arguments: ApproachArguments, standing: _Standing, way: Way) -> bool:
    estimate = standing.calibration.estimate
    if arguments.stop_rule == "probability":
        return _probability(arguments, estimate) >= arguments.confidence
    pixel_mm = np.array(standing.calibration.plane.spacing_mm) / way.factor
    return float(np.linalg.norm(_error(arguments, estimate) / pixel_mm)) < 1.0


def _not_converged(arguments: ApproachArguments, standing: _Standing) -> ProcedureFailedError:
    error_mm = np.linalg.norm(_error(arguments, standing.calibration.estimate))
    return ProcedureFailedError(
        "not_converged",
        f"the target was not reached in {arguments.max_iterations} moves: the error is "
        f"{error_mm:.3f} mm, P(error < {arguments.tolerance_mm:g} mm) = "
        f"{_probability(arguments, standing.calibration.estimate):.2f}",
    )


def _plan(arguments: ApproachArguments, standing: _Standing) -> Plan:
    calibration = standing.calibration
    try:
        return plan_move(
            calibration.estimate,
            np.array(arguments.target_mm),
            calibration.jacobian,
            arguments.travel,
            measurement_id=calibration.measurement_id,
            plan_id=f"{calibration.measurement_id}.{standing.iterations}",
        )
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error


def ask_to_confirm(question: str, plan: Plan) -> ProcedureSteps[None]:
    """Wait for the operator; raises ProcedureFailedError unless the plan is confirmed."""
    answer = yield from ask(AskOperator(question, (CONFIRM, REJECT), plan.to_json()), Answered)
    if answer.choice != CONFIRM:
        raise ProcedureFailedError("rejected", f"the move was rejected by {answer.who}")


def _error(arguments: ApproachArguments, estimate: FiducialEstimate) -> np.ndarray:
    return np.array(arguments.target_mm) - estimate.plane_mm


def _probability(arguments: ApproachArguments, estimate: FiducialEstimate) -> float:
    return probability_within(
        _error(arguments, estimate), estimate.covariance_mm2, arguments.tolerance_mm
    )


def _arrival(arguments: ApproachArguments, standing: _Standing) -> Arrival:
    estimate = standing.calibration.estimate
    return Arrival(
        standing.calibration,
        float(np.linalg.norm(_error(arguments, estimate))),
        float(np.sqrt(np.trace(estimate.covariance_mm2) / 2)),
        _probability(arguments, estimate),
        standing.iterations,
        standing.frames,
        standing.scan_s,
        standing.calibration.measurement_id,
    )
