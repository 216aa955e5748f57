"""Moments of magnitude (Rician) and real (Gaussian) pixels, and how the noise is coloured.

Gudbjartsson & Patz, MRM 34:910 (1995).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.special import i0e, i1e

from sr_engine.psf import Psf

Array = NDArray[np.float64]
NoiseKind = Literal["rician", "gaussian"]

_FAR_FROM_ZERO = 30.0  # in sigma: beyond it the exact variance cancels and the series is exact


@dataclass(frozen=True, eq=False)
class Moments:
    """Of pixels with a known noise-free signal: mean, its two derivatives in it, and variance."""

    signal: Array
    sigma: float
    kind: NoiseKind
    mean: Array
    slope: Array
    curvature: Array

    @cached_property
    def variance(self) -> Array:
        if self.kind == "gaussian":
            return np.full_like(self.signal, self.sigma**2)
        ratio, mean = self.signal / self.sigma, self.mean / self.sigma
        far = np.abs(ratio) > _FAR_FROM_ZERO
        exact = ratio**2 + 2 - mean**2
        return self.sigma**2 * np.where(far, 1 - 0.5 / np.where(far, ratio, 1.0) ** 2, exact)


def moments(signal: Array, sigma: float, kind: NoiseKind) -> Moments:
    """Moments of pixels with noise of std `sigma` per channel."""
    if kind == "gaussian":
        flat, straight = np.ones_like(signal), np.zeros_like(signal)
        return Moments(signal, sigma, kind, mean=signal, slope=flat, curvature=straight)
    ratio = signal / sigma
    x = ratio**2 / 4
    b0, b1 = i0e(x), i1e(x)
    root = np.sqrt(np.pi / 2)
    both = b0 + b1
    return Moments(
        signal,
        sigma,
        kind,
        mean=(sigma * root) * (b0 + 2 * x * both),
        slope=(root / 2) * ratio * both,
        curvature=(root / (2 * sigma)) * (b0 - b1),
    )


def sigma_of(values: Array, signal: Array, sigma: float, kind: NoiseKind, n_fitted: int) -> float:
    """Next estimate of the noise std per channel, from pixels and the signal fitted to them.

    One fixed-point step of the likelihood equation in sigma: a pixel far from zero shows one
    channel of noise, a pixel without signal both. n_fitted: parameters that the signal took.
    """
    if kind == "gaussian":
        squares, count = (values - signal) ** 2, float(values.size)
    else:
        size = np.abs(signal)
        z = values * size / sigma**2
        hidden = 2 * z * (1 - i1e(z) / i0e(z))
        squares, count = (values - size) ** 2, float(np.sum(2 - hidden))
    return float(np.sqrt(np.sum(squares) / max(count - n_fitted, 1.0)))


@lru_cache(maxsize=16)
def correlation(period: tuple[int, int], psf: Psf, reach: int) -> Array:
    """Correlation of the noise at lags 0..reach along rows and columns: (reach+1, reach+1).

    Noise enters k-space white and passes the same window as the signal. Cameras have white noise.
    """
    lags = np.arange(reach + 1, dtype=float)
    if psf.folds:
        return np.asarray((lags[:, None] == 0) & (lags[None, :] == 0), dtype=float)
    k_row, k_col = np.fft.fftfreq(period[0]), np.fft.fftfreq(period[1])
    power = psf.window(k_row[:, None], k_col[None, :]) ** 2
    across = np.cos(2 * np.pi * np.outer(lags, k_row))
    along = np.cos(2 * np.pi * np.outer(lags, k_col))
    covariance = across @ power @ along.T
    return np.asarray(covariance / covariance[0, 0])


_WHITE_FLOOR = 0.02  # share of noise power taken as white: what was never sampled stays finite


@lru_cache(maxsize=32)
def _pixel_correlation(
    period: tuple[int, int], psf: Psf, shape: tuple[int, int], packed_mask: bytes
) -> Array:
    """(n, n) correlation of one noise channel between the pixels of a mask."""
    bits = np.unpackbits(np.frombuffer(packed_mask, np.uint8), count=shape[0] * shape[1])
    row, col = np.nonzero(bits.reshape(shape))
    table = correlation(period, psf, max(shape))
    return np.asarray(table[np.abs(row[:, None] - row), np.abs(col[:, None] - col)])


def colour_factor(
    period: tuple[int, int], psf: Psf, mask: NDArray[np.bool_], expected: Moments, sigma: float
) -> Array:
    """Lower Cholesky factor (n, n) of the correlation of magnitudes at the pixels of a mask.

    A magnitude far from zero follows one channel (correlation rho), one without signal goes
    with the power of both (rho^2, near enough): the first two terms of the expansion of the
    magnitude in Hermite polynomials, each with the share of the variance that it has.
    """
    shape = (mask.shape[0], mask.shape[1])
    rho = _pixel_correlation(period, psf, shape, np.packbits(mask).tobytes())
    # the sign counts: where the signal is negative (the undershoot beside an edge, ringing) the
    # magnitude goes down as the channel goes up, against its neighbours on the positive side
    linear = np.clip(expected.slope * sigma / np.sqrt(expected.variance), -1.0, 1.0)
    rest = np.sqrt(1 - linear**2)
    matrix = (1 - _WHITE_FLOOR) * (np.outer(linear, linear) * rho + np.outer(rest, rest) * rho**2)
    matrix[np.diag_indices_from(matrix)] += _WHITE_FLOOR
    return np.asarray(cholesky(matrix, lower=True, check_finite=False))


def is_white(psf: Psf) -> bool:
    """True where noise is independent from pixel to pixel."""
    return psf.folds or (psf.kind == "flat" and psf.acquired == (1.0, 1.0))
