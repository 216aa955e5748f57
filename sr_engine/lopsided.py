"""How far the centre of a disc may be wrong because what is there is no disc.

An outline that is the same on both sides of the centre leaves the centre where it is, whatever its
shape: an oval, a ring, a soft edge. What differs from side to side (a shell that is shifted, a
neighbour, tissue that touches) draws it: by about as much as a displacement of the edge would take
to leave as much about the edge, and by as much as the centroid of what is left lies apart. That is
beside what noise does, and common to all frames of an object: it counts where the place itself
does, and cancels between places of one object.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sr_engine.fit import DiscFit
from sr_engine.noise import NoiseKind
from sr_engine.signal import Mask, Pixels

Array = NDArray[np.float64]

_BLOCK_PX = 8
_RAYLEIGH, _WITHIN = np.pi / 4, 0.04  # mean squared over mean square of air
_RAYLEIGH_VARIANCE = 2 - np.pi / 2
_NOISE_SHARE = 0.75  # of the noise's power, in what differs from side to side; half is expected
_EDGE_PX = 2.5  # to either side of it
_MISFIT = 1.6  # chi2 a pixel, by the fit's own noise level
_SURE_SIGMA = 4.0  # of the noise in a centroid, beyond which it lies apart


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
    """The fit, with the std (row, col) of what draws its centre in all frames alike."""
    contrast = fit.snr * fit.sigma
    if not contrast > 0:
        return fit
    away, other, both = _mirrored(fit, pixels)
    drawn = _drawn_px(fit, other, both & (np.abs(away - fit.outer_px) <= _EDGE_PX), noise_std)
    apart = _apart_px(fit, pixels, both & (away <= fit.outer_px + _EDGE_PX), noise_std)
    # where the rounds of the fit found no one noise level, what is left tells too little
    grown = np.sqrt(fit.chi2_per_dof) if fit.chi2_per_dof > _MISFIT else 1.0
    systematic = np.minimum(grown * np.hypot(drawn, apart) / contrast, fit.outer_px / 2)
    return replace(fit, systematic_px=systematic)


def _mirrored(fit: DiscFit, pixels: Pixels) -> tuple[Array, Array, Mask]:
    """Of each pixel: distance from the centre, what is left on the other side of it, and whether
    both count."""
    patch, mask = pixels.patch, pixels.mask
    row, col = (
        2 * centre - axis - axis[0]
        for centre, axis in zip(fit.centre_px, (patch.rows, patch.cols), strict=True)
    )
    places = np.broadcast_arrays(row[:, None], col[None, :])
    other = map_coordinates(fit.residual, places, order=3, mode="constant")
    counts = map_coordinates(mask.astype(float), places, order=1, mode="constant") > 0.99
    away = np.hypot(
        (patch.rows - fit.centre_px[0])[:, None], (patch.cols - fit.centre_px[1])[None, :]
    )
    return away, other, counts & mask


def _drawn_px(fit: DiscFit, other: Array, edge: Mask, noise_std: float) -> float:
    """By what differs from side to side about the edge, times the contrast.

    Shading that no straight line follows is lopsided too, but moves no edge.
    """
    power = float(np.sum((fit.residual - other)[edge] ** 2)) / 4
    excess = power - _NOISE_SHARE * noise_std**2 * np.count_nonzero(edge)
    # an edge of this contrast, displaced by d, leaves pi R (d contrast)^2 in all
    return float(np.sqrt(max(excess, 0.0) / (np.pi * fit.outer_px)))


def _apart_px(fit: DiscFit, pixels: Pixels, inside: Mask, noise_std: float) -> Array:
    """How far the centroid lies from where the edge says the centre is, times the contrast."""
    both = np.broadcast_arrays(
        (pixels.patch.rows - fit.centre_px[0])[:, None],
        (pixels.patch.cols - fit.centre_px[1])[None, :],
    )
    arms = np.array([arm[inside] for arm in both])
    moments = arms @ fit.residual[inside]
    chance = noise_std * np.sqrt(np.sum(arms**2, axis=1))
    beyond = np.where(np.abs(moments) > _SURE_SIGMA * chance, np.abs(moments), 0.0)
    return np.asarray(beyond / (np.pi * fit.outer_px**2))
