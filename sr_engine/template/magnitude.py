"""What a magnitude of one coil, or the root of the sum of squares of several, shows of a signal.

A pixel y is the length of a vector of n complex channels with noise of std sigma in each part:
(y/sigma)^2 is noncentral chi2 of 2n degrees of freedom, for n = 1 Rician. Correlated coils act as
fewer, so n is any number from 1 on; air tells it.
Constantinides, Atalar & McVeigh, MRM 38:852 (1997); Aja-Fernandez & Vegas-Sanchez-Ferrero (2016).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, hyp1f1, ive

Array = NDArray[np.float64]

MOST_CHANNELS = 128.0
_MANY = 30.0
_FAR = 40.0  # in sigma: beyond it the channels' floor is the square root's first terms
_RATIOS = np.linspace(0.0, _FAR, 1601)
_SHARES = np.linspace(0.0, 1.0, 801)
_FINENESS = 50.0  # steps of the channels' logarithm that tables are made for
_RAYLEIGH = np.pi / 4
RAYLEIGH_WITHIN = 0.03  # of the mean squared over the mean square: air of one channel


class Expected(NamedTuple):
    """Of pixels: mean, its derivative in the signal, variance."""

    mean: Array
    slope: Array
    variance: Array


def expected(signal: Array, sigma: float, channels: float) -> Expected:
    """Of magnitudes of a signal that is nowhere negative."""
    means, slopes, variances = _moments(_rounded(channels))
    ratio = signal / sigma
    far = ratio > _FAR
    mean, slope, variance = (np.interp(ratio, _RATIOS, t) for t in (means, slopes, variances))
    if far.any():
        mean = np.where(far, np.sqrt(ratio**2 + 2 * channels - 1), mean)
        slope = np.where(far, ratio / mean, slope)
    return Expected(mean * sigma, slope, variance * sigma**2)


def in_phase_share(z: Array, channels: float) -> Array:
    """I_n(z)/I_(n-1)(z), z = ys/sigma^2: a magnitude y tells of its signal s y times this."""
    table = _bessel_ratio(_rounded(channels))
    z = np.maximum(z, 0.0)  # a pixel below 0 is no magnitude, and tells nothing
    place = z / (z + channels) * (len(_SHARES) - 1)
    below = np.minimum(place.astype(np.intp), len(_SHARES) - 2)
    low = table.take(below)
    return np.asarray(low + (place - below) * (table.take(below + 1) - low))


def channels_of_air(air: Array) -> float | None:
    """How many channels magnitudes without signal have; None where they are none."""
    power = float(np.mean(air**2))
    if not power > 0 or float(air.min()) < 0:
        return None
    ratio = float(air.mean()) ** 2 / power
    if abs(ratio - _RAYLEIGH) < RAYLEIGH_WITHIN:
        return 1.0
    if not _RAYLEIGH < ratio < _air_ratio(MOST_CHANNELS):
        return None
    low, high = 0.0, float(np.log(MOST_CHANNELS))
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if _air_ratio(np.exp(middle)) < ratio else (low, middle)
    return float(np.exp(low))


def _air_ratio(channels: float) -> float:
    """Mean squared over mean square of magnitudes without signal."""
    return float(np.exp(2 * (gammaln(channels + 0.5) - gammaln(channels))) / channels)


def _rounded(channels: float) -> float:
    return float(np.exp(np.rint(np.log(channels) * _FINENESS) / _FINENESS))


@lru_cache(maxsize=16)
def _moments(n: float) -> tuple[Array, Array, Array]:
    """Mean, slope, variance at _RATIOS of signal to sigma."""
    if n > _MANY:  # the hypergeometric function overflows, and two moments of chi2 are enough
        variance = (n + _RATIOS**2) / (2 * n + _RATIOS**2)
        mean = np.sqrt(2 * n + _RATIOS**2 - variance)
        return mean, _RATIOS / mean, variance
    x = -(_RATIOS**2) / 2
    scale = np.sqrt(2) * np.exp(gammaln(n + 0.5) - gammaln(n))
    mean = scale * hyp1f1(-0.5, n, x)
    slope = scale * _RATIOS / (2 * n) * hyp1f1(0.5, n + 1, x)
    return mean, slope, 2 * n + _RATIOS**2 - mean**2


@lru_cache(maxsize=16)
def _bessel_ratio(n: float) -> Array:
    z = n * _SHARES[1:-1] / (1 - _SHARES[1:-1])
    return np.concatenate([[0.0], ive(n, z) / ive(n - 1, z), [1.0]])
