"""Strategies: how an approach looks at the fiducials, coarsely at first and finely at the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from service.procedure.calibration import Calibration, FoundBy
from service.procedure.estimate import FiducialEstimate
from service.procedure.fiducials import Geometry
from service.procedure.observe import ProcedureFailedError, Seen, ValidationGate, see, see_longer
from service.procedure.shift_set import measure_shift_set
from service.procedure.steps import ProcedureSteps
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
# a name stands in room_config.service.Strategy as well: a room's file is read without this package
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

    found: from this look alone; prior: what was believed before it.
    """

    seen: Seen
    found: FiducialEstimate
    prior: FiducialEstimate
    method: str
    found_by: FoundBy

    @property
    def can_go_on(self) -> bool:
        """More slices could be taken here: not after a shift set."""
        return bool(self.seen.acquired)


def look(
    geometry: Geometry,
    way: Imaging,
    calibration: Calibration,
    gate: ValidationGate,
    *,
    seed: tuple[int, int],
    fresh: bool,
) -> ProcedureSteps[Observation]:
    """Look at every fiducial in one of the ways; seed: of the shift set, with each look another."""
    prior, found_by = calibration.estimate, calibration.found_by
    expected = gate.around(prior)
    if way.shifted:
        (one,) = expected  # a shift set is of one fiducial
        measured, found = yield from measure_shift_set(
            prior,
            paper_random(np.random.default_rng(seed)).shifts_px,
            calibration.jacobian,
            calibration.plane,
            way.method,
            one,
            gate.noise,
            found_by.template_of(0),
        )
        seen = Seen((measured,))
    else:
        seen = yield from see(geometry, way.method, expected, found_by.templates, fresh=fresh)
        found = seen.at(prior.setpoints_um)
    if not seen.plane.is_parallel_to(calibration.plane):
        raise ProcedureFailedError(
            "plane_changed", "the slice orientation differs from the calibration's"
        )
    return Observation(seen, found, prior, way.method, found_by)


def look_longer(
    before: Observation, geometry: Geometry, gate: ValidationGate, *, frames: int
) -> ProcedureSteps[Observation]:
    """Look again with `frames` slices of each fiducial in all from the same holds."""
    expected, templates = gate.around(before.prior), before.found_by.templates
    seen = yield from see_longer(
        before.seen, geometry, before.method, expected, templates, frames=frames
    )
    return replace(before, seen=seen, found=seen.at(before.prior.setpoints_um))
