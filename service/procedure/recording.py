"""Recording a target: where the fiducial is now, or where the guide points.

It is looked at as an approach would at its end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate, axis_sigma
from service.procedure.fiducials import ONE_FIDUCIAL, Geometry, NeedleSeen, judged_point
from service.procedure.identity import ProofArguments, show_that_it_follows
from service.procedure.observe import ValidationGate, check_prediction, see_needle
from service.procedure.steps import ProcedureSteps
from service.procedure.strategies import STRATEGIES, Observation, look, look_longer

_MOST_FRAMES = 8


@dataclass(frozen=True, kw_only=True)
class RecordingArguments:
    """sigma_mm: how well the place is to be known (worst axis), as far as slices can do that; of
    the guide the needle's tip.

    proof: what a move needs that shows whether what is seen is the fiducial. lower_plane_mm: of the
    guide's lower ball joints along the slice normal.
    """

    sigma_mm: float
    gate: ValidationGate
    strategy: str = "adaptive"
    seed: int = 0
    proof: ProofArguments = field(default_factory=ProofArguments)
    geometry: Geometry = ONE_FIDUCIAL
    lower_plane_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class Place:
    """Where the fiducials are: what is known now, and what finding it out took.

    sigma_mm: of the fiducial, or of the needle's tip; needle: with four axes, where it goes.
    """

    calibration: Calibration
    sigma_mm: float
    frames: int
    scan_s: float
    needle: NeedleSeen | None = None

    def target_mm(self, found: Mapping[str, Any]) -> list[float]:
        """Patient mm (LPS, 3) of the place; `found` is what the worker wrote of its measurement.

        Of one fiducial it is, along the slice normal, where the slice lies.
        """
        if self.needle is not None:
            return list(self.needle.tip_mm)
        better_mm = self.calibration.estimate.plane_mm - np.array(found["plane_mm"])
        step_mm = self.calibration.plane.direction(better_mm)
        return [float(value) for value in np.array(found["patient_mm"]) + step_mm]

    def to_json(self) -> dict[str, Any]:
        return {
            "calibration": self.calibration.to_json(),
            "measurement_id": self.calibration.measurement_id,
            "sigma_mm": self.sigma_mm,
            "frames": self.frames,
            "scan_s": self.scan_s,
            **({} if self.needle is None else self.needle.to_json()),
        }


def record_place(arguments: RecordingArguments, start: Calibration) -> ProcedureSteps[Place]:
    """Return `start` with the estimate of where the fiducials are, the robot standing still.

    A strategy that fuses takes as many slices as the bound asks for; the paper's take one look.
    """
    strategy = STRATEGIES[arguments.strategy]
    geometry, gate, seed = arguments.geometry, arguments.gate, (arguments.seed, 0)
    here = yield from look(geometry, strategy.fine, start, gate, seed=seed, fresh=True)
    check_prediction(start.estimate, here.found, gate)
    if not arguments.proof.proven or here.seen.after_loss:
        seen = replace(start, estimate=here.found, measurement_id=here.seen.measurement_id)
        away = yield from show_that_it_follows(
            seen,
            arguments.proof,
            gate,
            geometry.name,
            lambda there: look(geometry, strategy.fine, there, gate, seed=seed, fresh=False),
        )
        start = replace(start, estimate=away)
        here = yield from look(geometry, strategy.fine, start, gate, seed=seed, fresh=False)
        check_prediction(start.estimate, here.found, gate)
    estimate = here.found
    if strategy.fuses and here.can_go_on:
        wanted = _slices_for(arguments, here)
        if wanted > here.seen.frames_of_each:
            here = yield from look_longer(here, geometry, gate, frames=wanted)
        # what draws a disc's centre draws it alike where this target is approached
        prior, found = (replace(one, common_mm=None) for one in (here.prior, here.found))
        estimate = prior.fused_with(found)
    return _place(arguments, start, estimate, here)


def _place(
    arguments: RecordingArguments,
    start: Calibration,
    estimate: FiducialEstimate,
    here: Observation,
) -> Place:
    geometry = arguments.geometry
    return Place(
        replace(start, estimate=estimate, measurement_id=here.seen.measurement_id),
        axis_sigma(judged_point(geometry, estimate)[1]),
        here.seen.frames,
        here.seen.scan_s,
        see_needle(geometry, estimate, start.plane, arguments.lower_plane_mm),
    )


def _slices_for(arguments: RecordingArguments, here: Observation) -> int:
    """Slices of each fiducial that make the place as well known by the bound, never too many."""
    frames = here.seen.frames_of_each
    worst = float(np.linalg.eigvalsh(judged_point(arguments.geometry, here.found)[1])[-1])
    return min(_MOST_FRAMES, max(frames, int(np.ceil(frames * worst / arguments.sigma_mm**2))))
