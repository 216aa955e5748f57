"""The parts of a procedure that move, ask and look: what it does, and which answers it believes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri

from dicom_slice.reasons import Reason
from service.procedure.estimate import FiducialEstimate, MotionNoise
from service.procedure.fiducials import (
    Geometry,
    GuideSeenWrongError,
    NeedleSeen,
    needle_seen,
)
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
    SeenBefore,
    ask,
)

Array = NDArray[np.float64]
Templates = tuple[tuple[int, ...], ...]
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

    def around(self, predicted: FiducialEstimate) -> tuple[Expectation, ...]:
        """Where each fiducial is looked for."""
        return tuple(
            self._around(predicted.plane_mm[one], predicted.covariance_mm2[one, one])
            for one in predicted.each
        )

    def _around(self, plane_mm: Array, covariance_mm2: Array) -> Expectation:
        worst = float(np.sqrt(np.linalg.eigvalsh(covariance_mm2)[-1]))
        return Expectation(plane_mm, max(self.position_gate_mm, self.gate_sigma * worst))


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


@dataclass(frozen=True, eq=False)
class Seen:
    """Every fiducial as one look found it, each in a slice of its own.

    acquired: the holds at which more slices could be taken; none after a shift set.
    """

    measured: tuple[Measured, ...]
    acquired: tuple[Acquired, ...] = ()

    @property
    def frames(self) -> int:
        """Slices of all together."""
        return sum(one.frames for one in self.measured)

    @property
    def frames_of_each(self) -> int:
        return self.measured[0].frames

    @property
    def scan_s(self) -> float:
        return sum(one.scan_s for one in self.measured)

    @property
    def measurement_id(self) -> int:
        return max(one.measurement_id for one in self.measured)

    @property
    def after_loss(self) -> bool:
        """At first one of them was not found."""
        return any(one.after_loss for one in self.measured)

    @property
    def plane(self) -> ImagePlane:
        return ImagePlane.from_json(self.measured[0].plane)

    def at(self, setpoints_um: Mapping[str, int]) -> FiducialEstimate:
        """What it says by itself; the slices have nothing in common."""
        return estimate_from(self.measured, setpoints_um)


def see(
    geometry: Geometry,
    method: str,
    expected: Sequence[Expectation | None],
    templates: Templates = (),
    *,
    fresh: bool = False,
    any_shape: bool = False,
) -> ProcedureSteps[Seen]:
    """Localize every fiducial in one slice taken where the robot stands; if it fails, scan again.

    fresh: the robot has not moved since the last measurement, which must not count twice.
    templates: of each fiducial the measurements that show its image, by which the
    maximum-likelihood fit then goes. any_shape: see `Measure`.
    """
    acquired: list[Acquired] = []
    measured = []
    for look in _looks(geometry, method, expected, templates, any_shape=any_shape):
        hold, one = yield from _measure_here(look, fresh=fresh and not acquired)
        acquired.append(hold)
        measured.append(one)
    seen = Seen(tuple(measured), tuple(acquired))
    if not all(ImagePlane.from_json(one.plane).is_parallel_to(seen.plane) for one in measured):
        raise ProcedureFailedError(
            "plane_changed", f"the slices of the {len(measured)} fiducials are not parallel"
        )
    return seen


def see_longer(
    seen: Seen,
    geometry: Geometry,
    method: str,
    expected: Sequence[Expectation | None],
    templates: Templates = (),
    *,
    frames: int,
) -> ProcedureSteps[Seen]:
    """Localize again with `frames` slices of each fiducial in all from the same holds."""
    acquired, measured = [], []
    looks = _looks(geometry, method, expected, templates)
    for hold, look in zip(seen.acquired, looks, strict=True):
        more = yield from ask(Acquire(frames, slice_position_mm=look.slice_position_mm), Acquired)
        acquired.append(more)
        measured.append((yield from measured_or_failed(_of_holds(look, hold, more))))
    return Seen(tuple(measured), tuple(acquired))


def see_again(
    seen: Seen,
    geometry: Geometry,
    method: str,
    expected: Sequence[Expectation | None],
    templates: Templates,
) -> ProcedureSteps[tuple[Measured, ...]]:
    """Localize anew from the slices that were seen; what was not found is among the answers."""
    measured = []
    looks = _looks(geometry, method, expected, templates)
    for hold, look in zip(seen.acquired, looks, strict=True):
        measured.append((yield from ask(_of_holds(look, hold), Measured)))
    return tuple(measured)


def _looks(
    geometry: Geometry,
    method: str,
    expected: Sequence[Expectation | None],
    templates: Templates,
    *,
    any_shape: bool = False,
) -> list[Measure]:
    """How each fiducial is measured, still without holds."""
    each = zip(
        geometry.slice_positions_mm,
        expected,
        templates or ((),) * len(expected),
        strict=True,
    )
    return [
        measure_step((), method, at, slice_position_mm=mm, template=template, any_shape=any_shape)
        for mm, at, template in each
    ]


def _of_holds(look: Measure, *holds: Acquired) -> Measure:
    hold_ids = dict.fromkeys(hold.hold_id for hold in holds)
    return replace(look, holds=tuple(HoldShift(hold_id, (0.0, 0.0)) for hold_id in hold_ids))


def _measure_here(look: Measure, *, fresh: bool) -> ProcedureSteps[tuple[Acquired, Measured]]:
    lost = False
    for attempt in range(_TRIES):
        # a new hold: the slices that could not be used stay out of the next try
        step = Acquire(1, fresh or attempt > 0, look.slice_position_mm)
        acquired = yield from ask(step, Acquired)
        measured = yield from ask(_of_holds(look, acquired), Measured)
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


def measured_or_failed(step: Measure) -> ProcedureSteps[Measured]:
    """Measure; raises ProcedureFailedError where that finds nothing."""
    measured = yield from ask(step, Measured)
    if not measured.ok:
        raise ProcedureFailedError(measured.reason_code, measured.reason)
    return measured


def estimate_from(
    measured: Sequence[Measured | SeenBefore], setpoints_um: Mapping[str, int]
) -> FiducialEstimate:
    """What measurements of each fiducial say by themselves."""
    common_mm = np.ravel([getattr(one, "common_mm", (0.0, 0.0)) for one in measured])
    return FiducialEstimate(
        dict(setpoints_um),
        np.concatenate([one.plane_mm for one in measured]),
        block_diag(*(one.covariance_mm2 for one in measured)),
        common_mm if np.any(common_mm) else None,
    )


def see_needle(
    geometry: Geometry, estimate: FiducialEstimate, plane: ImagePlane, lower_plane_mm: float
) -> NeedleSeen | None:
    """Where the needle goes by the guide as it is seen; ProcedureFailedError if that cannot be."""
    try:
        return needle_seen(geometry, estimate, plane, lower_plane_mm)
    except GuideSeenWrongError as wrong:
        raise ProcedureFailedError("guide", str(wrong)) from wrong


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
    *,
    shift_sigma_mm: float = 0.0,
    slice_position_mm: float | None = None,
    template: Sequence[int] = (),
    any_shape: bool = False,
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
        any_shape=any_shape,
    )
    if expectation is None:
        return step
    row, col = expectation.plane_mm.tolist()
    return replace(step, expected_plane_mm=(row, col), gate_mm=expectation.gate_mm)
