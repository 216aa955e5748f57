"""Looking at one fiducial at a set of commanded shifts, as the paper does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.procedure.estimate import FiducialEstimate, MotionNoise, motion_covariance
from service.procedure.jacobian import ImageJacobian
from service.procedure.observe import (
    ML,
    Expectation,
    estimate_from,
    measure_step,
    measured_or_failed,
    move,
)
from service.procedure.plane import ImagePlane
from service.procedure.steps import (
    Acquire,
    Acquired,
    HoldShift,
    Measured,
    MoveTo,
    ProcedureSteps,
    ask,
)

Array = NDArray[np.float64]


def measure_shift_set(
    reference: FiducialEstimate,
    shifts_px: Sequence[tuple[float, float]],
    jacobian: ImageJacobian,
    plane: ImagePlane,
    method: str,
    expectation: Expectation | None,
    noise: MotionNoise,
    template: Sequence[int] = (),
) -> ProcedureSteps[tuple[Measured, FiducialEstimate]]:
    """Take one slice at each commanded shift around the reference setpoints; localize from all.

    Returns the measurement at the commanded shifts, and where the fiducial is after the way back.

    The robot is brought back to the reference at the end, as in the paper. Without encoders the
    errors of the moves in between add up, and the estimate's covariance says so.
    """
    holds: list[HoldShift] = []
    readbacks = [dict(reference.setpoints_um)]
    for place, shift_px in enumerate(shifts_px):
        setpoints_um = _shifted(reference, shift_px, jacobian, plane)
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
        shift_mm, _ = jacobian.displacement(_change_mm(moved.readback_um, reference.setpoints_um))
        holds.append(HoldShift(acquired.hold_id, (float(shift_mm[0]), float(shift_mm[1]))))
        readbacks.append(dict(moved.readback_um))
    moved = yield from move(MoveTo(dict(reference.setpoints_um), "back to the reference"))
    readbacks.append(dict(moved.readback_um))
    sigma_mm = shift_sigma_mm(noise, len(holds))
    measured = yield from measured_or_failed(
        measure_step(tuple(holds), method, expectation, shift_sigma_mm=sigma_mm, template=template)
    )
    after = estimate_from((measured,), moved.readback_um)
    spread = _way_back_covariance(readbacks, jacobian, noise)
    if method == ML:  # its covariance has the same errors in it, as if they were independent
        spread = spread - np.eye(2) * sigma_mm**2 / len(holds)
    return measured, replace(after, covariance_mm2=after.covariance_mm2 + spread)


def shift_sigma_mm(noise: MotionNoise, count: int) -> float:
    """How far a hold of a shift set may be from its shift (standard deviation, one axis).

    The errors of the moves add up, so the holds are a random walk; this is the largest standard
    deviation that any combination of `count` centred holds has.
    """
    if count < 2:
        return 0.0
    return noise.repeatability_mm / (2.0 * math.sin(math.pi / (2 * count)))


def _way_back_covariance(
    readbacks_um: Sequence[Mapping[str, int]], jacobian: ImageJacobian, noise: MotionNoise
) -> Array:
    """Covariance (2, 2) mm² of the last place minus the mean of the holds, which it refers to.

    Move j (of 0 to N) of the way has moved j of the N holds not yet, so its error counts j/N.
    """
    count = len(readbacks_um) - 2
    total = np.zeros((2, 2))
    for number in range(1, count + 1):
        change_mm = _change_mm(readbacks_um[number + 1], readbacks_um[number])
        total += (number / count) ** 2 * motion_covariance(change_mm, jacobian, noise)
    return total


def _shifted(
    reference: FiducialEstimate,
    shift_px: tuple[float, float],
    jacobian: ImageJacobian,
    plane: ImagePlane,
) -> dict[str, int]:
    wanted_mm = np.array(shift_px) * np.array(plane.spacing_mm)
    setpoints_um = dict(reference.setpoints_um)
    for axis, change_mm in jacobian.setpoint_change_mm(wanted_mm).items():
        setpoints_um[axis] += round(change_mm * 1000.0)
    return setpoints_um


def _difference(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    return {axis: a[axis] - b[axis] for axis in b if axis in a}


def _change_mm(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, float]:
    return {axis: change / 1000.0 for axis, change in _difference(a, b).items()}
