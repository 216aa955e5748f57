"""Which point spread a frame has, from the frame itself.

What the scanner filled with zeros shows as a border in the spectrum, where noise does not hide it.
The rest does not show there beside the object's own spectrum; the window, and the border where it
is hidden, are chosen as those through which a round object in the frame is explained best.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import NotConvergedError
from sr_engine.fit import fit_disc
from sr_engine.noise import NoiseKind, correlation
from sr_engine.psf import Psf
from sr_engine.signal import Mask, Pixels

Array = NDArray[np.float64]

LEAST_DROP = 0.7  # decades of power, across the border of what was sampled
LEAST_ACQUIRED = 0.3
_SIDE = 4  # frequencies on either side of a border that are compared
LEAST_AIR_PX = 1500
LEAST_NOISE_GAIN = 25.0  # of chi2: five standard deviations at one lag
_LAGS = 3
_USED = np.array([[j > 0 or i > 0 for j in range(_LAGS + 1)] for i in range(-_LAGS, _LAGS + 1)])
_BLOCK_PX = 8
_QUIET = 1.6  # of the power of the quietest quarter of the blocks
_RAYLEIGH_WITHIN = 0.02  # of the mean squared over the mean square, pi/4 in air
LEAST_GAIN = 10.0  # of twice the log likelihood, before flat k-space is given up

WINDOWS: tuple[tuple[Any, tuple[float, ...]], ...] = (
    ("flat", ()),
    ("hamming", (0.54,)),
    ("fermi", (0.9, 0.05)),
    ("elliptical", ()),
)
FRACTIONS = (0.875, 0.75, 0.625, 0.5)  # of k-space, of which scanners make finer matrices
CAMERAS: tuple[Psf, ...] = (
    Psf("box"),
    Psf("gaussian", (0.4,)),
    Psf("gaussian", (0.6,)),
    Psf("gaussian", (0.9,)),
)


def acquired_fraction(frame: Array) -> tuple[float, float]:
    """Fraction (rows, cols) of k-space that is not zero-filled; 1 where no border shows.

    The power beyond the border, which taking the magnitude brings about, is a small fraction of
    that inside, and the step is the sharpest of the spectrum.
    """
    power = np.abs(np.fft.fft2(frame - frame.mean())) ** 2
    return _border(power.mean(axis=1)), _border(power.mean(axis=0))


def _border(power: Array) -> float:
    half = len(power) // 2
    both = np.log10(power[1 : half + 1] + 1e-12 * power.max())
    drops = np.full(half, -np.inf)
    for k in range(max(_SIDE, int(LEAST_ACQUIRED * half)), half - _SIDE):
        # lowest inside against highest outside: one step, and not the fall of the object
        drops[k] = both[k - _SIDE : k].min() - both[k + 1 : k + 1 + _SIDE].max()
    border = int(np.argmax(drops))
    if not drops[border] > LEAST_DROP:
        return 1.0
    return float(min(1.0, (border + 0.5) / half))


def psf_of_noise(frame: Array) -> Psf:
    """The scanner's point spread by the colour of the noise in the air of a magnitude frame.

    Noise passes the same k-space window as the object but has no shape of its own, so this cannot
    take a soft object for a filter. Squares of air magnitudes at a lag are correlated by the square
    of the noise's own correlation there; the candidate that comes nearest to what is seen is
    taken. Flat k-space where another is not clearly nearer, or where the frame has too little air.
    """
    air = _air(frame)
    if np.count_nonzero(air) < LEAST_AIR_PX:
        return Psf()
    power = np.where(air, frame**2, 0.0)
    mean = power.sum() / air.sum()
    seen, pairs = _lagged(np.where(air, power / mean - 1, 0.0), air)
    shape = (frame.shape[0], frame.shape[1])

    def distance(psf: Psf) -> float:
        expected = np.array([[correlation(shape, psf, _LAGS)[abs(i), j] for j in range(_LAGS + 1)]
                             for i in range(-_LAGS, _LAGS + 1)]) ** 2  # fmt: skip
        return float(np.sum((pairs * (seen - expected) ** 2)[_USED]))

    fractions = (1.0, *FRACTIONS)
    candidates = [
        Psf(kind, parameters, (rows, cols))
        for kind, parameters in WINDOWS
        for rows in fractions
        for cols in fractions
    ]
    best = min(candidates, key=distance)
    return best if distance(best) < distance(Psf()) - LEAST_NOISE_GAIN else Psf()


def _air(frame: Array) -> Mask:
    """Blocks of pixels whose power is that of the quietest quarter, if they are Rayleigh noise."""
    n = _BLOCK_PX
    rows, cols = (size // n for size in frame.shape)
    air = np.zeros(frame.shape, dtype=bool)
    if rows * cols < 4:
        return air
    squares = frame[: rows * n, : cols * n].reshape(rows, n, cols, n) ** 2
    power = squares.mean(axis=(1, 3))
    quiet = power < _QUIET * np.percentile(power, 25)
    air[: rows * n, : cols * n] = np.kron(quiet, np.ones((n, n))) > 0
    values = frame[air]
    if not values.any():
        return np.zeros_like(air)
    ratio = float(values.mean() ** 2 / float(np.mean(values**2)))
    return air if abs(ratio - np.pi / 4) < _RAYLEIGH_WITHIN else np.zeros_like(air)


def _lagged(values: Array, air: Mask) -> tuple[Array, Array]:
    """Mean product of air pixels at lags (-L..L, 0..L), and how many pairs that is of."""
    seen = np.zeros((2 * _LAGS + 1, _LAGS + 1))
    pairs = np.zeros_like(seen)
    rows, cols = values.shape
    for i in range(-_LAGS, _LAGS + 1):
        for j in range(_LAGS + 1):
            here = np.s_[max(0, -i) : rows - max(0, i), : cols - j]
            there = np.s_[max(0, i) : rows - max(0, -i), j:]
            pairs[i + _LAGS, j] = np.count_nonzero(air[here] & air[there])
            seen[i + _LAGS, j] = np.sum(values[here] * values[there])
    return seen / np.maximum(pairs, 1), pairs


def recognise_psf(
    frame: Array,
    pixels: Pixels,
    start: tuple[float, float, float],
    radius_bounds_px: tuple[float, float],
    noise: NoiseKind = "rician",
) -> Psf:
    """The point spread through which the object at start (row, col, radius) is explained best.

    frame: the whole frame. pixels: the region of the object in it. Magnitudes (Rician) are taken
    for a scanner's, others for a camera's or a scanner's. Flat k-space unless another is clearly
    better.
    """

    def score(psf: Psf) -> float:
        return _score(pixels, start, psf, radius_bounds_px, noise)

    acquired = acquired_fraction(frame)
    plain = Psf("flat", acquired=acquired)
    candidates = [Psf(kind, parameters, acquired) for kind, parameters in WINDOWS]
    if acquired == (1.0, 1.0):
        candidates += [Psf(k, p, (f, f)) for k, p in WINDOWS for f in FRACTIONS]
        if noise == "gaussian":
            candidates += CAMERAS
    best = min(candidates, key=score)
    if acquired == (1.0, 1.0) and not best.folds:
        best = _one_axis_at_a_time(best, score)
    return best if score(best) < score(plain) - LEAST_GAIN else plain


def _one_axis_at_a_time(psf: Psf, score: Callable[[Psf], float]) -> Psf:
    """Fraction of rows, fraction of columns and window, in turn, that explain more."""
    for _ in range(2):
        rows = [replace(psf, acquired=(f, psf.acquired[1])) for f in (1.0, *FRACTIONS)]
        psf = min([psf, *rows], key=score)
        cols = [replace(psf, acquired=(psf.acquired[0], f)) for f in (1.0, *FRACTIONS)]
        psf = min([psf, *cols], key=score)
        kinds = [Psf(kind, parameters, psf.acquired) for kind, parameters in WINDOWS]
        psf = min([psf, *kinds], key=score)
    return psf


def _score(
    pixels: Pixels,
    start: tuple[float, float, float],
    psf: Psf,
    bounds: tuple[float, float],
    noise: NoiseKind,
) -> float:
    """Minus twice the log likelihood of the fit, but for a constant; infinite if it fails."""
    try:
        fit = fit_disc(
            pixels, start, psf, radius_bounds_px=bounds, noise=noise, robust=False, whiten=False
        )
    except NotConvergedError:
        return np.inf
    return 2 * fit.n_pixels * float(np.log(fit.sigma))
