"""How the noise of frames is correlated from pixel to pixel, by what the frames themselves show.

Scanners filter, interpolate and denoise what they show, each in its own way: no list of names
covers it. What is left of several frames of one object beside their common image is noise, and
shows its correlation. It is not the same everywhere: the magnitudes of air are less correlated than
those of a signal, and a denoised plateau more. What counts for a place is the object's edge.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHANCE_SIGMA = 3.5  # of chi2 of all lags, before any is believed
WHITE_SHARE = 0.3  # of the noise power, in the weights: what is measured is not leant on entirely
_LEAST_POWER = 1e-6
_CORRECTIONS = 4  # of what a fit took away


@dataclass(frozen=True, eq=False)
class Colour:
    """Power spectrum (n, n) of the noise, of mean 1, in FFT order, on the grid of a patch."""

    power: Array

    @classmethod
    def of_lags(cls, table: Array, size: int) -> "Colour":
        """From the correlation at lags (0..reach rows, 0..reach columns); made positive."""
        reach = len(table) - 1
        index = np.abs(np.arange(-reach, reach + 1))
        lags = np.zeros((size, size))
        lags[np.ix_(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))] = table[
            np.ix_(index, index)
        ]
        power = np.maximum(scipy.fft.fft2(lags).real, _LEAST_POWER)
        return cls(np.asarray(power / power.mean()))

    def correlated(self, columns: Array, mask: Mask) -> Array:
        """(p, c) columns of the pixels of a mask, times the correlation of those pixels."""
        return self._filtered(columns, mask, self.power)

    def weighed(self, columns: Array, mask: Mask) -> Array:
        """The same times the inverse, softened by a share of white noise, near enough."""
        softened = (1 - WHITE_SHARE) * self.power + WHITE_SHARE
        return self._filtered(columns, mask, 1 / softened)

    def _filtered(self, columns: Array, mask: Mask, by: Array) -> Array:
        size = len(mask)
        images = np.zeros((columns.shape[1], size, size))
        images[:, mask] = columns.T
        spectra = scipy.fft.rfft2(images) * by[:, : size // 2 + 1]
        return np.asarray(scipy.fft.irfft2(spectra, (size, size))[:, mask].T)


@dataclass(frozen=True, eq=False)
class Lags:
    """Means over pairs of pixels, at lags (0..reach rows, 0..reach columns).

    weights (rows, cols): what each pixel counts; 0 outside of the mask. Lags to the left and to the
    right are taken together.
    """

    weights: Array
    reach: int

    @property
    def mask(self) -> Mask:
        return self.weights > 0

    @cached_property
    def total(self) -> Array:
        return np.maximum(self._sums(*[self.weights[None]] * 2), 1e-9)

    @property
    def pairs(self) -> Array:
        """How many pairs of one patch these are worth."""
        return self.total**2 / np.maximum(self._sums(*[self.weights[None] ** 2] * 2), 1e-9)

    def mean(self, first: Array, second: Array) -> Array:
        """Mean product of pixels of first (M, rows, cols) with those of second, at each lag."""
        weighed = first * self.weights
        return (
            self._sums(weighed, weighed if second is first else second * self.weights) / self.total
        )

    def _sums(self, first: Array, second: Array) -> Array:
        reach = self.reach
        shape = tuple(scipy.fft.next_fast_len(n + reach, real=True) for n in self.mask.shape)
        spectra = scipy.fft.rfft2(first, shape)
        others = spectra if second is first else scipy.fft.rfft2(second, shape)
        lags = scipy.fft.irfft2(np.sum((spectra.conj() * others).real, axis=0), shape)
        folded = lags[: reach + 1, : reach + 1].copy()
        folded[:, 1:] += lags[: reach + 1, : -reach - 1 : -1]
        return folded


def lag_correlation(residuals: Array, lags: Lags, taken: Array) -> tuple[float, Array, Array]:
    """Variance over what is left, correlation at lags, and its standard error.

    residuals: (M, rows, cols) standardised. taken (p, K): what the fit took away with it, H = taken
    taken': noise that is drawn out far is taken for background in part, and what is left of it
    shows less of it than there was: (1 - H) C (1 - H), of which C is sought.
    """
    mask, size = lags.mask, len(lags.mask)
    seen = lags.mean(residuals, residuals) / len(residuals)
    scale = max(float(seen[0, 0]), 1e-300)
    seen = seen / scale
    images = np.zeros((taken.shape[1], size, size))
    images[:, mask] = taken.T
    found = seen
    for _ in range(_CORRECTIONS):
        colour = Colour.of_lags(found / found[0, 0], size)
        spread = colour.correlated(taken, mask) * found[0, 0]
        lost = np.zeros_like(images)
        lost[:, mask] = (2 * spread - taken @ (taken.T @ spread)).T
        found = seen + lags.mean(images, lost)
    error = 1 / np.sqrt(lags.pairs * len(residuals))
    return float(found[0, 0]), found / found[0, 0], error


def believed(correlation: Array, error: Array) -> Array | None:
    """The lags, each drawn to 0 as far as chance explains it; None where it explains them all."""
    squares = (correlation / error) ** 2
    squares[0, 0] = 0.0
    lags = squares.size - 1
    if float(squares.sum()) < lags + CHANCE_SIGMA * np.sqrt(2 * lags):
        return None
    table = correlation * squares / (squares + 1)
    table[0, 0] = 1.0
    return np.asarray(table)
