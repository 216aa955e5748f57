"""The point spread of a slice: which part of k-space was sampled, and with what weight.

Frequencies are in cycles per pixel of the frame; Nyquist is 0.5. Every window is even in each
frequency, so that a point spread has no displacement of its own.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.errors import ParameterError

Kind = Literal["flat", "hamming", "fermi", "elliptical", "box", "gaussian"]

_DEFAULTS: dict[str, tuple[float, ...]] = {
    "flat": (),
    "hamming": (0.54,),
    "fermi": (0.9, 0.05),
    "elliptical": (),
    "box": (),
    "gaussian": (0.6,),
}
_BOX_EXTENT = 8.0  # multiples of Nyquist after which what folds back is below 1e-4 of the edge
_GAUSSIAN_FLOOR = 1e-6


@dataclass(frozen=True)
class Psf:
    """A point spread by its k-space window.

    kind, parameters:
      flat        ()               all of the sampled rectangle alike (sinc point spread)
      hamming     (alpha,)         alpha + (1 - alpha) cos(pi k/kmax) along each axis; 0.5 is Hann
      fermi       (cutoff, width)  1/(1 + exp((|k|/kmax - cutoff)/width)), |k|/kmax elliptical
      elliptical  ()               the ellipse inside of the sampled rectangle, corners left out
      box         ()               square pixels of full fill factor (a camera); folds over
      gaussian    (sigma_px,)      Gaussian blur, sampled at points; folds over
    acquired: fraction (rows, cols) of the frame's k-space that the scanner really sampled; less
      than 1 where it filled the rest with zeros. kmax = acquired/2 along each axis.
    """

    kind: Kind = "flat"
    parameters: tuple[float, ...] = ()
    acquired: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ParameterError(f"unknown psf '{self.kind}', known: {', '.join(get_args(Kind))}")
        if not self.parameters:
            object.__setattr__(self, "parameters", _DEFAULTS[self.kind])
        wanted = len(_DEFAULTS[self.kind])
        if len(self.parameters) != wanted or not np.all(np.isfinite(self.parameters)):
            raise ParameterError(
                f"psf '{self.kind}' takes {wanted} finite parameter{'s' * (wanted != 1)}, "
                f"got {self.parameters}"
            )
        if not all(0 < fraction <= 1 for fraction in self.acquired):
            raise ParameterError(f"psf acquired fraction must be in (0, 1], is {self.acquired}")

    @property
    def folds(self) -> bool:
        """True for a camera: frequencies above Nyquist are in the frame, folded back."""
        return self.kind in ("box", "gaussian")

    @property
    def extent(self) -> tuple[float, float]:
        """Highest frequency (rows, cols) that reaches the frame, in multiples of Nyquist."""
        if self.kind == "box":
            return _BOX_EXTENT, _BOX_EXTENT
        if self.kind == "gaussian":
            reach = np.sqrt(-np.log(_GAUSSIAN_FLOOR) / 2) / (np.pi * self.parameters[0])
            highest = float(min(2 * reach, _BOX_EXTENT))
            return highest, highest
        return self.acquired

    def window(self, k_row: ArrayLike, k_col: ArrayLike) -> NDArray[np.float64]:
        """Weight at frequencies (cycles/px) that broadcast against each other; 1 at k = 0."""
        row, col = np.abs(np.asarray(k_row, float)), np.abs(np.asarray(k_col, float))
        if self.kind == "box":
            return np.sinc(row) * np.sinc(col)
        if self.kind == "gaussian":
            return np.exp(-2 * (np.pi * self.parameters[0]) ** 2 * (row**2 + col**2))
        row, col = 2 * row / self.acquired[0], 2 * col / self.acquired[1]
        # k = 1/2 itself is a sample of an even matrix: inside, whatever the rounding
        inside = (row <= 1 + 1e-9) & (col <= 1 + 1e-9)
        return np.where(inside, self._weight(row, col), 0.0)

    def _weight(self, row: NDArray[np.float64], col: NDArray[np.float64]) -> NDArray[np.float64]:
        """The window inside of the sampled rectangle; row and col run from 0 to 1."""
        if self.kind == "hamming":
            alpha = self.parameters[0]
            per_axis = [alpha + (1 - alpha) * np.cos(np.pi * k) for k in (row, col)]
            return per_axis[0] * per_axis[1]
        if self.kind == "fermi":
            cutoff, width = self.parameters
            return _fermi(np.hypot(row, col), cutoff, width) / _fermi(np.zeros(1), cutoff, width)
        if self.kind == "elliptical":
            return np.where(np.hypot(row, col) <= 1 + 1e-9, 1.0, 0.0)
        return np.ones(np.broadcast_shapes(row.shape, col.shape))


def _fermi(k: NDArray[np.float64], cutoff: float, width: float) -> NDArray[np.float64]:
    return 0.5 * (1 - np.tanh((k - cutoff) / (2 * width)))
