"""The scene of the paper's numerical study: a circle in 5000 x 5000 pixels, made coarse.

The paper draws a binary circle of very high resolution, blurs it, scales it down to the
resolution of MRI and adds noise. Blur and scaling are linear and act on each axis by itself,
and each row of a drawn circle is one run of ones: so the coarse frame is one matrix product
with the running sums of the axis' weights, and the 25 million pixels need never be stored. It
is the same frame to the last bits (a test draws the large image and compares).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CircleScene:
    """``fine_shape`` in high-resolution pixels, ``factor`` of them to a frame pixel each way.

    ``blur_sigma_px`` is the standard deviation of the Gaussian blur before the scaling, in
    frame pixels; the scaling is the mean over ``factor`` x ``factor`` pixels. Values run from
    0 outside of the circle to 1 inside.
    """

    radius_px: float
    blur_sigma_px: float
    fine_shape: tuple[int, int] = (5000, 5000)
    factor: int = 40

    @property
    def shape(self) -> tuple[int, int]:
        return self.fine_shape[0] // self.factor, self.fine_shape[1] // self.factor

    def frame(self, centre_px: tuple[float, float]) -> Array:
        """The noise-free frame of a circle with its centre at ``centre_px`` (frame pixels)."""
        row, col = ((c + 0.5) * self.factor - 0.5 for c in centre_px)
        radius = self.radius_px * self.factor
        drawn = np.arange(math.ceil(row - radius), math.floor(row + radius) + 1)
        reach = np.sqrt(np.maximum(radius**2 - (drawn - row) ** 2, 0.0))
        first, last = np.ceil(col - reach).astype(int), np.floor(col + reach).astype(int)
        if not (
            0 <= drawn[0] <= drawn[-1] < self.fine_shape[0]
            and 0 <= first.min() <= last.max() < self.fine_shape[1]
        ):
            raise ValueError(f"the circle at {centre_px} leaves the {self.shape} frame")
        row_weights, _ = _axis(self.fine_shape[0], self.factor, self.blur_sigma_px)
        _, col_sums = _axis(self.fine_shape[1], self.factor, self.blur_sigma_px)
        runs = col_sums[:, last + 1] - col_sums[:, first]
        return np.asarray(row_weights[:, drawn] @ runs.T)


@lru_cache(maxsize=8)
def _axis(fine: int, factor: int, blur_sigma_px: float) -> tuple[Array, Array]:
    """Weights (coarse, fine) of blur and scaling, and their running sums (coarse, fine + 1).

    Beyond the border the scene is empty, so what the blur carries out of it is lost.
    """
    coarse = fine // factor
    sigma = blur_sigma_px * factor
    reach = math.ceil(6 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-9)) ** 2)
    window = np.convolve(kernel / kernel.sum(), np.full(factor, 1.0 / factor))
    weights = np.zeros((coarse, fine))
    for pixel in range(coarse):
        start = pixel * factor - reach
        low, high = max(0, start), min(fine, start + len(window))
        weights[pixel, low:high] = window[low - start : high - start]
    sums = np.concatenate([np.zeros((coarse, 1)), np.cumsum(weights, axis=1)], axis=1)
    return weights, sums
