"""Recording a needle line: where the guide points, looked at as an approach would at its end."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from service.procedure.calibration import Calibration
from service.procedure.estimate import axis_sigma
from service.procedure.guide_geometry import (
    GuideGeometry,
    GuideSeenWrongError,
    line_of_state,
    tip_of,
)
from service.procedure.guide_looking import GuideLook, look_at_guide, look_at_guide_longer
from service.procedure.identity import ProofArguments, show_that_it_follows
from service.procedure.kinematics import NeedleLine
from service.procedure.observe import ProcedureFailedError, ValidationGate, check_prediction
from service.procedure.steps import ProcedureSteps

_MOST_FRAMES = 8


@dataclass(frozen=True)
class GuideRecordingArguments:
    """sigma_mm: how well the tip's place is to be known (worst axis), as far as slices can do it.

    lower_plane_mm: of the lower ball joints along the slice normal. proof: what a move needs that
    shows whether what is seen are the fiducials.
    """

    geometry: GuideGeometry
    lower_plane_mm: float
    sigma_mm: float
    gate: ValidationGate
    proof: ProofArguments = field(default_factory=ProofArguments)


@dataclass(frozen=True, eq=False)
class GuidePlace:
    """The guide's line now (patient mm), its tip's uncertainty, and what finding it out took."""

    calibration: Calibration
    line: NeedleLine
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
    look = yield from look_at_guide(geometry, start, arguments.gate, fresh=True)
    check_prediction(prior, look.found, arguments.gate)
    if not arguments.proof.proven or look.after_loss:
        seen = replace(start, estimate=look.found, measurement_id=look.measurement_id)
        gate = arguments.gate
        prior = yield from show_that_it_follows(
            seen,
            arguments.proof,
            gate,
            "guide",
            lambda there: look_at_guide(geometry, there, gate, fresh=False),
        )
        away = replace(start, estimate=prior)
        look = yield from look_at_guide(geometry, away, gate, fresh=False)
        check_prediction(prior, look.found, gate)
    wanted = _slices_for(geometry, look, arguments.sigma_mm)
    if wanted > look.frames_of_each:
        look = yield from look_at_guide_longer(geometry, look, arguments.gate, frames=wanted)
    estimate = prior.fused_with(look.found.plane_mm, look.found.covariance_mm2)
    calibration = replace(start, estimate=estimate, measurement_id=look.measurement_id)
    try:
        line = line_of_state(geometry, estimate.plane_mm, start.plane, arguments.lower_plane_mm)
    except GuideSeenWrongError as wrong:
        raise ProcedureFailedError("guide", str(wrong)) from wrong
    sigma_mm = axis_sigma(tip_of(geometry, estimate)[1])
    return GuidePlace(calibration, line, geometry.tip_beyond_mm, sigma_mm, look.frames, look.scan_s)


def _slices_for(geometry: GuideGeometry, look: GuideLook, sigma_mm: float) -> int:
    """Slices of each fiducial that bring the tip to `sigma_mm` by the bound, and never too many."""
    frames = look.frames_of_each
    worst = float(np.linalg.eigvalsh(tip_of(geometry, look.found)[1])[-1])
    return min(_MOST_FRAMES, max(frames, int(np.ceil(frames * worst / sigma_mm**2))))
