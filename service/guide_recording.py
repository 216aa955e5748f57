"""Recording a needle line: where the guide points, looked at as an approach would at its end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.calibration import Calibration
from service.estimate import FiducialEstimate
from service.guide_geometry import GuideGeometry, GuideSeenWrongError, line_of_state, tip_of
from service.guide_looking import BothSeen, gates, see_both, see_longer
from service.kinematics import Line
from service.sensing import ProcedureFailedError, ValidationGate, check_prediction
from service.steps import ProcedureSteps

_MOST_FRAMES = 8


@dataclass(frozen=True)
class GuideRecordingArguments:
    """sigma_mm: how well the tip's place is to be known (worst axis), as far as slices can do it.

    lower_plane_mm: of the lower ball joints along the slice normal.
    """

    geometry: GuideGeometry
    lower_plane_mm: float
    sigma_mm: float
    gate: ValidationGate


@dataclass(frozen=True, eq=False)
class GuidePlace:
    """The guide's line now (patient mm), its tip's uncertainty, and what finding it out took."""

    calibration: Calibration
    line: Line
    tip_below_joint_mm: float
    sigma_mm: float
    frames: int
    scan_s: float

    @property
    def tip_mm(self) -> list[float]:
        return [float(value) for value in self.line.at(-self.tip_below_joint_mm)]

    @property
    def joint_mm(self) -> list[float]:
        return [float(value) for value in self.line.point_mm]

    def to_json(self) -> dict[str, Any]:
        return {
            "calibration": self.calibration.to_json(),
            "measurement_id": self.calibration.measurement_id,
            "joint_mm": self.joint_mm,
            "tip_mm": self.tip_mm,
            "tip_below_joint_mm": self.tip_below_joint_mm,
            "sigma_mm": self.sigma_mm,
            "frames": self.frames,
            "scan_s": self.scan_s,
        }


def record_guide(
    arguments: GuideRecordingArguments, start: Calibration
) -> ProcedureSteps[GuidePlace]:
    """Look at both fiducials where the robot stands, with as many slices as the bound asks for."""
    prior, geometry = start.estimate, arguments.geometry
    expected = gates(prior, arguments.gate)
    seen = yield from see_both(geometry, expected, fresh=True)
    here = seen.at(prior.setpoints_um)
    check_prediction(prior, here, arguments.gate)
    wanted = _slices_for(geometry, here, seen, arguments.sigma_mm)
    if wanted > seen.measured[0].frames:
        seen = yield from see_longer(geometry, seen, expected, wanted)
        here = seen.at(prior.setpoints_um)
    estimate = prior.fused_with(here.plane_mm, here.covariance_mm2)
    calibration = replace(start, estimate=estimate, measurement_id=seen.measurement_id)
    try:
        line = line_of_state(geometry, estimate.plane_mm, start.plane, arguments.lower_plane_mm)
    except GuideSeenWrongError as wrong:
        raise ProcedureFailedError("guide", str(wrong)) from wrong
    sigma_mm = float(np.sqrt(np.trace(tip_of(geometry, estimate)[1]) / 2))
    return GuidePlace(calibration, line, geometry.tip_beyond_mm, sigma_mm, seen.frames, seen.scan_s)


def _slices_for(
    geometry: GuideGeometry, here: FiducialEstimate, seen: BothSeen, sigma_mm: float
) -> int:
    """Slices of each fiducial that bring the tip to `sigma_mm` by the bound, and never too many."""
    frames = seen.measured[0].frames
    worst = float(np.linalg.eigvalsh(tip_of(geometry, here)[1])[-1])
    return min(_MOST_FRAMES, max(frames, int(np.ceil(frames * worst / sigma_mm**2))))
