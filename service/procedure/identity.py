"""Identity by motion: what is measured is the fiducial only if it was seen to move as commanded.

A sphere of the phantom, a vial, a vitamin capsule on the skin look like the fiducial; they do not
follow the robot. Where nothing has shown that since the fiducial was last lost, since the last new
study or frame of reference, or since the last surprise, a small proof move does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate
from service.procedure.observe import (
    ProcedureFailedError,
    ValidationGate,
    ask_to_confirm,
    check_prediction,
    move,
)
from service.procedure.plan import Plan, PlanRefusedError, Travel, plan_move
from service.procedure.steps import MoveTo, ProcedureSteps
from service.procedure.strategies import Observation

# so far from standing still that chance does not do it
_SEEN_SIGMA = 6.0
_LEAST_PX, _MOST_PX = 0.4, 1.0
_DIRECTIONS = ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0))
PROOF = "proof move"


def moved_visibly(before: FiducialEstimate, after: FiducialEstimate) -> bool:
    """Whether each fiducial was seen elsewhere after a move than before it, beyond chance."""
    step_mm = after.plane_mm - before.plane_mm
    covariance = before.covariance_mm2 + after.covariance_mm2
    return all(
        float(np.sqrt(step_mm[one] @ np.linalg.solve(covariance[one, one], step_mm[one])))
        >= _SEEN_SIGMA
        for one in after.each
    )


def proof_plan(calibration: Calibration, travel: Mapping[str, Travel], plan_id: str) -> Plan:
    """Return a move by part of a pixel that shows whether what was measured follows the robot.

    Raises PlanRefusedError if no direction is left within the travel.
    """
    estimate, spacing_mm = calibration.estimate, np.array(calibration.plane.spacing_mm)
    worst_mm = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance_mm2)[-1]))
    # both ends are measured, and the second one is to be told from the first with ease
    wanted_px = 1.5 * _SEEN_SIGMA * np.sqrt(2) * worst_mm / float(spacing_mm.min())
    size_mm = float(np.clip(wanted_px, _LEAST_PX, _MOST_PX)) * spacing_mm
    refused: PlanRefusedError | None = None
    for direction in _DIRECTIONS:
        step_mm = np.tile(np.array(direction) * size_mm, len(estimate.plane_mm) // 2)
        try:
            return plan_move(
                estimate,
                estimate.plane_mm + step_mm,
                calibration.jacobian,
                travel,
                measurement_id=calibration.measurement_id,
                plan_id=plan_id,
            )
        except PlanRefusedError as error:
            refused = error
    raise refused or PlanRefusedError("no direction for a proof move")


@dataclass(frozen=True)
class ProofArguments:
    """What a proof move needs, unless what is seen is `proven` already.

    travel_um: lowest and highest setpoint of each axis.
    """

    proven: bool = True
    travel_um: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    confirm_moves: bool = True

    @property
    def travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self.travel_um.items()}


def show_that_it_follows(
    seen: Calibration,
    arguments: ProofArguments,
    gate: ValidationGate,
    name: str,
    look: Callable[[Calibration], ProcedureSteps[Observation]],
) -> ProcedureSteps[FiducialEstimate]:
    """Move by part of a pixel, look, and move back; return the estimate at the place before.

    seen: with the estimate of a look from where the robot stands. Raises ProcedureFailedError
    (`identity`) if what was seen has not moved as commanded.
    """
    try:
        plan = proof_plan(seen, arguments.travel, f"{seen.measurement_id}.proof")
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    if arguments.confirm_moves:
        yield from ask_to_confirm(f"{name}, as a proof move,", plan)
    moved = yield from move(
        MoveTo(
            dict(plan.setpoints_um),
            PROOF,
            rests_on=plan.measurement_id,
            from_um=dict(plan.from_um),
        )
    )
    predicted = seen.estimate.moved_to(moved.readback_um, seen.jacobian, gate.noise)
    there = yield from look(replace(seen, estimate=predicted))
    text = f"the object seen does not move with the robot, so it is not the {name}"
    try:
        check_prediction(predicted, there.found, gate)
    except ProcedureFailedError as error:
        raise ProcedureFailedError("identity", f"{text}: {error}") from error
    if there.seen.after_loss or not moved_visibly(seen.estimate, there.found):
        raise ProcedureFailedError("identity", text)
    back = yield from move(MoveTo(dict(plan.from_um), f"back from the {PROOF}"))
    return there.found.moved_to(back.readback_um, seen.jacobian, gate.noise)
