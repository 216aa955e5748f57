"""Looking at both fiducials of the guide: a slice of each, at one hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from service.procedure.estimate import FiducialEstimate
from service.procedure.guide_geometry import GuideGeometry
from service.procedure.plane import ImagePlane
from service.procedure.sensing import (
    Expectation,
    ProcedureFailedError,
    ValidationGate,
    measure_again,
    measure_here,
)
from service.procedure.steps import Acquired, Measured, ProcedureSteps

Expectations = tuple[Expectation | None, Expectation | None]
_METHOD = "ml"


@dataclass(frozen=True, eq=False)
class BothSeen:
    """Both fiducials at one hold, the upper one first."""

    acquired: tuple[Acquired, Acquired]
    measured: tuple[Measured, Measured]

    @property
    def frames(self) -> int:
        """Slices of both together."""
        return sum(one.frames for one in self.measured)

    @property
    def scan_s(self) -> float:
        return sum(one.scan_s for one in self.measured)

    @property
    def measurement_id(self) -> int:
        return max(one.measurement_id for one in self.measured)

    @property
    def plane(self) -> ImagePlane:
        return ImagePlane.from_json(self.measured[0].plane)

    def at(self, setpoints_um: Mapping[str, int]) -> FiducialEstimate:
        """The state (4,) with its covariance: the two slices have nothing in common."""
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = self.measured[0].covariance_mm2
        covariance[2:, 2:] = self.measured[1].covariance_mm2
        state = np.array([value for one in self.measured for value in one.plane_mm])
        return FiducialEstimate(dict(setpoints_um), state, covariance)


@dataclass(frozen=True, eq=False)
class GuideLook:
    """What was seen from where the robot stands now.

    found: from this look alone; prior: what was believed before it.
    """

    seen: BothSeen
    found: FiducialEstimate
    prior: FiducialEstimate

    @property
    def measurement_id(self) -> int:
        return self.seen.measurement_id

    @property
    def frames(self) -> int:
        """Slices of both together."""
        return self.seen.frames

    @property
    def after_loss(self) -> bool:
        return any(one.after_loss for one in self.seen.measured)

    @property
    def frames_of_each(self) -> int:
        return self.seen.measured[0].frames

    @property
    def scan_s(self) -> float:
        return self.seen.scan_s


def see_both(
    geometry: GuideGeometry, expected: Expectations, *, fresh: bool = False
) -> ProcedureSteps[BothSeen]:
    """One slice of each fiducial, the upper one's first."""
    upper_mm, lower_mm = geometry.slice_positions_mm
    first, upper = yield from measure_here(
        _METHOD, expected[0], fresh=fresh, slice_position_mm=upper_mm
    )
    second, lower = yield from measure_here(_METHOD, expected[1], slice_position_mm=lower_mm)
    seen = BothSeen((first, second), (upper, lower))
    if not seen.plane.is_parallel_to(ImagePlane.from_json(lower.plane)):
        raise ProcedureFailedError(
            "plane_changed", "the slices of the two fiducials are not parallel"
        )
    return seen


def look_at_guide(
    geometry: GuideGeometry, prior: FiducialEstimate, gate: ValidationGate, *, fresh: bool
) -> ProcedureSteps[GuideLook]:
    """Look where both fiducials are believed to be."""
    seen = yield from see_both(geometry, gates(prior, gate), fresh=fresh)
    return GuideLook(seen, seen.at(prior.setpoints_um), prior)


def look_at_guide_longer(
    geometry: GuideGeometry, look: GuideLook, gate: ValidationGate, *, frames: int
) -> ProcedureSteps[GuideLook]:
    """Look again with `frames` slices of each in all from the same hold."""
    again = []
    places = zip(
        look.seen.acquired, gates(look.prior, gate), geometry.slice_positions_mm, strict=True
    )
    for acquired, expected, at_mm in places:
        one = yield from measure_again(
            acquired, _METHOD, expected, frames=frames, slice_position_mm=at_mm
        )
        again.append(one)
    (first, upper), (second, lower) = again
    seen = BothSeen((first, second), (upper, lower))
    return GuideLook(seen, seen.at(look.prior.setpoints_um), look.prior)


def gates(predicted: FiducialEstimate, gate: ValidationGate) -> Expectations:
    """Where each of the two must be, from a prediction of the state."""
    upper, lower = (
        FiducialEstimate(
            predicted.setpoints_um, predicted.plane_mm[part], predicted.covariance_mm2[part, part]
        )
        for part in (slice(0, 2), slice(2, 4))
    )
    return gate.around(upper), gate.around(lower)
