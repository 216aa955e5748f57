"""Approach: look, plan, move and learn, until what is steered is at its target with certainty.

One loop for one fiducial with two axes and for the guide's line with four: `ApproachArguments` says
what is to be where. How it looks is the strategy's (`service.procedure.strategies`). `adaptive`
carries every earlier measurement along through the known moves, plans from that, and takes more
slices at one place only where the bound says that they will decide. The paper's strategies believe
the last image alone, and their image Jacobian stays as it was calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.procedure.aim import ApproachArguments
from service.procedure.calibration import Calibration, learn_from_move
from service.procedure.estimate import FiducialEstimate, axis_sigma
from service.procedure.fiducials import NeedleSeen, judged_point
from service.procedure.identity import PROOF, moved_visibly, proof_plan
from service.procedure.observe import (
    ProcedureFailedError,
    ask_to_confirm,
    check_prediction,
    move,
    see_needle,
)
from service.procedure.plan import Plan, PlanRefusedError, plan_move
from service.procedure.steps import MoveTo, ProcedureSteps
from service.procedure.strategies import Imaging, Observation, look, look_longer

_LOOSE_MM = 0.25
_MOST_PROOFS = 2


@dataclass(frozen=True, eq=False)
class Arrival:
    """READY: what is judged is at its target; the calibration goes on with what was learnt.

    point_error_mm (2,), point_covariance_mm2 (2, 2): of the judged point, in the image plane.
    needle: with four axes, where the needle goes.
    """

    calibration: Calibration
    point_error_mm: NDArray[np.float64]
    point_covariance_mm2: NDArray[np.float64]
    probability: float
    iterations: int
    frames: int
    scan_s: float
    needle: NeedleSeen | None = None

    @property
    def error_mm(self) -> float:
        return float(np.linalg.norm(self.point_error_mm))

    @property
    def sigma_mm(self) -> float:
        return axis_sigma(self.point_covariance_mm2)

    @property
    def measurement_id(self) -> int:
        return self.calibration.measurement_id

    def to_json(self) -> dict[str, Any]:
        names = ("error_mm", "sigma_mm", "probability", "iterations", "frames", "scan_s")
        numbers = {name: getattr(self, name) for name in (*names, "measurement_id")}
        known = {"calibration": self.calibration.to_json(), **numbers}
        if self.needle is None:
            return known
        return {
            **known,
            **self.needle.to_json(),
            "tip_error_mm": self.point_error_mm.tolist(),
            "tip_covariance_mm2": self.point_covariance_mm2.tolist(),
        }


def approach(arguments: ApproachArguments, start: Calibration) -> ProcedureSteps[Arrival]:
    """Bring it to its target; raises ProcedureFailedError when that does not succeed."""
    standing = yield from _steer(arguments, start)
    calibration, estimate = standing.calibration, standing.calibration.estimate
    return Arrival(
        calibration,
        arguments.error_mm(estimate),
        judged_point(arguments.geometry, arguments.as_judged(estimate))[1],
        arguments.probability(estimate),
        standing.iterations,
        standing.frames,
        standing.scan_s,
        see_needle(arguments.geometry, estimate, calibration.plane, arguments.lower_plane_mm),
    )


@dataclass(frozen=True, eq=False)
class Standing:
    """Where an approach stands.

    observed: in the last look, if the robot has not moved since; iterations: moves made so far,
    `proofs` of them to prove what is seen; proven: it was seen to move with the robot.
    """

    calibration: Calibration
    observed: Observation | None = None
    looks: int = 0
    frames: int = 0
    scan_s: float = 0.0
    iterations: int = 0
    proofs: int = 0
    proven: bool = True


def _steer(arguments: ApproachArguments, start: Calibration) -> ProcedureSteps[Standing]:
    strategy = arguments.how_to_look
    way = strategy.coarse
    standing = Standing(start, proven=arguments.proven)
    if not strategy.fuses or _is_loose(start.estimate, arguments.tolerance_mm):
        standing = yield from _look(arguments, standing, way)
    while True:
        if strategy.fuses:
            standing = yield from _look_longer(arguments, standing)
        if arguments.is_there(standing.calibration, way):
            if standing.observed is not None and way is strategy.fine:
                if standing.proven:
                    return standing
                standing = yield from _prove(arguments, standing, way)
                continue
            # never READY on a prediction, nor (hybrid) on the coarse image
            way = strategy.fine
            standing = yield from _look(arguments, standing, way)
            continue
        # a proof move and the way back from it are not counted
        if standing.iterations >= arguments.max_iterations + 2 * standing.proofs:
            raise ProcedureFailedError(
                "not_converged",
                f"the target was not reached in {arguments.max_iterations} moves: "
                f"{arguments.why_not_there(standing.calibration.estimate)}",
            )
        plan = _plan(arguments, standing)
        if arguments.confirm_moves:
            yield from ask_to_confirm(arguments.geometry.judged_name, plan)
        standing = yield from _go(arguments, standing, plan, way)


def _prove(
    arguments: ApproachArguments, standing: Standing, way: Imaging
) -> ProcedureSteps[Standing]:
    """Move by part of a pixel: what is seen must go with it; raises ProcedureFailedError if not."""
    name = arguments.geometry.judged_name
    if standing.proofs == _MOST_PROOFS:
        text = f"the {name} did not move with the robot in the images: is it in the slice?"
        raise ProcedureFailedError("identity", text)
    calibration = standing.calibration
    plan_id = f"{calibration.measurement_id}.{standing.iterations}"
    try:
        plan = proof_plan(calibration, arguments.travel, plan_id)
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    if arguments.confirm_moves:
        yield from ask_to_confirm(f"{name}, as a proof move,", plan)
    standing = replace(standing, proofs=standing.proofs + 1)
    try:
        return (yield from _go(arguments, standing, plan, way, PROOF))
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
    arguments: ApproachArguments, standing: Standing, way: Imaging
) -> ProcedureSteps[Standing]:
    """Look from where the robot stands; what was predicted must be what is seen."""
    prior = standing.calibration.estimate
    fresh = standing.observed is not None or standing.iterations == 0
    seed = (arguments.seed, standing.looks)
    here = yield from look(
        arguments.geometry, way, standing.calibration, arguments.gate, seed=seed, fresh=fresh
    )
    check_prediction(prior, here.found, arguments.gate)
    there = replace(
        standing,
        looks=standing.looks + 1,
        frames=standing.frames + here.seen.frames,
        scan_s=standing.scan_s + here.seen.scan_s,
    )
    if here.seen.after_loss:
        there = replace(there, proven=False)
    return _believing(arguments, there, here, fuses=arguments.how_to_look.fuses)


def _look_longer(arguments: ApproachArguments, standing: Standing) -> ProcedureSteps[Standing]:
    """Take more slices here, if so many as are needed would make this the place to puncture."""
    before = standing.observed
    if before is None or not before.can_go_on:
        return standing
    present = before.seen.frames_of_each
    wanted = arguments.frames_wanted(standing.calibration.estimate, present)
    if wanted <= present:
        return standing
    more = yield from look_longer(before, arguments.geometry, arguments.gate, frames=wanted)
    # the slices that are in both measurements count once
    there = replace(
        standing,
        frames=standing.frames + more.seen.frames - before.seen.frames,
        scan_s=standing.scan_s + more.seen.scan_s - before.seen.scan_s,
    )
    return _believing(arguments, there, more, fuses=True)


def _believing(
    arguments: ApproachArguments, standing: Standing, here: Observation, *, fuses: bool
) -> Standing:
    """What is believed after a look: it alone, or with all that was believed before it."""
    estimate, prior = here.found, here.prior
    if arguments.common_cancels:
        estimate, prior = (replace(one, common_mm=None) for one in (estimate, prior))
    if fuses:
        estimate = prior.fused_with(estimate)
    calibration = replace(
        standing.calibration, estimate=estimate, measurement_id=here.seen.measurement_id
    )
    return replace(standing, calibration=calibration, observed=here)


def _plan(arguments: ApproachArguments, standing: Standing) -> Plan:
    calibration = standing.calibration
    try:
        plan = plan_move(
            calibration.estimate,
            np.array(arguments.target_mm),
            calibration.jacobian,
            arguments.travel,
            measurement_id=calibration.measurement_id,
            plan_id=f"{calibration.measurement_id}.{standing.iterations}",
        )
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    row, col = arguments.error_mm(calibration.estimate).tolist()
    return replace(plan, displacement_mm=(row, col), parts=arguments.parts(calibration.estimate))


def _go(
    arguments: ApproachArguments,
    standing: Standing,
    plan: Plan,
    way: Imaging,
    purpose: str = "approach",
) -> ProcedureSteps[Standing]:
    """Carry out the plan, look, and learn from the move."""
    calibration, noise = standing.calibration, arguments.gate.noise
    before = calibration.estimate if standing.observed is None else standing.observed.found
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
        observed=None,
        iterations=standing.iterations + 1,
    )
    after = yield from _look(arguments, there, way)
    if (
        standing.observed is not None
        and after.observed is not None
        and not after.observed.seen.after_loss
    ):
        followed = moved_visibly(before, after.observed.found)
        after = replace(after, proven=after.proven or followed)
    if not arguments.how_to_look.fuses or after.observed is None:
        return after
    jacobian = learn_from_move(calibration.jacobian, before, after.observed.found, noise)
    return replace(after, calibration=replace(after.calibration, jacobian=jacobian))
