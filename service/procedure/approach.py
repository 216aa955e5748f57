"""Approach: measure, plan, move, until the fiducial is at the target with enough certainty.

How it looks is the strategy's (`service.procedure.strategies`). `adaptive` carries every earlier
measurement along through the known moves, plans from that, and takes more slices at one place only
where the bound says that they will decide. The paper's strategies believe the last image alone, and
their image Jacobian stays as it was calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate, axis_sigma, probability_within
from service.procedure.plan import PlanPart
from service.procedure.steering import Standing, SteeringArguments, frames_that_decide, steer
from service.procedure.steps import ProcedureSteps
from service.procedure.strategies import (
    STRATEGIES,
    Imaging,
    Observation,
    Strategy,
    look_at_fiducial,
    look_longer,
)

_WORTH_MORE_FRAMES = 0.6
PROBABILITY, PAPER = "probability", "paper"


@dataclass(frozen=True, kw_only=True)
class ApproachArguments(SteeringArguments):
    """What an approach is told.

    target_mm: (2,) of the fiducial. strategy: a name, or one of your own. stop_rule: `probability`
    (READY only with P(error < tolerance) >= confidence) or `paper` (error below one pixel of the
    image looked at; for the paper's studies). seed: of the random shift sets.
    """

    strategy: str | Strategy = "adaptive"
    stop_rule: str = PROBABILITY
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Arrival:
    """READY: the fiducial is at the target; the calibration goes on with what was learnt."""

    calibration: Calibration
    error_mm: float
    sigma_mm: float
    probability: float
    iterations: int
    frames: int
    scan_s: float
    measurement_id: int

    def to_json(self) -> dict[str, Any]:
        numbers = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {**numbers, "calibration": self.calibration.to_json()}


def approach(arguments: ApproachArguments, start: Calibration) -> ProcedureSteps[Arrival]:
    """Bring the fiducial to the target; raises ProcedureFailedError when that does not succeed."""
    fiducial = SteeredFiducial(arguments)
    standing = yield from steer(fiducial, start)
    return _arrival(fiducial, standing)


@dataclass(frozen=True)
class SteeredFiducial:
    """One fiducial that follows two axes."""

    arguments: ApproachArguments
    name = "fiducial"

    @property
    def strategy(self) -> Strategy:
        chosen = self.arguments.strategy
        return chosen if isinstance(chosen, Strategy) else STRATEGIES[chosen]

    def look(
        self, calibration: Calibration, way: Imaging, *, number: int, fresh: bool
    ) -> ProcedureSteps[Observation]:
        seed = (self.arguments.seed, number)
        return look_at_fiducial(way, calibration, self.arguments.gate, seed=seed, fresh=fresh)

    def look_longer(
        self, seen: Observation, estimate: FiducialEstimate
    ) -> ProcedureSteps[Observation | None]:
        wanted = self.frames_wanted(estimate, seen.frames)
        if seen.acquired is None or wanted <= seen.frames:
            return None
        return (yield from look_longer(seen, seen.acquired, self.arguments.gate, frames=wanted))

    def frames_wanted(self, estimate: FiducialEstimate, present: int) -> int:
        """Return how many slices at this hold would be enough to say READY, or the present number.

        Where the error itself is most of the tolerance, a move is worth more than another slice.
        """
        error = self.error_mm(estimate)
        if np.linalg.norm(error) > _WORTH_MORE_FRAMES * self.arguments.tolerance_mm:
            return present
        return frames_that_decide(present, estimate, self.is_sure, self.arguments.most_frames)

    def error_mm(self, estimate: FiducialEstimate) -> NDArray[np.float64]:
        return np.array(self.arguments.target_mm) - estimate.plane_mm

    def parts(self, estimate: FiducialEstimate) -> tuple[PlanPart, ...]:
        return ()  # the displacement says it all

    def probability(self, estimate: FiducialEstimate) -> float:
        """That the fiducial is within the tolerance."""
        error, tolerance_mm = self.error_mm(estimate), self.arguments.tolerance_mm
        return probability_within(
            error, self.arguments.as_judged(estimate).covariance_mm2, tolerance_mm
        )

    def is_sure(self, estimate: FiducialEstimate) -> bool:
        return self.probability(estimate) >= self.arguments.confidence

    def is_there(self, calibration: Calibration, way: Imaging) -> bool:
        if self.arguments.stop_rule == PROBABILITY:
            return self.is_sure(calibration.estimate)
        pixel_mm = np.array(calibration.plane.spacing_mm) / way.factor
        return float(np.linalg.norm(self.error_mm(calibration.estimate) / pixel_mm)) < 1.0

    def why_not_there(self, estimate: FiducialEstimate) -> str:
        return (
            f"the error is {np.linalg.norm(self.error_mm(estimate)):.3f} mm, "
            f"P(error < {self.arguments.tolerance_mm:g} mm) = {self.probability(estimate):.2f}"
        )


def _arrival(fiducial: SteeredFiducial, standing: Standing[Observation]) -> Arrival:
    estimate = standing.calibration.estimate
    return Arrival(
        standing.calibration,
        float(np.linalg.norm(fiducial.error_mm(estimate))),
        axis_sigma(fiducial.arguments.as_judged(estimate).covariance_mm2),
        fiducial.probability(estimate),
        standing.iterations,
        standing.frames,
        standing.scan_s,
        standing.calibration.measurement_id,
    )
