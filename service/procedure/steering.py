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
from service.procedure.identity import PROOF, moved_visibly, proof_plan
from service.procedure.observe import (
    ProcedureFailedError,
    ValidationGate,
    ask_to_confirm,
    check_prediction,
    move,
)
from service.procedure.plan import Plan, PlanPart, PlanRefusedError, Travel, plan_move
from service.procedure.steps import MoveTo, ProcedureSteps
from service.procedure.strategies import Imaging, Strategy

_LOOSE_MM = 0.25
_MOST_PROOFS = 2


@dataclass(frozen=True, kw_only=True)
class SteeringArguments:
    """What every approach is told.

    target_mm: in the image plane of the calibration, as the estimate has it. travel_um: lowest and
    highest setpoint of each axis. most_frames: slices at one position at the most. proven: what is
    measured was seen to move with the robot, see `identity`; otherwise READY is said only after a
    move that shows it. systematic_mm: std, for each coordinate, of what all places found so have in
    common, where it counts: see `targets.common_part_mm`.
    """

    target_mm: tuple[float, ...]
    travel_um: Mapping[str, tuple[int, int]]
    tolerance_mm: float
    confidence: float
    max_iterations: int
    confirm_moves: bool
    gate: ValidationGate
    proven: bool = True
    most_frames: int = 6
    systematic_mm: tuple[float, ...] = ()

    def as_judged(self, estimate: FiducialEstimate) -> FiducialEstimate:
        """An estimate with what counts against the target beside its own uncertainty."""
        if not self.systematic_mm:
            return estimate
        more = np.diag(np.square(self.systematic_mm))
        return replace(estimate, covariance_mm2=estimate.covariance_mm2 + more)

    @property
    def travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self.travel_um.items()}


def why_never_sure(
    arguments: SteeringArguments, is_sure: Callable[[FiducialEstimate], bool]
) -> str:
    """Why READY could not be said even at the target, seen perfectly; empty where it could."""
    size = len(arguments.target_mm)
    there = FiducialEstimate({}, np.array(arguments.target_mm), np.zeros((size, size)))
    if is_sure(there):
        return ""
    worst_mm = max(arguments.systematic_mm, default=0.0)
    return (
        f"the middle of the fiducial is known to {worst_mm:.3f} mm (σ, one axis), and for this "
        f"target that counts in full: an error below {arguments.tolerance_mm:g} mm cannot be "
        f"said with {100 * arguments.confidence:g} %. Widen the tolerance, or record a target at "
        "the fiducial's own place"
    )


class AnyLook(Protocol):
    """What was seen from where the robot stands now.

    found: from this look alone; prior: what was believed before it; frames: slices that it took.
    after_loss: at first it was not found.
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

    @property
    def after_loss(self) -> bool: ...


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
        self, calibration: Calibration, way: Imaging, *, number: int, fresh: bool
    ) -> ProcedureSteps[LookT]:
        """Look from where the robot stands; number: of the look, from zero."""

    def look_longer(self, seen: LookT, estimate: FiducialEstimate) -> ProcedureSteps[LookT | None]:
        """Look again with so many slices as decide; None if no number of them does."""

    def error_mm(self, estimate: FiducialEstimate) -> NDArray[np.float64]:
        """From where it is to where it should be, image plane (row, col)."""

    def parts(self, estimate: FiducialEstimate) -> tuple[PlanPart, ...]:
        """How far each thing that the operator is told of is from where it should be."""

    def is_there(self, calibration: Calibration, way: Imaging) -> bool:
        """Whether this is the place to puncture, as far as can be said of it."""

    def why_not_there(self, estimate: FiducialEstimate) -> str:
        """How far off it is, for the operator."""


@dataclass(frozen=True, eq=False)
class Standing(Generic[LookT]):
    """Where an approach stands.

    seen: the last look, if the robot has not moved since; iterations: moves made so far, `proofs`
    of them to prove what is seen; proven: it was seen to move with the robot.
    """

    calibration: Calibration
    seen: LookT | None = None
    looks: int = 0
    frames: int = 0
    scan_s: float = 0.0
    iterations: int = 0
    proofs: int = 0
    proven: bool = True


def steer(steered: Steered[LookT], start: Calibration) -> ProcedureSteps[Standing[LookT]]:
    """Bring it to its target; raises ProcedureFailedError when that does not succeed."""
    arguments, strategy = steered.arguments, steered.strategy
    way = strategy.coarse
    standing: Standing[LookT] = Standing(start, proven=arguments.proven)
    if not strategy.fuses or _is_loose(start.estimate, arguments.tolerance_mm):
        standing = yield from _look(steered, standing, way)
    while True:
        if strategy.fuses:
            standing = yield from _look_longer(steered, standing)
        if steered.is_there(standing.calibration, way):
            if standing.seen is not None and way is strategy.fine:
                if standing.proven:
                    return standing
                standing = yield from _prove(steered, standing, way)
                continue
            # never READY on a prediction, nor (hybrid) on the coarse image
            way = strategy.fine
            standing = yield from _look(steered, standing, way)
            continue
        # a proof move and the way back from it are not counted
        if standing.iterations >= arguments.max_iterations + 2 * standing.proofs:
            raise ProcedureFailedError(
                "not_converged",
                f"the target was not reached in {arguments.max_iterations} moves: "
                f"{steered.why_not_there(standing.calibration.estimate)}",
            )
        plan = _plan(steered, standing)
        if arguments.confirm_moves:
            yield from ask_to_confirm(steered.name, plan)
        standing = yield from _go(steered, standing, plan, way)


def _prove(
    steered: Steered[LookT], standing: Standing[LookT], way: Imaging
) -> ProcedureSteps[Standing[LookT]]:
    """Move by part of a pixel: what is seen must go with it; raises ProcedureFailedError if not."""
    if standing.proofs == _MOST_PROOFS:
        text = f"the {steered.name} did not move with the robot in the images: is it in the slice?"
        raise ProcedureFailedError("identity", text)
    calibration = standing.calibration
    plan_id = f"{calibration.measurement_id}.{standing.iterations}"
    try:
        plan = proof_plan(calibration, steered.arguments.travel, plan_id)
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    if steered.arguments.confirm_moves:
        yield from ask_to_confirm(f"{steered.name}, as a proof move,", plan)
    standing = replace(standing, proofs=standing.proofs + 1)
    try:
        return (yield from _go(steered, standing, plan, way, PROOF))
    except ProcedureFailedError as error:
        if error.code != "prediction_missed":
            raise
        text = f"the object seen does not move with the robot, so it is not the fiducial: {error}"
        raise ProcedureFailedError("identity", text) from error


def _is_loose(estimate: FiducialEstimate, tolerance_mm: float) -> bool:
    """True if the start is known so badly that a plan from it would be a guess."""
    worst_mm = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance_mm2)[-1]))
    return worst_mm > max(_LOOSE_MM, tolerance_mm)


def _look(
    steered: Steered[LookT], standing: Standing[LookT], way: Imaging
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
    if seen.after_loss:
        there = replace(there, proven=False)
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


def _go(
    steered: Steered[LookT],
    standing: Standing[LookT],
    plan: Plan,
    way: Imaging,
    purpose: str = "approach",
) -> ProcedureSteps[Standing[LookT]]:
    """Carry out the plan, look, and learn from the move."""
    calibration, noise = standing.calibration, steered.arguments.gate.noise
    before = calibration.estimate if standing.seen is None else standing.seen.found
    moved = yield from move(
        MoveTo(
            dict(plan.setpoints_um),
            purpose,
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
    if standing.seen is not None and after.seen is not None and not after.seen.after_loss:
        followed = moved_visibly(before, after.seen.found)
        after = replace(after, proven=after.proven or followed)
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
