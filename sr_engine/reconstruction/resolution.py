"""What a frame can show at all: shapes above its resolution, steps above a grey level.

A spot smaller than the point spread looks the same whatever its shape, so nothing can be said of
its being round; and where a frame holds few grey levels (a thresholded one), what touches by chance
at one level has edges as sharp as a real object's.
"""

import numpy as np
from numpy.typing import NDArray

from sr_engine.model import DISC, Patch, unit_object
from sr_engine.psf import Psf

Array = NDArray[np.float64]

LEAST_RADIUS_PX = 1.5  # three pixels across
_REACH_PX = 6
_RADII_PX = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0)
_AWAY_PX = (-0.35, 0.0, 0.35)  # the matched filter places a small object to about this


def grey_step(frame: Array) -> float:
    """Smallest difference between two values of the frame; next to nothing without grey levels."""
    return float(np.min(np.diff(np.unique(frame)), initial=np.inf))


def radius_seen_px(frame: Array, centre_px: tuple[float, float]) -> float:
    """Radius of the disc that explains best, by least squares, what is at a small object's place.

    centre_px: (row, col), within half a pixel. Between two trial radii the vertex of a parabola.
    """
    spans = [
        np.arange(max(0, round(c) - _REACH_PX), min(n, round(c) + _REACH_PX + 1), dtype=float)
        for c, n in zip(centre_px, frame.shape, strict=True)
    ]
    patch = Patch(spans[0], spans[1], (4 * _REACH_PX, 4 * _REACH_PX))
    values = frame[
        int(spans[0][0]) : int(spans[0][-1]) + 1, int(spans[1][0]) : int(spans[1][-1]) + 1
    ]
    x_row, x_col = np.meshgrid(spans[0] - centre_px[0], spans[1] - centre_px[1], indexing="ij")
    near = np.hypot(x_row, x_col) < _REACH_PX
    surroundings, _ = np.linalg.qr(
        np.stack([np.ones(near.sum()), x_row[near], x_col[near]], axis=1)
    )
    left = [_least_left(values[near], surroundings, patch, near, centre_px, r) for r in _RADII_PX]
    return _vertex(np.array(_RADII_PX), np.array(left))


def _least_left(
    values: Array,
    surroundings: Array,
    patch: Patch,
    near: NDArray[np.bool_],
    centre_px: tuple[float, float],
    radius_px: float,
) -> float:
    """Least sum of squares that a disc of this radius, about there, leaves."""
    values = values - surroundings @ (surroundings.T @ values)
    least = np.inf
    for d_row in _AWAY_PX:
        for d_col in _AWAY_PX:
            centre = (centre_px[0] + d_row, centre_px[1] + d_col)
            disc = unit_object(patch, Psf(), DISC, centre, radius_px)[0][near]
            disc = disc - surroundings @ (surroundings.T @ disc)
            least = min(least, float(values @ values - (values @ disc) ** 2 / (disc @ disc)))
    return least


def _vertex(radii: Array, left: Array) -> float:
    best = int(np.argmin(left))
    if not 0 < best < len(radii) - 1:
        return float(radii[best])
    a, b, _ = np.polyfit(radii[best - 1 : best + 2] - radii[best], left[best - 1 : best + 2], 2)
    return float(radii[best] - b / (2 * a)) if a > 0 else float(radii[best])
