"""Strategies: how an approach looks at the fiducial, coarsely at first and finely at the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate
from service.procedure.observe import (
    ProcedureFailedError,
    ValidationGate,
    estimate_from,
    measure_again,
    measure_here,
    measure_shift_set,
)
from service.procedure.plane import ImagePlane
from service.procedure.steps import Acquired, Measured, ProcedureSteps
from sr_engine.reconstruction.shiftset import paper_random


@dataclass(frozen=True)
class Imaging:
    """One way to look: the engine's method, the paper's random shift set or one place, and how
    many pixels of the image looked at make one of the slice's (along an axis)."""

    method: str
    shifted: bool = False
    factor: int = 1


@dataclass(frozen=True)
class Strategy:
    """fuses: measurements and moves are combined, else the last look alone is believed."""

    coarse: Imaging
    fine: Imaging
    fuses: bool = False


_ML, _BASE = Imaging("ml"), Imaging("base")
_BICUBIC, _SR = Imaging("bicubic", factor=2), Imaging("sr", shifted=True, factor=2)
STRATEGIES: Mapping[str, Strategy] = MappingProxyType(
    {
        "base": Strategy(_BASE, _BASE),
        "bicubic": Strategy(_BICUBIC, _BICUBIC),
        "sr": Strategy(_SR, _SR),
        "hybrid": Strategy(_BASE, _SR),
        "adaptive": Strategy(_ML, _ML, fuses=True),
    }
)


@dataclass(frozen=True, eq=False)
class Observation:
    """What was seen from where the robot stands now.

    found: from this look alone; prior: what was believed before it; acquired: the hold at which
    more slices could be taken, None after a shift set.
    """

    measured: Measured
    found: FiducialEstimate
    prior: FiducialEstimate
    method: str
    acquired: Acquired | None
    template: tuple[int, ...] = ()

    @property
    def measurement_id(self) -> int:
        return self.measured.measurement_id

    @property
    def frames(self) -> int:
        return self.measured.frames

    @property
    def after_loss(self) -> bool:
        return self.measured.after_loss

    @property
    def scan_s(self) -> float:
        return self.measured.scan_s


def look_at_fiducial(
    way: Imaging,
    calibration: Calibration,
    gate: ValidationGate,
    *,
    seed: tuple[int, int],
    fresh: bool,
) -> ProcedureSteps[Observation]:
    """Observation in one of the ways; seed: of the shift set, with each look another one."""
    prior = calibration.estimate
    expectation = gate.around(prior)
    if not way.shifted:
        template = calibration.template_of()
        acquired, measured = yield from measure_here(
            way.method, expectation, fresh=fresh, template=template
        )
        _check_plane(measured, calibration.plane)
        found = estimate_from(measured, prior.setpoints_um)
        return Observation(measured, found, prior, way.method, acquired, template)
    shifts_px = paper_random(np.random.default_rng(seed)).shifts_px
    result = yield from measure_shift_set(
        prior,
        shifts_px,
        calibration.jacobian,
        calibration.plane,
        way.method,
        expectation,
        gate.noise,
        calibration.template_of(),
    )
    _check_plane(result.measured, calibration.plane)
    return Observation(result.measured, result.estimate, prior, way.method, None)


def look_longer(
    seen: Observation, acquired: Acquired, gate: ValidationGate, *, frames: int
) -> ProcedureSteps[Observation]:
    """Observation again with `frames` slices in all from the same hold."""
    expectation = gate.around(seen.prior)
    more, measured = yield from measure_again(
        acquired, seen.method, expectation, frames=frames, template=seen.template
    )
    found = estimate_from(measured, seen.prior.setpoints_um)
    return replace(seen, measured=measured, found=found, acquired=more)


def _check_plane(measured: Measured, plane: ImagePlane) -> None:
    if not ImagePlane.from_json(measured.plane).is_parallel_to(plane):
        raise ProcedureFailedError(
            "plane_changed", "the slice orientation differs from the calibration's"
        )
