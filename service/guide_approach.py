"""Approach with four axes: bring the guide onto a line, until the needle's tip is at its target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.approach import LOOSE_MM, ask_to_confirm
from service.calibration import Calibration, learn_from_move
from service.estimate import FiducialEstimate, probability_within
from service.guide_geometry import GuideGeometry, GuideSeenWrongError, line_of_state, tip_of
from service.guide_looking import BothSeen, gates, see_both, see_longer
from service.plan import Plan, PlanRefusedError, Travel, plan_move
from service.sensing import ProcedureFailedError, ValidationGate, check_prediction, move
from service.steps import MoveTo, ProcedureSteps

Array = NDArray[np.float64]
_MOST_FRAMES = 6


@dataclass(frozen=True)
class GuideApproachArguments:
    """target_mm: (4,) wanted state. tolerance_mm is at the tip.

    lower_plane_mm: of the lower ball joints along the slice normal.
    """

    geometry: GuideGeometry
    lower_plane_mm: float
    target_mm: tuple[float, float, float, float]
    travel_um: Mapping[str, tuple[int, int]]
    tolerance_mm: float
    confidence: float
    max_iterations: int
    confirm_moves: bool
    gate: ValidationGate


@dataclass(frozen=True, eq=False)
class GuideArrival:
    """READY: the tip's error (2,) and covariance (2, 2) in the image plane, and the needle's line.

    tip_mm, joint_mm: of the tip and of the lower ball joint, patient mm (LPS), as measured.
    """

    calibration: Calibration
    tip_error_mm: Array
    tip_covariance_mm2: Array
    tip_below_joint_mm: float
    tip_mm: Array
    joint_mm: Array
    probability: float
    iterations: int
    frames: int
    scan_s: float

    def to_json(self) -> dict[str, Any]:
        arrays = {
            name: getattr(self, name).tolist()
            for name in ("tip_error_mm", "tip_covariance_mm2", "tip_mm", "joint_mm")
        }
        plain = {
            name: getattr(self, name)
            for name in ("tip_below_joint_mm", "probability", "iterations", "frames", "scan_s")
        }
        return {
            **arrays,
            **plain,
            "calibration": self.calibration.to_json(),
            "error_mm": float(np.linalg.norm(self.tip_error_mm)),
            "sigma_mm": float(np.sqrt(np.trace(self.tip_covariance_mm2) / 2)),
            "measurement_id": self.calibration.measurement_id,
        }


@dataclass(frozen=True, eq=False)
class _Standing:
    """Where an approach stands; seen and prior: the last look, if nothing has moved since."""

    calibration: Calibration
    prior: FiducialEstimate
    seen: BothSeen | None = None
    frames: int = 0
    scan_s: float = 0.0
    iterations: int = 0


def approach_guide(
    arguments: GuideApproachArguments, start: Calibration
) -> ProcedureSteps[GuideArrival]:
    """Bring the guide onto the wanted line; ProcedureFailedError when that does not succeed."""
    standing = _Standing(start, start.estimate)
    if _is_loose(arguments, start.estimate):
        standing = yield from _look(arguments, standing, fresh=True)
    while True:
        standing = yield from _more_frames(arguments, standing)
        if _probability(arguments, standing.calibration.estimate) >= arguments.confidence:
            if standing.seen is not None:
                return _arrival(arguments, standing)
            # never READY on a prediction
            standing = yield from _look(arguments, standing, fresh=True)
            continue
        if standing.iterations == arguments.max_iterations:
            raise _not_converged(arguments, standing.calibration.estimate)
        plan = _plan(arguments, standing)
        if arguments.confirm_moves:
            row, col = plan.displacement_mm
            yield from ask_to_confirm(
                f"Move the needle's tip by ({row:+.3f}, {col:+.3f}) mm (row, col)?", plan
            )
        standing = yield from _go(arguments, standing, plan)


def _look(
    arguments: GuideApproachArguments, standing: _Standing, *, fresh: bool
) -> ProcedureSteps[_Standing]:
    """Look from where the robot stands; what was predicted must be what is seen."""
    prior = standing.calibration.estimate
    expected = gates(prior, arguments.gate)
    seen = yield from see_both(arguments.geometry, expected, fresh=fresh)
    here = seen.at(prior.setpoints_um)
    check_prediction(prior, here, arguments.gate)
    return _with_look(standing, prior, seen, seen.frames, seen.scan_s)


def _with_look(
    standing: _Standing, prior: FiducialEstimate, seen: BothSeen, frames: int, scan_s: float
) -> _Standing:
    """What is believed after a look; frames and scan_s: what it cost."""
    here = seen.at(prior.setpoints_um)
    calibration = replace(
        standing.calibration,
        estimate=prior.fused_with(here.plane_mm, here.covariance_mm2),
        measurement_id=seen.measurement_id,
    )
    return replace(
        standing,
        calibration=calibration,
        prior=prior,
        seen=seen,
        frames=standing.frames + frames,
        scan_s=standing.scan_s + scan_s,
    )


def _more_frames(
    arguments: GuideApproachArguments, standing: _Standing
) -> ProcedureSteps[_Standing]:
    """Take more slices here, if so many as are needed would make this the place to puncture."""
    seen, prior = standing.seen, standing.prior
    if seen is None:
        return standing
    wanted = _frames_that_decide(arguments, standing.calibration.estimate, seen)
    if wanted <= seen.measured[0].frames:
        return standing
    expected = gates(prior, arguments.gate)
    more = yield from see_longer(arguments.geometry, seen, expected, wanted)
    # from the prior again: the slices that are in both measurements count once
    return _with_look(standing, prior, more, more.frames - seen.frames, more.scan_s - seen.scan_s)


def _frames_that_decide(
    arguments: GuideApproachArguments, estimate: FiducialEstimate, seen: BothSeen
) -> int:
    """Slices of each fiducial that would be enough to say READY, or the present number."""
    present = seen.measured[0].frames
    for frames in range(present, _MOST_FRAMES + 1):
        fewer = replace(estimate, covariance_mm2=estimate.covariance_mm2 * (present / frames))
        if _probability(arguments, fewer) >= arguments.confidence:
            return frames
    return present


def _go(
    arguments: GuideApproachArguments, standing: _Standing, plan: Plan
) -> ProcedureSteps[_Standing]:
    """Carry out the plan, look, and learn from the move."""
    calibration = standing.calibration
    before = calibration.estimate
    if standing.seen is not None:
        before = standing.seen.at(standing.prior.setpoints_um)
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
    after = yield from _look(arguments, there, fresh=False)
    assert after.seen is not None
    here = after.seen.at(moved.readback_um)
    jacobian = learn_from_move(calibration.jacobian, before, here, arguments.gate.noise)
    return replace(after, calibration=replace(after.calibration, jacobian=jacobian))


def _is_loose(arguments: GuideApproachArguments, estimate: FiducialEstimate) -> bool:
    """True if the start is known so badly that a plan from it would be a guess."""
    worst_mm = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance_mm2)[-1]))
    return worst_mm > max(LOOSE_MM, arguments.tolerance_mm)


def _plan(arguments: GuideApproachArguments, standing: _Standing) -> Plan:
    """The move that brings the state to the target; its displacement is the tip's."""
    calibration = standing.calibration
    travel = {axis: Travel(low, high) for axis, (low, high) in arguments.travel_um.items()}
    try:
        plan = plan_move(
            calibration.estimate,
            np.array(arguments.target_mm),
            calibration.jacobian,
            travel,
            measurement_id=calibration.measurement_id,
            plan_id=f"{calibration.measurement_id}.{standing.iterations}",
        )
    except PlanRefusedError as error:
        raise ProcedureFailedError("target_out_of_reach", str(error)) from error
    row, col = _tip_error(arguments, calibration.estimate)[0].tolist()
    return replace(plan, displacement_mm=(row, col))


def _tip_error(
    arguments: GuideApproachArguments, estimate: FiducialEstimate
) -> tuple[Array, Array]:
    tip_mm, covariance = tip_of(arguments.geometry, estimate)
    wanted = arguments.geometry.tip_from_fiducials @ np.array(arguments.target_mm)
    return wanted - tip_mm, covariance


def _probability(arguments: GuideApproachArguments, estimate: FiducialEstimate) -> float:
    """That the tip is within the tolerance, and the lower fiducial as well: the smaller of both."""
    error, covariance = _tip_error(arguments, estimate)
    at_tip = probability_within(error, covariance, arguments.tolerance_mm)
    lower = np.array(arguments.target_mm)[2:] - estimate.plane_mm[2:]
    at_guide = probability_within(lower, estimate.covariance_mm2[2:, 2:], arguments.tolerance_mm)
    return min(at_tip, at_guide)


def _not_converged(
    arguments: GuideApproachArguments, estimate: FiducialEstimate
) -> ProcedureFailedError:
    error, _ = _tip_error(arguments, estimate)
    return ProcedureFailedError(
        "not_converged",
        f"the target was not reached in {arguments.max_iterations} moves: the error of the tip is "
        f"{np.linalg.norm(error):.3f} mm",
    )


def _arrival(arguments: GuideApproachArguments, standing: _Standing) -> GuideArrival:
    calibration, geometry = standing.calibration, arguments.geometry
    error, covariance = _tip_error(arguments, calibration.estimate)
    try:
        line = line_of_state(
            geometry, calibration.estimate.plane_mm, calibration.plane, arguments.lower_plane_mm
        )
    except GuideSeenWrongError as wrong:
        raise ProcedureFailedError("guide", str(wrong)) from wrong
    return GuideArrival(
        calibration,
        error,
        covariance,
        geometry.tip_beyond_mm,
        line.at(-geometry.tip_beyond_mm),
        line.point_mm,
        _probability(arguments, calibration.estimate),
        standing.iterations,
        standing.frames,
        standing.scan_s,
    )
