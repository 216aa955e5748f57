"""Where a disc of unknown radius fits best: normalised cross-correlation with ring templates.

A template of radius R is +1 inside of the edge and -1 outside, over a band of a few pixels on
either side, shifted to mean zero; a small disc is all band. The correlation with the pixels under
the band, divided by their own spread, runs from -1 (dark disc) to 1 (bright disc) whatever the
contrast and the level. Unit: pixels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Array = NDArray[np.float64]
BAND_PX = 3.0


@dataclass(frozen=True)
class Match:
    """One maximum of the correlation."""

    centre_px: tuple[float, float]
    radius_px: float
    score: float  # -1 to 1; negative: darker than what surrounds it


@lru_cache(maxsize=256)
def _template_spectra(
    shape: tuple[int, int], radius_px: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], float, float]:
    """Spectra of the template and of its support, the template's energy and the support's area."""
    row = np.fft.fftfreq(shape[0], 1 / shape[0])[:, None]
    col = np.fft.fftfreq(shape[1], 1 / shape[1])[None, :]
    distance = np.hypot(row, col)
    support = _soft_disc(distance, radius_px + BAND_PX) - _soft_disc(distance, radius_px - BAND_PX)
    template = 2 * _soft_disc(distance, radius_px) - 1
    template = support * (template - (support * template).sum() / support.sum())
    spectra = (scipy.fft.rfft2(template).conj(), scipy.fft.rfft2(support).conj())
    return *spectra, float((template**2).sum()), float(support.sum())


def _soft_disc(distance: Array, radius_px: float) -> Array:
    """Disc whose edge pixels count by how far they are inside."""
    if radius_px <= 0:
        return np.zeros_like(distance)
    return np.clip(radius_px + 0.5 - distance, 0.0, 1.0)


def correlate(frame: Array, radii_px: Array) -> Array:
    """Scores (radii, rows, cols) of a disc of each radius centred on each pixel.

    The frame is continued by its own mirror image, so that nothing wraps round.
    """
    pad = int(np.ceil(np.max(radii_px) + BAND_PX + 1))
    pad = min(pad, *(n - 1 for n in frame.shape))
    padded = np.pad(frame - frame.mean(), pad, mode="reflect")
    shape = tuple(scipy.fft.next_fast_len(n, real=True) for n in padded.shape)
    image = scipy.fft.rfft2(padded, shape)
    square = scipy.fft.rfft2(padded**2, shape)
    rows, cols = (slice(pad, pad + n) for n in frame.shape)
    scores = np.empty((len(radii_px), *frame.shape))
    floor = 1e-12 * float(np.mean(padded**2)) + 1e-300
    for i, radius in enumerate(radii_px):
        template, support, energy, area = _template_spectra((shape[0], shape[1]), float(radius))
        products = np.stack([image * template, image * support, square * support])
        signal, level, power = scipy.fft.irfft2(products, shape)[:, rows, cols]
        spread = np.maximum(power - level**2 / area, area * floor)
        scores[i] = signal / np.sqrt(energy * spread)
    return scores


def best_matches(scores: Array, radii_px: Array, count: int, apart_px: float) -> list[Match]:
    """Up to `count` highest |score|, best first.

    Centres are at least apart_px, and one and a half of the better one's radius, from each other.
    """
    strength = np.abs(scores).max(axis=0)
    matches: list[Match] = []
    remaining = strength.copy()
    rows, cols = np.indices(strength.shape)
    while len(matches) < count:
        row, col = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
        if not remaining[row, col] > 0:
            break
        which = int(np.argmax(np.abs(scores[:, row, col])))
        centre = _sub_pixel(np.abs(scores[which]), int(row), int(col))
        matches.append(Match(centre, float(radii_px[which]), float(scores[which, row, col])))
        remaining[np.hypot(rows - row, cols - col) < max(apart_px, 1.5 * radii_px[which])] = 0.0
    return matches


def radius_grid(low_px: float, high_px: float, step_px: float = 0.5) -> Array:
    """Radii from low to high, step_px or 6 % apart, whichever is more."""
    radii = [low_px]
    while radii[-1] < high_px:
        radii.append(min(radii[-1] + max(step_px, 0.06 * radii[-1]), high_px))
    return np.array(radii)


def _sub_pixel(score: Array, row: int, col: int) -> tuple[float, float]:
    """Vertex of the parabolas through a maximum; the pixel itself at a border."""
    place = [float(row), float(col)]
    for axis, index in enumerate((row, col)):
        if not 0 < index < score.shape[axis] - 1:
            continue
        step = (1, 0) if axis == 0 else (0, 1)
        before, here, after = (score[row + i * step[0], col + i * step[1]] for i in (-1, 0, 1))
        bend = before - 2 * here + after
        if bend < 0:
            place[axis] += float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
    return place[0], place[1]
