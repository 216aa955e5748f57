"""Where the fiducial is believed to be, with covariance, and how sure that is enough.

Positions are millimetres in the image plane: (along increasing row, along increasing column),
measured from the patient origin, so that they survive another field of view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from service.procedure.jacobian import ImageJacobian

Array = NDArray[np.float64]
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(120)
_REACH_SIGMA = 8.0


@dataclass(frozen=True)
class MotionNoise:
    """How far a settled axis may be from where its setpoint says, after one move."""

    repeatability_mm: float
    scale_error: float

    def variance_mm2(self, change_mm: float) -> float:
        if change_mm == 0.0:
            return 0.0
        return self.repeatability_mm**2 + (self.scale_error * change_mm) ** 2


@dataclass(frozen=True, eq=False)
class FiducialEstimate:
    """Position (2,) and covariance (2, 2) in the image plane, at the given setpoints.

    common_mm: std (2,) of the part of the covariance that is the same at every look (what draws
    the centre of a disc that is none), so that fusing looks does not lessen it; none by default.
    Of two fiducials: (4,) and (4, 4), the first one's pair first.
    """

    setpoints_um: Mapping[str, int]
    plane_mm: Array
    covariance_mm2: Array
    common_mm: Array | None = None

    @property
    def noise_mm2(self) -> Array:
        """The part of covariance_mm2 that further looks lessen."""
        if self.common_mm is None:
            return self.covariance_mm2
        return np.asarray(self.covariance_mm2 - np.diag(np.square(self.common_mm)))

    @property
    def each(self) -> list[slice]:
        """Where each fiducial's pair stands."""
        return [slice(at, at + 2) for at in range(0, len(self.plane_mm), 2)]

    def moved_to(
        self, setpoints_um: Mapping[str, int], jacobian: ImageJacobian, noise: MotionNoise
    ) -> FiducialEstimate:
        """Predict the position after a move to `setpoints_um`."""
        change_mm = {
            axis: (setpoints_um[axis] - self.setpoints_um[axis]) / 1000.0 for axis in jacobian.axes
        }
        displacement, covariance = jacobian.displacement(change_mm)
        return FiducialEstimate(
            dict(setpoints_um),
            self.plane_mm + displacement,
            self.covariance_mm2 + covariance + motion_covariance(change_mm, jacobian, noise),
            self.common_mm,
        )

    def fused_with(self, found: FiducialEstimate) -> FiducialEstimate:
        """Combine the prediction with what was found at the same setpoints.

        What both have in common is no second witness: they are weighed by the rest, and it stays. A
        prediction that does not say what draws it is drawn as the look is: it is of one object.
        """
        its_mm = np.zeros(len(self.plane_mm)) if found.common_mm is None else found.common_mm
        own_mm = its_mm if self.common_mm is None else self.common_mm
        shared = np.diag(np.square(np.minimum(own_mm, its_mm)))
        own = self.noise_mm2 + np.diag(np.square(own_mm)) - shared
        its = found.covariance_mm2 - shared
        gain = np.linalg.solve(own + its, own).T
        rest = np.eye(len(gain)) - gain
        common_mm = np.abs(rest) @ own_mm + np.abs(gain) @ its_mm
        noise_mm2 = rest @ self.noise_mm2 @ rest.T + gain @ found.noise_mm2 @ gain.T
        return FiducialEstimate(
            self.setpoints_um,
            self.plane_mm + gain @ (found.plane_mm - self.plane_mm),
            noise_mm2 + np.diag(np.square(common_mm)),
            common_mm if np.any(common_mm) else None,
        )

    def with_noise_times(self, factor: float) -> FiducialEstimate:
        """As if so many times the noise (in power) were in it; what is common stays."""
        return replace(self, covariance_mm2=self.covariance_mm2 + (factor - 1) * self.noise_mm2)

    def distance_sigma(self, plane_mm: Array, covariance_mm2: Array) -> float:
        """How many standard deviations a measurement is away from this prediction."""
        innovation = plane_mm - self.plane_mm
        total = self.covariance_mm2 + covariance_mm2
        return float(np.sqrt(innovation @ np.linalg.solve(total, innovation)))

    def to_json(self) -> dict[str, Any]:
        return {
            "setpoints_um": dict(self.setpoints_um),
            "plane_mm": self.plane_mm.tolist(),
            "covariance_mm2": self.covariance_mm2.tolist(),
            **({} if self.common_mm is None else {"common_mm": self.common_mm.tolist()}),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> FiducialEstimate:
        return cls(
            value["setpoints_um"],
            np.array(value["plane_mm"]),
            np.array(value["covariance_mm2"]),
            np.array(value["common_mm"]) if "common_mm" in value else None,
        )


def motion_covariance(
    change_mm: Mapping[str, float], jacobian: ImageJacobian, noise: MotionNoise
) -> Array:
    """Covariance (n, n) mm² in the image plane of what one move does beside what it should."""
    columns = jacobian.mean_columns
    scatter = np.diag([noise.variance_mm2(change_mm[axis]) for axis in jacobian.axes])
    return np.asarray(columns @ scatter @ columns.T)


def probability_within(offset_mm: Array, covariance_mm2: Array, tolerance_mm: float) -> float:
    """Return P(|x| < tolerance) for a normal x (2,) with this mean and covariance.

    Exact up to quadrature: in the principal axes one coordinate is integrated by Gauss–Legendre
    (over the angle, where the chord is smooth), the other in closed form.
    """
    variances, axes = np.linalg.eigh(covariance_mm2)
    sigma = np.sqrt(np.maximum(variances, 1e-18))
    mean = axes.T @ offset_mm
    # integrate over the narrower axis: its density decides where the nodes must lie
    low = max(-tolerance_mm, mean[0] - _REACH_SIGMA * sigma[0])
    high = min(tolerance_mm, mean[0] + _REACH_SIGMA * sigma[0])
    if not low < high:
        return 0.0
    first, last = np.arcsin(low / tolerance_mm), np.arcsin(high / tolerance_mm)
    angle = (last + first) / 2 + (last - first) / 2 * _NODES
    half_chord = tolerance_mm * np.cos(angle)
    standard = (tolerance_mm * np.sin(angle) - mean[0]) / sigma[0]
    density = np.exp(-0.5 * standard**2) / (sigma[0] * np.sqrt(2 * np.pi))
    inside = ndtr((half_chord - mean[1]) / sigma[1]) - ndtr((-half_chord - mean[1]) / sigma[1])
    total = (last - first) / 2 * float(np.sum(_WEIGHTS * density * half_chord * inside))
    return min(1.0, max(0.0, total))


def axis_sigma(covariance: Array | list[list[float]]) -> float:
    """One figure for a (2, 2) covariance: the root mean square of its standard deviations."""
    return float(np.sqrt(np.trace(np.asarray(covariance)) / 2))
