"""Where a round object of unknown radius fits best: multiple correlation with ring templates.

Two templates of radius R over a band of a few pixels on either side of the edge: `disc`, 1 inside
and 0 outside, and `wall`, 1 on a ring about the edge. Together with a constant they describe a disc
brighter or darker than what surrounds it, with or without a shell. The share of the variance under
the band that they explain runs from 0 to 1 whatever the contrast and the level.
Unit: pixels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
BAND_PX = 3.0
WALL_PX = 1.5


@dataclass(frozen=True)
class Match:
    """One maximum of the correlation."""

    centre_px: tuple[float, float]
    radius_px: float
    explained: float  # share of variance under the band, 0 to 1
    n_pixels: float  # under the band

    @property
    def significance(self) -> float:
        """Growth of chi2 without the object: what noise alone rarely brings above 40."""
        return self.n_pixels * self.explained / max(1 - self.explained, 1e-9)


@dataclass(frozen=True, eq=False)
class Correlation:
    """Explained share (radii, rows, cols), the radii, and the pixels under each band."""

    explained: Array
    radii_px: Array
    n_pixels: Array


@dataclass(frozen=True, eq=False)
class _Template:
    spectra: Complex  # (3, rows, cols//2+1): two orthonormal templates, and the support
    area: float


@lru_cache(maxsize=128)
def _template(shape: tuple[int, int], radius_px: float, with_wall: bool) -> _Template:
    row = np.fft.fftfreq(shape[0], 1 / shape[0])[:, None]
    col = np.fft.fftfreq(shape[1], 1 / shape[1])[None, :]
    distance = np.hypot(row, col)
    reach = radius_px + BAND_PX + (WALL_PX if with_wall else 0.0)
    support = _soft_disc(distance, reach) - _soft_disc(distance, radius_px - BAND_PX)
    disc = _soft_disc(distance, radius_px)
    wall = _soft_disc(distance, radius_px + WALL_PX) - disc
    # columns of a weighted least squares, made orthonormal under the support
    root = np.sqrt(support).ravel()
    columns = [np.ones(root.size), disc.ravel()] + ([wall.ravel()] if with_wall else [])
    basis, _ = np.linalg.qr(np.stack(columns, axis=1) * root[:, None])
    images = [(basis[:, i] * root).reshape(shape) for i in range(1, basis.shape[1])]
    spectra = scipy.fft.rfft2(np.stack([*images, support])).conj()
    return _Template(spectra, float(support.sum()))


def _soft_disc(distance: Array, radius_px: float) -> Array:
    """Disc whose edge pixels count by how far they are inside."""
    if radius_px <= 0:
        return np.zeros_like(distance)
    return np.clip(radius_px + 0.5 - distance, 0.0, 1.0)


def correlate(frame: Array, radii_px: Array, with_wall: bool = False) -> Correlation:
    """How well an object of each radius, centred on each pixel, explains the frame.

    The frame is continued by its own mirror image, so that nothing wraps round.
    """
    pad = int(np.ceil(np.max(radii_px) + BAND_PX + WALL_PX + 1))
    pad = min(pad, *(n - 1 for n in frame.shape))
    padded = np.pad(frame - frame.mean(), pad, mode="reflect")
    shape = tuple(scipy.fft.next_fast_len(n, real=True) for n in padded.shape)
    image = scipy.fft.rfft2(padded, shape)
    square = scipy.fft.rfft2(padded**2, shape)
    rows, cols = (slice(pad, pad + n) for n in frame.shape)
    explained = np.empty((len(radii_px), *frame.shape))
    areas = np.empty(len(radii_px))
    floor = 1e-9 * float(np.mean(padded**2)) + 1e-300
    for i, radius in enumerate(radii_px):
        template = _template((shape[0], shape[1]), float(radius), with_wall)
        products = np.concatenate([image * template.spectra, (square * template.spectra[-1])[None]])
        *signals, level, power = scipy.fft.irfft2(products, shape)[:, rows, cols]
        spread = np.maximum(power - level**2 / template.area, template.area * floor)
        explained[i] = np.minimum(sum(signal**2 for signal in signals) / spread, 1.0)
        areas[i] = template.area
    return Correlation(explained, radii_px, areas)


def best_matches(
    found: Correlation, count: int, apart_px: float, least: float = 0.0
) -> list[Match]:
    """Up to `count` matches that explain more than `least`, best first.

    Centres are at least apart_px, and one and a half of the better one's radius, from each other.
    """
    remaining = found.explained.max(axis=0)
    rows, cols = np.indices(remaining.shape)
    matches: list[Match] = []
    while len(matches) < count:
        row, col = (int(i) for i in np.unravel_index(int(np.argmax(remaining)), remaining.shape))
        if not remaining[row, col] > least:
            break
        which = int(np.argmax(found.explained[:, row, col]))
        share = found.explained[which]
        radius = float(found.radii_px[which])
        centre = _sub_pixel(share, row, col)
        pixels = float(found.n_pixels[which])
        matches.append(Match(centre, radius, float(share[row, col]), pixels))
        apart = max(apart_px, 1.5 * radius)
        remaining[np.hypot(rows - row, cols - col) < apart] = -1.0
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
