"""The parts of a procedure that look: slices at one place, or at a set of commanded shifts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from dicom_slice.reasons import Reason
from service.procedure.estimate import FiducialEstimate, MotionNoise, motion_covariance
from service.procedure.jacobian import ImageJacobian
from service.procedure.plan import Plan
from service.procedure.plane import ImagePlane
from service.procedure.steps import (
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
# the slices could not be used: that says nothing of the fiducial
_NOT_EVEN_LOOKED = frozenset({"no_slices", "geometry_changed", "disturbed", *map(str, Reason)})
ML, TEMPLATE = "ml", "template"
CONFIRM = "confirm"
REJECT = "reject"
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


@dataclass(frozen=True)
class ValidationGate:
    """Which measurements are believed: those near enough to what was predicted.

    position_gate_mm: how far off is near enough in any case; gate_sigma: of the prediction's and
    the measurement's uncertainty. repeatability_mm, scale_error: of the motors (MotionNoise).
    """

    position_gate_mm: float
    gate_sigma: float
    repeatability_mm: float
    scale_error: float

    @property
    def noise(self) -> MotionNoise:
        return MotionNoise(self.repeatability_mm, self.scale_error)

    def around(self, predicted: FiducialEstimate) -> Expectation:
        """Where the fiducial is looked for."""
        worst = float(np.sqrt(np.linalg.eigvalsh(predicted.covariance_mm2)[-1]))
        return Expectation(predicted.plane_mm, max(self.position_gate_mm, self.gate_sigma * worst))


def move(step: MoveTo) -> ProcedureSteps[Moved]:
    """Move; whatever keeps it from arriving ends the procedure.

    It is never asked for again: a robot that was stopped on its way stands where nobody has looked,
    so the next thing is a look, and that is how a procedure begins.
    """
    moved = yield from ask(step, Moved)
    if moved.state == "DONE":
        return moved
    if moved.state == "REFUSED":
        raise ProcedureFailedError(moved.code, f"the robot did not move: {moved.text}")
    text = (
        f"the robot was stopped during the move ({moved.text}): check where it is, then start again"
    )
    raise ProcedureFailedError(moved.code, text)


def ask_to_confirm(name: str, plan: Plan) -> ProcedureSteps[None]:
    """Wait for the operator; raises ProcedureFailedError unless the plan is confirmed."""
    row, col = plan.displacement_mm
    question = f"Move the {name} by ({row:+.3f}, {col:+.3f}) mm (row, col)?"
    answer = yield from ask(AskOperator(question, (CONFIRM, REJECT), plan.to_json()), Answered)
    if answer.choice != CONFIRM:
        raise ProcedureFailedError("rejected", f"the move was rejected by {answer.who}")


def measure_here(
    method: str,
    expectation: Expectation | None,
    *,
    fresh: bool = False,
    slice_position_mm: float | None = None,
    template: Sequence[int] = (),
    any_shape: bool = False,
) -> ProcedureSteps[tuple[Acquired, Measured]]:
    """Localize the fiducial in one slice taken where the robot stands; if it fails, scan again.

    fresh: the robot has not moved since the last measurement, which must not count twice.
    template: the measurements that show the fiducial's image, by which the maximum-likelihood fit
    then goes. any_shape: see `Measure`.
    """
    lost = False
    for attempt in range(_TRIES):
        # a new hold: the slices that could not be used stay out of the next try
        acquired = yield from ask(Acquire(1, fresh or attempt > 0, slice_position_mm), Acquired)
        holds = (HoldShift(acquired.hold_id, (0.0, 0.0)),)
        step = measure_step(
            holds, method, expectation, slice_position_mm=slice_position_mm, template=template
        )
        measured = yield from ask(replace(step, any_shape=any_shape), Measured)
        if measured.ok:
            return acquired, replace(measured, after_loss=lost)
        lost = lost or measured.reason_code not in _NOT_EVEN_LOOKED
        yield from _ask_to_rescan(measured)
    raise ProcedureFailedError(measured.reason_code, f"no usable measurement: {measured.reason}")


def _ask_to_rescan(measured: Measured) -> ProcedureSteps[None]:
    question = f"The slice could not be used: {measured.reason}. Rescan?"
    answer = yield from ask(AskOperator(question, (RESCAN, ABORT)), Answered)
    if answer.choice != RESCAN:
        raise ProcedureFailedError(
            measured.reason_code, f"no usable measurement: {measured.reason}"
        )


def measure_again(
    acquired: Acquired,
    method: str,
    expectation: Expectation | None,
    *,
    frames: int,
    slice_position_mm: float | None = None,
    template: Sequence[int] = (),
) -> ProcedureSteps[tuple[Acquired, Measured]]:
    """Take more slices at the same hold and localize from all of them."""
    more = yield from ask(Acquire(frames, slice_position_mm=slice_position_mm), Acquired)
    hold_ids = dict.fromkeys((acquired.hold_id, more.hold_id))
    holds = tuple(HoldShift(hold_id, (0.0, 0.0)) for hold_id in hold_ids)
    step = measure_step(
        holds, method, expectation, slice_position_mm=slice_position_mm, template=template
    )
    measured = yield from ask(step, Measured)
    if not measured.ok:
        raise ProcedureFailedError(measured.reason_code, measured.reason)
    return more, measured


@dataclass(frozen=True, eq=False)
class ShiftSetResult:
    """A measurement at commanded shifts, and where the fiducial is after the way back."""

    measured: Measured
    estimate: FiducialEstimate


def measure_shift_set(
    reference: FiducialEstimate,
    shifts_px: Sequence[tuple[float, float]],
    jacobian: ImageJacobian,
    plane: ImagePlane,
    method: str,
    expectation: Expectation | None,
    noise: MotionNoise,
    template: Sequence[int] = (),
) -> ProcedureSteps[ShiftSetResult]:
    """Take one slice at each commanded shift around the reference setpoints; localize from all.

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
    step = measure_step(tuple(holds), method, expectation, sigma_mm, template=template)
    measured = yield from ask(step, Measured)
    if not measured.ok:
        raise ProcedureFailedError(measured.reason_code, measured.reason)
    after = estimate_from(measured, moved.readback_um)
    spread = _way_back_covariance(readbacks, jacobian, noise)
    if method == ML:  # its covariance has the same errors in it, as if they were independent
        spread = spread - np.eye(2) * sigma_mm**2 / len(holds)
    return ShiftSetResult(measured, replace(after, covariance_mm2=after.covariance_mm2 + spread))


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


def estimate_from(measured: Measured, setpoints_um: Mapping[str, int]) -> FiducialEstimate:
    """What a measurement says by itself."""
    return FiducialEstimate(
        dict(setpoints_um), np.array(measured.plane_mm), np.array(measured.covariance_mm2)
    )


def check_prediction(
    predicted: FiducialEstimate, found: FiducialEstimate, gate: ValidationGate
) -> None:
    """Refuse to go on when a move did not do what was predicted: wrong sign, wrong scale, slip.

    The gate's sigma is in two dimensions; with more of them, what is as improbable by chance.
    """
    sigmas = predicted.distance_sigma(found.plane_mm, found.covariance_mm2)
    allowed = gate.gate_sigma
    if len(found.plane_mm) != 2:
        allowed = math.sqrt(chdtri(len(found.plane_mm), math.exp(-(gate.gate_sigma**2) / 2)))
    if not sigmas <= allowed:
        miss = found.plane_mm - predicted.plane_mm
        listed = ", ".join(f"{value:+.3f}" for value in miss)
        raise ProcedureFailedError(
            "prediction_missed",
            f"the fiducial is ({listed}) mm (row, col) from where the move should have taken it, "
            f"{sigmas:.1f} σ (allowed {allowed:.1f}, repeatability "
            f"{gate.repeatability_mm * 1000:.0f} µm): calibrate again",
        )


def measure_step(
    holds: tuple[HoldShift, ...],
    method: str,
    expectation: Expectation | None,
    shift_sigma_mm: float = 0.0,
    slice_position_mm: float | None = None,
    template: Sequence[int] = (),
) -> Measure:
    """The maximum-likelihood fit is that of the template where there is one; see `Measure`."""
    if method != ML:
        template = ()
    step = Measure(
        holds,
        TEMPLATE if template else method,
        shift_sigma_mm=shift_sigma_mm,
        slice_position_mm=slice_position_mm,
        template=tuple(template),
    )
    if expectation is None:
        return step
    row, col = expectation.plane_mm.tolist()
    return replace(step, expected_plane_mm=(row, col), gate_mm=expectation.gate_mm)


def _difference(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    return {axis: a[axis] - b[axis] for axis in b if axis in a}


def _change_mm(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, float]:
    return {axis: change / 1000.0 for axis, change in _difference(a, b).items()}
