"""The parts of a procedure that look: slices at one place, or at a set of commanded shifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.estimate import FiducialEstimate, MotionNoise
from service.jacobian import ImageJacobian
from service.plane import ImagePlane
from service.steps import (
    Acquire,
    Acquired,
    Answered,
    AskOperator,
    HoldShift,
    Measure,
    Measured,
    Moved,
    MoveTo,
    ProcedureSteps,
    ask,
)

Array = NDArray[np.float64]
_TRIES = 3
RESCAN = "rescan"
ABORT = "abort"


class ProcedureFailedError(Exception):
    """The procedure cannot reach its end; the text is for the operator. The robot stands still."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True)
class Expectation:
    """Where the fiducial must be (image plane mm), and how far from there it is still believed."""

    plane_mm: Array
    gate_mm: float

    @classmethod
    def of(cls, estimate: FiducialEstimate, least_gate_mm: float, sigmas: float) -> Expectation:
        worst = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance_mm2)[-1]))
        return cls(estimate.plane_mm, max(least_gate_mm, sigmas * worst))


def move(step: MoveTo) -> ProcedureSteps[Moved]:
    """Move; a motion that was stopped on its way (link lost, restart) is asked for again, once.

    The setpoints are absolute, so asking again cannot overshoot. A refusal ends the procedure.
    """
    for _ in range(2):
        moved = yield from ask(step, Moved)
        if moved.state == "DONE":
            return moved
        if moved.state == "REFUSED":
            break
    raise ProcedureFailedError(moved.code, f"the robot did not move: {moved.text}")


def measure_here(
    setpoints_um: Mapping[str, int],
    method: str,
    expectation: Expectation | None,
    *,
    frames: int = 1,
) -> ProcedureSteps[tuple[Acquired, Measured]]:
    """Localize the fiducial where the robot stands; on failure stand anew and scan again."""
    for attempt in range(_TRIES):
        if attempt:
            # a new hold: the slices that could not be used stay out of the next try
            yield from move(MoveTo(dict(setpoints_um), "rescan"))
        acquired = yield from ask(Acquire(frames), Acquired)
        measured = yield from ask(
            _measure_step((HoldShift(acquired.hold_id, (0.0, 0.0)),), method, expectation), Measured
        )
        if measured.ok:
            return acquired, measured
        question = f"The slice could not be used: {measured.reason}. Rescan?"
        answer = yield from ask(AskOperator(question, (RESCAN, ABORT)), Answered)
        if answer.choice != RESCAN:
            break
    raise ProcedureFailedError(measured.reason_code, f"no usable measurement: {measured.reason}")


def measure_again(
    acquired: Acquired, method: str, expectation: Expectation | None, *, frames: int
) -> ProcedureSteps[tuple[Acquired, Measured]]:
    """Take more slices at the same hold and localize from all of them."""
    more = yield from ask(Acquire(frames), Acquired)
    hold_ids = dict.fromkeys((acquired.hold_id, more.hold_id))
    holds = tuple(HoldShift(hold_id, (0.0, 0.0)) for hold_id in hold_ids)
    measured = yield from ask(_measure_step(holds, method, expectation), Measured)
    if not measured.ok:
        raise ProcedureFailedError(measured.reason_code, measured.reason)
    return more, measured


def measure_shift_set(
    reference: FiducialEstimate,
    shifts_px: Sequence[tuple[float, float]],
    jacobian: ImageJacobian,
    plane: ImagePlane,
    method: str,
    expectation: Expectation | None,
) -> ProcedureSteps[Measured]:
    """Take one slice at each commanded shift around the reference setpoints; localize from all.

    The measurement's position is the one at the reference setpoints. The robot is brought back
    there at the end, as in the paper.
    """
    holds: list[HoldShift] = []
    for place, shift_px in enumerate(shifts_px):
        wanted_mm = np.array(shift_px) * np.array(plane.spacing_mm)
        setpoints_um = dict(reference.setpoints_um)
        for axis, change_mm in jacobian.setpoint_change_mm(wanted_mm).items():
            setpoints_um[axis] += round(change_mm * 1000.0)
        moved = yield from move(
            MoveTo(
                setpoints_um,
                "commanded shift",
                new_set=place == 0,
                place=place,
                shift_px=shift_px,
                shift_um=_difference(setpoints_um, reference.setpoints_um),
            )
        )
        acquired = yield from ask(Acquire(1), Acquired)
        real_mm, _ = jacobian.displacement(
            {
                axis: change / 1000.0
                for axis, change in _difference(moved.readback_um, reference.setpoints_um).items()
            }
        )
        holds.append(HoldShift(acquired.hold_id, (float(real_mm[0]), float(real_mm[1]))))
    yield from move(MoveTo(dict(reference.setpoints_um), "back to the reference"))
    measured = yield from ask(_measure_step(tuple(holds), method, expectation), Measured)
    if not measured.ok:
        raise ProcedureFailedError(measured.reason_code, measured.reason)
    return measured


def estimate_from(measured: Measured, setpoints_um: Mapping[str, int]) -> FiducialEstimate:
    """What a measurement says by itself."""
    return FiducialEstimate(
        dict(setpoints_um), np.array(measured.plane_mm), np.array(measured.covariance_mm2)
    )


def check_prediction(
    predicted: FiducialEstimate, measured: Measured, gate_sigma: float, noise: MotionNoise
) -> None:
    """Refuse to go on when a move did not do what was predicted: wrong sign, wrong scale, slip."""
    at_mm, covariance = np.array(measured.plane_mm), np.array(measured.covariance_mm2)
    sigmas = predicted.distance_sigma(at_mm, covariance)
    if not sigmas <= gate_sigma:
        miss = at_mm - predicted.plane_mm
        raise ProcedureFailedError(
            "prediction_missed",
            f"the fiducial is ({miss[0]:+.3f}, {miss[1]:+.3f}) mm (row, col) from where the move "
            f"should have brought it, {sigmas:.1f} σ (allowed {gate_sigma:.1f}, repeatability "
            f"{noise.repeatability_mm * 1000:.0f} µm): calibrate again",
        )


def _measure_step(
    holds: tuple[HoldShift, ...], method: str, expectation: Expectation | None
) -> Measure:
    if expectation is None:
        return Measure(holds, method)
    row, col = expectation.plane_mm.tolist()
    return Measure(holds, method, (row, col), expectation.gate_mm)


def _difference(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    return {axis: a[axis] - b[axis] for axis in b if axis in a}
