"""Approach with four axes: bring the guide onto a line, until the needle's tip is at its target.

It looks as the `adaptive` strategy does, at both fiducials of the guide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate, axis_sigma, probability_within
from service.procedure.guide_geometry import (
    GuideGeometry,
    GuideSeenWrongError,
    line_of_state,
    tip_of,
)
from service.procedure.guide_looking import GuideLook, look_at_guide, look_at_guide_longer
from service.procedure.observe import ProcedureFailedError
from service.procedure.plan import PlanPart
from service.procedure.steering import Standing, SteeringArguments, frames_that_decide, steer
from service.procedure.steps import ProcedureSteps
from service.procedure.strategies import STRATEGIES, Imaging, Strategy

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class GuideApproachArguments(SteeringArguments):
    """target_mm: (4,) wanted state. tolerance_mm is at the tip.

    lower_plane_mm: of the lower ball joints along the slice normal.
    """

    geometry: GuideGeometry
    lower_plane_mm: float


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
            "sigma_mm": axis_sigma(self.tip_covariance_mm2),
            "measurement_id": self.calibration.measurement_id,
        }


def approach_guide(
    arguments: GuideApproachArguments, start: Calibration
) -> ProcedureSteps[GuideArrival]:
    """Bring the guide onto the wanted line; ProcedureFailedError when that does not succeed."""
    guide = SteeredGuide(arguments)
    standing = yield from steer(guide, start)
    return _arrival(guide, standing)


@dataclass(frozen=True)
class SteeredGuide:
    """The guide's line, which follows four axes; what is judged is the needle's tip."""

    arguments: GuideApproachArguments
    name = "needle's tip"

    @property
    def strategy(self) -> Strategy:
        return STRATEGIES["adaptive"]

    def look(
        self, calibration: Calibration, way: Imaging, *, number: int, fresh: bool
    ) -> ProcedureSteps[GuideLook]:
        arguments = self.arguments
        return look_at_guide(arguments.geometry, calibration, arguments.gate, fresh=fresh)

    def look_longer(
        self, seen: GuideLook, estimate: FiducialEstimate
    ) -> ProcedureSteps[GuideLook | None]:
        wanted = frames_that_decide(
            seen.frames_of_each, estimate, self.is_sure, self.arguments.most_frames
        )
        if wanted <= seen.frames_of_each:
            return None
        geometry, gate = self.arguments.geometry, self.arguments.gate
        return (yield from look_at_guide_longer(geometry, seen, gate, frames=wanted))

    def error_mm(self, estimate: FiducialEstimate) -> Array:
        geometry = self.arguments.geometry
        wanted = geometry.tip_from_fiducials @ np.array(self.arguments.target_mm)
        return np.asarray(wanted - tip_of(geometry, estimate)[0])

    def parts(self, estimate: FiducialEstimate) -> tuple[PlanPart, ...]:
        """Upper fiducial, lower fiducial, and the needle's tip, which hangs from both."""
        wanted = np.array(self.arguments.target_mm) - estimate.plane_mm
        covariance = estimate.covariance_mm2
        tip = self.error_mm(estimate), tip_of(self.arguments.geometry, estimate)[1]
        of_each = {
            "upper": (wanted[:2], covariance[:2, :2]),
            "lower": (wanted[2:], covariance[2:, 2:]),
            "tip": tip,
        }
        return tuple(
            PlanPart(name, float(off[0]), float(off[1]), float(np.sqrt(np.trace(spread) / 2)))
            for name, (off, spread) in of_each.items()
        )

    def probability(self, estimate: FiducialEstimate) -> float:
        """That the tip is within the tolerance, and the lower fiducial too: the smaller of both."""
        tolerance_mm = self.arguments.tolerance_mm
        estimate = self.arguments.as_judged(estimate)
        tip_covariance = tip_of(self.arguments.geometry, estimate)[1]
        at_tip = probability_within(self.error_mm(estimate), tip_covariance, tolerance_mm)
        lower = np.array(self.arguments.target_mm)[2:] - estimate.plane_mm[2:]
        at_guide = probability_within(lower, estimate.covariance_mm2[2:, 2:], tolerance_mm)
        return min(at_tip, at_guide)

    def is_sure(self, estimate: FiducialEstimate) -> bool:
        return self.probability(estimate) >= self.arguments.confidence

    def is_there(self, calibration: Calibration, way: Imaging) -> bool:
        return self.is_sure(calibration.estimate)

    def why_not_there(self, estimate: FiducialEstimate) -> str:
        return f"the error of the tip is {np.linalg.norm(self.error_mm(estimate)):.3f} mm"


def _arrival(guide: SteeredGuide, standing: Standing[GuideLook]) -> GuideArrival:
    arguments, geometry = guide.arguments, guide.arguments.geometry
    calibration, estimate = standing.calibration, standing.calibration.estimate
    try:
        line = line_of_state(
            geometry, estimate.plane_mm, calibration.plane, arguments.lower_plane_mm
        )
    except GuideSeenWrongError as wrong:
        raise ProcedureFailedError("guide", str(wrong)) from wrong
    return GuideArrival(
        calibration,
        guide.error_mm(estimate),
        tip_of(geometry, arguments.as_judged(estimate))[1],
        geometry.tip_beyond_mm,
        line.at(-geometry.tip_beyond_mm),
        line.point_mm,
        guide.probability(estimate),
        standing.iterations,
        standing.frames,
        standing.scan_s,
    )
