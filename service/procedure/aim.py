"""What an approach aims at: where the fiducials are to be, how far off they are, and how sure.

Of the guide it is the needle's tip that is brought to its target; the lower fiducial must be where
it belongs as well, or the needle goes in beside the entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate, axis_sigma, probability_within
from service.procedure.fiducials import ONE_FIDUCIAL, Geometry, judged_point
from service.procedure.observe import ValidationGate
from service.procedure.plan import PlanPart, Travel
from service.procedure.strategies import STRATEGIES, Imaging, Strategy

Array = NDArray[np.float64]
PROBABILITY, PAPER = "probability", "paper"


@dataclass(frozen=True, kw_only=True)
class ApproachArguments:
    """What an approach is told.

    target_mm: of every fiducial, in the image plane of the calibration, as the estimate has it.
    travel_um: lowest and highest setpoint of each axis. tolerance_mm: of the judged point.
    strategy: a name, or one of your own. stop_rule: `probability` (READY only with P(error <
    tolerance) >= confidence) or `paper` (error below one pixel of the image looked at; for the
    paper's studies). seed: of the random shift sets. most_frames: slices at one position at the
    most. proven: what is measured was seen to move with the robot, see `identity`; otherwise READY
    is said only after a move that shows it. systematic_mm: std, for each coordinate, of what all
    places found so have in common, where it counts: see `targets.common_part_mm`. common_cancels:
    what draws the centre of a disc drew the target's alike, so that of it only what differs from
    look to look is left. lower_plane_mm: of the guide's lower ball joints along the slice normal.
    """

    target_mm: tuple[float, ...]
    travel_um: Mapping[str, tuple[int, int]]
    tolerance_mm: float
    confidence: float
    max_iterations: int
    confirm_moves: bool
    gate: ValidationGate
    proven: bool = True
    most_frames: int = 6
    systematic_mm: tuple[float, ...] = ()
    common_cancels: bool = False
    strategy: str | Strategy = "adaptive"
    stop_rule: str = PROBABILITY
    seed: int = 0
    geometry: Geometry = ONE_FIDUCIAL
    lower_plane_mm: float = 0.0

    @property
    def travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self.travel_um.items()}

    @property
    def how_to_look(self) -> Strategy:
        return self.strategy if isinstance(self.strategy, Strategy) else STRATEGIES[self.strategy]

    def as_judged(self, estimate: FiducialEstimate) -> FiducialEstimate:
        """An estimate with what counts against the target beside its own uncertainty."""
        if not self.systematic_mm:
            return estimate
        more = np.diag(np.square(self.systematic_mm))
        return replace(estimate, covariance_mm2=estimate.covariance_mm2 + more)

    def error_mm(self, estimate: FiducialEstimate) -> Array:
        """From where the judged point is to where it should be, image plane (row, col)."""
        wanted = self.geometry.judged[0] @ np.array(self.target_mm)
        return np.asarray(wanted - judged_point(self.geometry, estimate)[0])

    def parts(self, estimate: FiducialEstimate) -> tuple[PlanPart, ...]:
        """How far each thing that the operator is told of is from where it should be.

        Of the guide both fiducials, and the needle's tip, which hangs from both; of one fiducial
        the displacement says it all.
        """
        names = self.geometry.names
        if len(names) == 1:
            return ()
        wanted, covariance = np.array(self.target_mm) - estimate.plane_mm, estimate.covariance_mm2
        off = [(wanted[one], covariance[one, one]) for one in estimate.each]
        off.append((self.error_mm(estimate), judged_point(self.geometry, estimate)[1]))
        return tuple(
            PlanPart(name, float(row), float(col), axis_sigma(spread))
            for name, ((row, col), spread) in zip((*names, "tip"), off, strict=True)
        )

    def probability(self, estimate: FiducialEstimate) -> float:
        """That all that is judged is within the tolerance: the smallest of each."""
        target_mm, covariance = np.array(self.target_mm), self.as_judged(estimate).covariance_mm2
        return min(
            probability_within(
                lever @ target_mm - lever @ estimate.plane_mm,
                lever @ covariance @ lever.T,
                self.tolerance_mm,
            )
            for lever in self.geometry.judged
        )

    def is_sure(self, estimate: FiducialEstimate) -> bool:
        return self.probability(estimate) >= self.confidence

    def is_there(self, calibration: Calibration, way: Imaging) -> bool:
        """Whether this is the place to puncture, as far as can be said of it."""
        if self.stop_rule == PROBABILITY:
            return self.is_sure(calibration.estimate)
        pixel_mm = np.array(calibration.plane.spacing_mm) / way.factor
        return float(np.linalg.norm(self.error_mm(calibration.estimate) / pixel_mm)) < 1.0

    def why_not_there(self, estimate: FiducialEstimate) -> str:
        """How far off it is, for the operator."""
        return (
            f"the error is {np.linalg.norm(self.error_mm(estimate)):.3f} mm, "
            f"P(error < {self.tolerance_mm:g} mm) = {self.probability(estimate):.2f}"
        )

    def why_never_sure(self) -> str:
        """Why READY could not be said even at the target, seen perfectly; empty where it could."""
        size = len(self.target_mm)
        there = FiducialEstimate({}, np.array(self.target_mm), np.zeros((size, size)))
        if self.is_sure(there):
            return ""
        worst_mm = max(self.systematic_mm, default=0.0)
        return (
            f"the fiducial's centre is known only to {worst_mm:.3f} mm (σ, one axis), and all of "
            f"that affects this target: an error below {self.tolerance_mm:g} mm cannot be "
            f"confirmed with {100 * self.confidence:g} % confidence. Widen the tolerance, or "
            "record a target at the fiducial's own position"
        )

    def frames_wanted(self, estimate: FiducialEstimate, present: int) -> int:
        """Return how many slices at this hold would be enough to say READY, or the present number.

        Where the error itself is most of the tolerance, a move may be worth more than another one.
        """
        error = float(np.linalg.norm(self.error_mm(estimate)))
        if error > self.geometry.worth_more_frames * self.tolerance_mm:
            return present
        return frames_that_decide(present, estimate, self.is_sure, self.most_frames)


def frames_that_decide(
    present: int,
    estimate: FiducialEstimate,
    is_sure: Callable[[FiducialEstimate], bool],
    most: int,
) -> int:
    """Return how many slices of a fiducial would be enough to be sure, or the present number.

    The bound scales as one over their number; the error found so far is taken as the error.
    """
    for frames in range(present, most + 1):
        if is_sure(estimate.with_noise_times(present / frames)):
            return frames
    return present
