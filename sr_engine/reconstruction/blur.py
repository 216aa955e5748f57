"""What one frame pixel sees of the scene: the blur of the super-resolution forward model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import ParameterError


@dataclass(frozen=True)
class Blur:
    """Separable blur H, in units of frame pixels.

    ``box`` is the area a camera pixel integrates over (1 px wide); ``gaussian_sigma_px`` the
    optics before it. ``Blur()`` samples the scene in points: right for MR magnitude frames,
    where each pixel already is a sample of the band-limited image.
    """

    box: bool = False
    gaussian_sigma_px: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.gaussian_sigma_px <= 16.0:
            raise ParameterError(
                f"gaussian_sigma_px is {self.gaussian_sigma_px}; it must lie in 0 to 16 px"
            )

    def transfer(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """H along one axis at ``frequency`` (cycles per frame pixel)."""
        gaussian = np.exp(-2.0 * (math.pi * self.gaussian_sigma_px * frequency) ** 2)
        return np.sinc(frequency) * gaussian if self.box else gaussian
