"""Recording a target: where the fiducial is now, looked at as an approach would at its end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from service.calibration import Calibration
from service.estimate import FiducialEstimate, MotionNoise
from service.looking import STRATEGIES, LookArguments, look_at_fiducial, look_longer
from service.sensing import check_prediction
from service.steps import ProcedureSteps

_MOST_FRAMES = 8


@dataclass(frozen=True)
class RecordingArguments:
    """sigma_mm: how well the place is to be known (worst axis), as far as slices can do that."""

    strategy: str
    sigma_mm: float
    position_gate_mm: float
    gate_sigma: float
    repeatability_mm: float
    scale_error: float
    seed: int = 0

    @property
    def noise(self) -> MotionNoise:
        return MotionNoise(self.repeatability_mm, self.scale_error)


def record_place(arguments: RecordingArguments, start: Calibration) -> ProcedureSteps[Calibration]:
    """Return `start` with the estimate of where the fiducial is, the robot standing still.

    A strategy that fuses takes as many slices as the bound asks for; the paper's take one look.
    """
    strategy = STRATEGIES[arguments.strategy]
    looking = LookArguments(
        arguments.position_gate_mm, arguments.gate_sigma, arguments.noise, arguments.seed
    )
    look = yield from look_at_fiducial(strategy.fine, start, looking, number=0, fresh=True)
    check_prediction(start.estimate, look.found, arguments.gate_sigma, arguments.noise)
    if not strategy.fuses or look.acquired is None:
        return replace(start, estimate=look.found, measurement_id=look.measured.measurement_id)
    wanted = slices_for(look.found, look.measured.frames, arguments.sigma_mm)
    if wanted > look.measured.frames:
        look = yield from look_longer(look, look.acquired, looking, frames=wanted)
    estimate = look.prior.fused_with(look.found.plane_mm, look.found.covariance_mm2)
    return replace(start, estimate=estimate, measurement_id=look.measured.measurement_id)


def slices_for(found: FiducialEstimate, frames: int, sigma_mm: float) -> int:
    """How many slices bring the worst axis to `sigma_mm` by the bound, and never too many."""
    worst = float(np.linalg.eigvalsh(found.covariance_mm2)[-1])
    return min(_MOST_FRAMES, max(frames, int(np.ceil(frames * worst / sigma_mm**2))))
