"""Steering: look, plan, move and learn, until what is steered is at its target with certainty.

The loop that every approach goes through. What it steers, one fiducial with two axes or the guide's
line with four, is a `Steered`: it knows how to look, how far off it is, and how sure that is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.procedure.calibration import Calibration, learn_from_move
from service.procedure.estimate import FiducialEstimate
from service.procedure.plan import Plan, PlanPart, PlanRefusedError, Travel, plan_move
from service.procedure.sensing import ProcedureFailedError, ValidationGate, check_prediction, move
from service.procedure.steps import Answered, AskOperator, MoveTo, ProcedureSteps, ask
from service.procedure.strategies import Strategy, Way

CONFIRM = "confirm"
REJECT = "reject"
_LOOSE_MM = 0.25


@dataclass(frozen=True, kw_only=True)
class SteeringArguments:
    """What every approach is told.

    target_mm: in the image plane of the calibration, as the estimate has it. travel_um: lowest and
    highest setpoint of each axis. most_frames: slices at one position at the most.
    """

    target_mm: tuple[float, ...]
    travel_um: Mapping[str, tuple[int, int]]
    tolerance_mm: float
    confidence: float
    max_iterations: int
    confirm_moves: bool
    gate: ValidationGate
    most_frames: int = 6

    @property
    def travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self.travel_um.items()}


class AnyLook(Protocol):
    """What was seen from where the robot stands now.

    found: from this look alone; prior: what was believed before it; frames: slices that it took.
    """

    @property
    def found(self) -> FiducialEstimate: ...

    @property
    def prior(self) -> FiducialEstimate: ...

    @property
    def measurement_id(self) -> int: ...

    @property
    def frames(self) -> int: ...

    @property
    def scan_s(self) -> float: ...


LookT = TypeVar("LookT", bound=AnyLook)


class Steered(Protocol[LookT]):
    """What is brought to its target."""

    @property
    def arguments(self) -> SteeringArguments: ...

    @property
    def strategy(self) -> Strategy: ...

    @property
    def name(self) -> str:
        """As the operator calls what is moved."""

    def look(
        self, calibration: Calibration, way: Way, *, number: int, fresh: bool
    ) -> ProcedureSteps[LookT]:
        """Look from where the robot stands; number: of the look, from zero."""

    def look_longer(self, seen: LookT, estimate: FiducialEstimate) -> ProcedureSteps[LookT | None]:
        """Look again with so many slices as decide; None if no number of them does."""

    def error_mm(self, estimate: FiducialEstimate) -> NDArray[np.float64]:
        """From where it is to where it should be, image plane (row, col)."""

    def parts(self, estimate: FiducialEstimate) -> tuple[PlanPart, ...]:
        """How far each thing that the operator is told of is from where it should be."""

    def is_there(self, calibration: Calibration, way: Way) -> bool:
        """Whether this is the place to puncture, as far as can be said of it."""

    def why_not_there(self, estimate: FiducialEstimate) -> str:
        """How far off it is, for the operator."""


@dataclass(frozen=True, eq=False)
class Standing(Generic[LookT]):
    """Where an approach stands.

    seen: the last look, if the robot has not moved since; iterations: moves made so far.
    """

    calibration: Calibration
    seen: LookT | None = None
    looks: int = 0
    frames: int = 0
    scan_s: float = 0.0
    iterations: int = 0


def steer(steered: Steered[LookT], start: Calibration) -> ProcedureSteps[Standing[LookT]]:
    """Bring it to its target; raises ProcedureFailedError when that does not succeed."""
    arguments, strategy = steered.arguments, steered.strategy
    way = strategy.coarse
    standing: Standing[LookT] = Standing(start)
    if not strategy.fuses or _is_loose(start.estimate, arguments.tolerance_mm):
        standing = yield from _look(steered, standing, way)
    while True:
        if strategy.fuses:
            standing = yield from _look_longer(steered, standing)
        if steered.is_there(standing.calibration, way):
            if standing.seen is not None and way is strategy.fine:
                return standing
            # never READY on a prediction, nor (hybrid) on the coarse image
            way = strategy.fine
            standing = yield from _look(steered, standing, way)
            continue
        if standing.iterations == arguments.max_iterations:
            raise ProcedureFailedError(
                "not_converged",
                f"the target was not reached in {arguments.max_iterations} moves: "
                f"{steered.why_not_there(standing.calibration.estimate)}",
            )
        plan = _plan(steered, standing)
        if arguments.confirm_moves:
            yield from _ask_to_confirm(steered.name, plan)
        standing = yield from _go(steered, standing, plan, way)


def _is_loose(estimate: FiducialEstimate, tolerance_mm: float) -> bool:
    """True if the start is known so badly that a plan from it would be a guess."""
    worst_mm = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance_mm2)[-1]))
    return worst_mm > max(_LOOSE_MM, tolerance_mm)


def _look(
    steered: Steered[LookT], standing: Standing[LookT], way: Way
) -> ProcedureSteps[Standing[LookT]]:
    """Look from where the robot stands; what was predicted must be what is seen."""
    prior = standing.calibration.estimate
    fresh = standing.seen is not None or standing.iterations == 0
    seen = yield from steered.look(standing.calibration, way, number=standing.looks, fresh=fresh)
    check_prediction(prior, seen.found, steered.arguments.gate)
    there = replace(
        standing,
        looks=standing.looks + 1,
        frames=standing.frames + seen.frames,
        scan_s=standing.scan_s + seen.scan_s,
    )
    return _believing(there, seen, fuses=steered.strategy.fuses)


def _look_longer(
    steered: Steered[LookT], standing: Standing[LookT]
) -> ProcedureSteps[Standing[LookT]]:
    """Take more slices here, if so many as are needed would make this the place to puncture."""
    seen = standing.seen
    if seen is None:
        return standing
    more = yield from steered.look_longer(seen, standing.calibration.estimate)
    if more is None:
        return standing
    # the slices that are in both measurements count once
    there = replace(
        standing,
        frames=standing.frames + more.frames - seen.frames,
        scan_s=standing.scan_s + more.scan_s - seen.scan_s,
    )
    return _believing(there, more, fuses=True)


def _believing(standing: Standing[LookT], seen: LookT, *, fuses: bool) -> Standing[LookT]:
    """What is believed after a look: it alone, or with all that was believed before it."""
    estimate = seen.found
    if fuses:
        estimate = seen.prior.fused_with(estimate.plane_mm, estimate.covariance_mm2)
    calibration = replace(
        standing.calibration, estimate=estimate, measurement_id=seen.measurement_id
    )
    return replace(standing, calibration=calibration, seen=seen)


def _plan(steered: Steered[LookT], standing: Standing[LookT]) -> Plan:
    calibration = standing.calibration
    try:
        plan = plan_move(
            calibration.estimate,
            np.array(steered.arguments.target_mm),
            calibration.jacobian,
            steered.arguments.travel,
            measurement_id=calibration.measurement_id,
            plan_id=f"{calibration.measurement_id}.{standing.iterations}",
        )
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    row, col = steered.error_mm(calibration.estimate).tolist()
    return replace(plan, displacement_mm=(row, col), parts=steered.parts(calibration.estimate))


def _ask_to_confirm(name: str, plan: Plan) -> ProcedureSteps[None]:
    """Wait for the operator; raises ProcedureFailedError unless the plan is confirmed."""
    row, col = plan.displacement_mm
    question = f"Move the {name} by ({row:+.3f}, {col:+.3f}) mm (row, col)?"
    answer = yield from ask(AskOperator(question, (CONFIRM, REJECT), plan.to_json()), Answered)
    if answer.choice != CONFIRM:
        raise ProcedureFailedError("rejected", f"the move was rejected by {answer.who}")


def _go(
    steered: Steered[LookT], standing: Standing[LookT], plan: Plan, way: Way
) -> ProcedureSteps[Standing[LookT]]:
    """Carry out the plan, look, and learn from the move."""
    calibration, noise = standing.calibration, steered.arguments.gate.noise
    before = calibration.estimate if standing.seen is None else standing.seen.found
    moved = yield from move(
        MoveTo(
            dict(plan.setpoints_um),
            "approach",
            rests_on=plan.measurement_id,
            from_um=dict(plan.from_um),
        )
    )
    predicted = calibration.estimate.moved_to(moved.readback_um, calibration.jacobian, noise)
    there = replace(
        standing,
        calibration=replace(calibration, estimate=predicted),
        seen=None,
        iterations=standing.iterations + 1,
    )
    after = yield from _look(steered, there, way)
    if not steered.strategy.fuses or after.seen is None:
        return after
    jacobian = learn_from_move(calibration.jacobian, before, after.seen.found, noise)
    return replace(after, calibration=replace(after.calibration, jacobian=jacobian))


def frames_that_decide(
    present: int,
    estimate: FiducialEstimate,
    is_sure: Callable[[FiducialEstimate], bool],
    most: int,
) -> int:
    """Return how many slices of a fiducial would be enough to be sure, or the present number.

    The bound scales as one over their number; the error found so far is taken as the error.
    """
    for frames in range(present, most + 1):
        fewer = replace(estimate, covariance_mm2=estimate.covariance_mm2 * (present / frames))
        if is_sure(fewer):
            return frames
    return present
