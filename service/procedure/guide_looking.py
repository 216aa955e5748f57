"""Looking at both fiducials of the guide: a slice of each, at one hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from service.procedure.calibration import BY_DISC, Calibration, FoundBy
from service.procedure.estimate import FiducialEstimate
from service.procedure.guide_geometry import GuideGeometry
from service.procedure.observe import (
    ML,
    Expectation,
    ProcedureFailedError,
    ValidationGate,
    measure_again,
    measure_here,
)
from service.procedure.plane import ImagePlane
from service.procedure.steps import Acquired, Measured, ProcedureSteps

Expectations = tuple[Expectation | None, Expectation | None]


@dataclass(frozen=True, eq=False)
class BothSeen:
    """Both fiducials at one hold, the upper one first."""

    acquired: tuple[Acquired, Acquired]
    measured: tuple[Measured, Measured]

    @property
    def all_measured(self) -> tuple[Measured, ...]:
        return self.measured

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
    found_by: FoundBy

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
    geometry: GuideGeometry,
    expected: Expectations,
    found_by: FoundBy = BY_DISC,
    *,
    fresh: bool = False,
    any_shape: bool = False,
) -> ProcedureSteps[BothSeen]:
    """One slice of each fiducial, the upper one's first."""
    upper_mm, lower_mm = geometry.slice_positions_mm
    first, upper = yield from measure_here(
        ML,
        expected[0],
        fresh=fresh,
        slice_position_mm=upper_mm,
        template=found_by.template_of(0),
        any_shape=any_shape,
    )
    second, lower = yield from measure_here(
        ML,
        expected[1],
        slice_position_mm=lower_mm,
        template=found_by.template_of(1),
        any_shape=any_shape,
    )
    seen = BothSeen((first, second), (upper, lower))
    if not seen.plane.is_parallel_to(ImagePlane.from_json(lower.plane)):
        raise ProcedureFailedError(
            "plane_changed", "the slices of the two fiducials are not parallel"
        )
    return seen


def look_at_guide(
    geometry: GuideGeometry, start: Calibration, gate: ValidationGate, *, fresh: bool
) -> ProcedureSteps[GuideLook]:
    """Look where both fiducials are believed to be."""
    prior, found_by = start.estimate, start.found_by
    seen = yield from see_both(geometry, gates(prior, gate), found_by, fresh=fresh)
    return GuideLook(seen, seen.at(prior.setpoints_um), prior, found_by)


def look_at_guide_longer(
    geometry: GuideGeometry, look: GuideLook, gate: ValidationGate, *, frames: int
) -> ProcedureSteps[GuideLook]:
    """Look again with `frames` slices of each in all from the same hold."""
    again = []
    places = zip(
        look.seen.acquired, gates(look.prior, gate), geometry.slice_positions_mm, strict=True
    )
    for number, (acquired, expected, at_mm) in enumerate(places):
        one = yield from measure_again(
            acquired,
            ML,
            expected,
            frames=frames,
            slice_position_mm=at_mm,
            template=look.found_by.template_of(number),
        )
        again.append(one)
    (first, upper), (second, lower) = again
    seen = BothSeen((first, second), (upper, lower))
    return replace(look, seen=seen, found=seen.at(look.prior.setpoints_um))


def gates(predicted: FiducialEstimate, gate: ValidationGate) -> Expectations:
    """Where each of the two must be, from a prediction of the state."""
    upper, lower = (
        FiducialEstimate(
            predicted.setpoints_um, predicted.plane_mm[part], predicted.covariance_mm2[part, part]
        )
        for part in (slice(0, 2), slice(2, 4))
    )
    return gate.around(upper), gate.around(lower)
