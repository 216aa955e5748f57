"""How far the centre of a disc may be wrong because what is there is no disc.

An outline that is the same on both sides of the centre leaves the centre where it is, whatever its
shape: an oval, a ring, a soft edge. What differs from side to side (a shell that is shifted, a
neighbour, tissue that touches) draws it: at most by as much as a displacement of the edge would
take to leave as much about the edge. That is beside what noise does, and common to all frames of
an object.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sr_engine.fit import DiscFit
from sr_engine.noise import NoiseKind
from sr_engine.signal import Pixels

Array = NDArray[np.float64]

_BLOCK_PX = 8
_RAYLEIGH, _WITHIN = np.pi / 4, 0.04  # mean squared over mean square of air
_RAYLEIGH_VARIANCE = 2 - np.pi / 2
_NOISE_SHARE = 0.75  # of the noise's power, in what differs from side to side; half is expected
_EDGE_PX = 2.5  # to either side of it


def frame_noise(frame: Array, noise: NoiseKind) -> float:
    """Noise std per channel by the quietest quarter of a frame (rows, cols)."""
    rows, cols = (size // _BLOCK_PX for size in frame.shape)
    blocks = frame[: rows * _BLOCK_PX, : cols * _BLOCK_PX]
    blocks = blocks.reshape(rows, _BLOCK_PX, cols, _BLOCK_PX).swapaxes(1, 2)
    blocks = blocks.reshape(rows * cols, -1)
    variance = blocks.var(axis=1)
    quiet = blocks[variance <= np.percentile(variance, 25)]
    power = float(np.mean(quiet**2))
    is_air = (
        noise == "rician"
        and power > 0
        and abs(float(quiet.mean()) ** 2 / power - _RAYLEIGH) < _WITHIN
    )
    if is_air:
        return float(np.sqrt(power / 2))
    typical = float(np.median(variance))
    return float(np.sqrt(typical / (_RAYLEIGH_VARIANCE if noise == "rician" else 1.0)))


def with_lopsidedness(fit: DiscFit, pixels: Pixels, noise_std: float) -> DiscFit:
    """The fit, its covariance widened by what differs from side to side beyond noise."""
    power, count = _odd_power(fit, pixels)
    excess = power - _NOISE_SHARE * noise_std**2
    contrast = fit.snr * fit.sigma
    if not (excess > 0 and contrast > 0):
        return fit
    # an edge of this contrast, displaced by d, leaves pi R (d contrast)^2 in all
    drawn = float(np.sqrt(count * excess / (np.pi * fit.outer_px))) / contrast
    covariance = fit.covariance.copy()
    covariance[:2, :2] += np.eye(2) * min(drawn, fit.outer_px / 2) ** 2
    return replace(fit, covariance=covariance)


def _odd_power(fit: DiscFit, pixels: Pixels) -> tuple[float, int]:
    """Mean square of half the difference of what is left from side to side, and of how many pixels.

    About the edge: shading that no straight line follows is lopsided too, but moves no edge.
    """
    patch, left = pixels.patch, fit.residual
    row, col = (
        2 * centre - axis - axis[0]
        for centre, axis in zip(fit.centre_px, (patch.rows, patch.cols), strict=True)
    )
    places = np.broadcast_arrays(row[:, None], col[None, :])
    seen = map_coordinates(left, places, order=1, mode="constant")
    counts = map_coordinates(pixels.mask.astype(float), places, order=1, mode="constant") > 0.99
    away = np.hypot(
        (patch.rows - fit.centre_px[0])[:, None], (patch.cols - fit.centre_px[1])[None, :]
    )
    both = counts & pixels.mask & (np.abs(away - fit.outer_px) <= _EDGE_PX)
    count = int(np.count_nonzero(both))
    return (float(np.mean((left - seen)[both] ** 2)) / 4 if count else 0.0), count
