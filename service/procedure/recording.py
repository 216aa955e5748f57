"""Recording a target: where the fiducial is now, looked at as an approach would at its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate, axis_sigma
from service.procedure.identity import ProofArguments, show_that_it_follows
from service.procedure.observe import ValidationGate, check_prediction
from service.procedure.steps import ProcedureSteps
from service.procedure.strategies import STRATEGIES, Observation, look_at_fiducial, look_longer

_MOST_FRAMES = 8


@dataclass(frozen=True)
class RecordingArguments:
    """sigma_mm: how well the place is to be known (worst axis), as far as slices can do that.

    proof: what a move needs that shows whether what is seen is the fiducial.
    """

    strategy: str
    sigma_mm: float
    gate: ValidationGate
    seed: int = 0
    proof: ProofArguments = field(default_factory=ProofArguments)


@dataclass(frozen=True, eq=False)
class Place:
    """Where the fiducial is: what is known now, and what finding it out took."""

    calibration: Calibration
    frames: int
    scan_s: float

    def patient_mm(self, found: Mapping[str, Any]) -> list[float]:
        """Patient mm (LPS, 3) of the place; `found` is what the worker wrote of its measurement.

        Along the slice normal it is where the slice lies.
        """
        better_mm = self.calibration.estimate.plane_mm - np.array(found["plane_mm"])
        step_mm = self.calibration.plane.direction(better_mm)
        return [float(value) for value in np.array(found["patient_mm"]) + step_mm]

    def to_json(self) -> dict[str, Any]:
        estimate = self.calibration.estimate
        return {
            "calibration": self.calibration.to_json(),
            "measurement_id": self.calibration.measurement_id,
            "sigma_mm": axis_sigma(estimate.covariance_mm2),
            "frames": self.frames,
            "scan_s": self.scan_s,
        }


def record_place(arguments: RecordingArguments, start: Calibration) -> ProcedureSteps[Place]:
    """Return `start` with the estimate of where the fiducial is, the robot standing still.

    A strategy that fuses takes as many slices as the bound asks for; the paper's take one look.
    """
    strategy = STRATEGIES[arguments.strategy]
    gate, seed = arguments.gate, (arguments.seed, 0)
    look = yield from look_at_fiducial(strategy.fine, start, gate, seed=seed, fresh=True)
    check_prediction(start.estimate, look.found, gate)
    if not arguments.proof.proven or look.after_loss:
        seen = replace(start, estimate=look.found, measurement_id=look.measurement_id)
        away = yield from show_that_it_follows(
            seen,
            arguments.proof,
            gate,
            "fiducial",
            lambda there: look_at_fiducial(strategy.fine, there, gate, seed=seed, fresh=False),
        )
        start = replace(start, estimate=away)
        look = yield from look_at_fiducial(strategy.fine, start, gate, seed=seed, fresh=False)
        check_prediction(start.estimate, look.found, gate)
    if not strategy.fuses or look.acquired is None:
        return _place(start, look.found, look)
    wanted = slices_for(look.found, look.frames, arguments.sigma_mm)
    if wanted > look.frames:
        look = yield from look_longer(look, look.acquired, gate, frames=wanted)
    estimate = look.prior.fused_with(look.found.plane_mm, look.found.covariance_mm2)
    return _place(start, estimate, look)


def _place(start: Calibration, estimate: FiducialEstimate, look: Observation) -> Place:
    calibration = replace(start, estimate=estimate, measurement_id=look.measurement_id)
    return Place(calibration, look.frames, look.scan_s)


def slices_for(found: FiducialEstimate, frames: int, sigma_mm: float) -> int:
    """How many slices bring the worst axis to `sigma_mm` by the bound, and never too many."""
    worst = float(np.linalg.eigvalsh(found.covariance_mm2)[-1])
    return min(_MOST_FRAMES, max(frames, int(np.ceil(frames * worst / sigma_mm**2))))
