"""Where the middle of an object of unknown shape is, and how far that depends on what one means.

Displacements do not need it: the template's place is the same in all frames. A target that is not
recorded with the fiducial does: for it, circle through the outline and centroids of the outline at
several levels, with and without the signal as weight, are held against each other, and what they
differ by is the systematic part.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, label

from sr_engine.roundness import REACH_PX, refine_circle
from sr_engine.template.image import ObjectImage

Array = NDArray[np.float64]

_LEVELS = (0.35, 0.5, 0.65)  # of the plateau
_LEAST_PX = 0.02  # of the systematic part: what no outline of a frame tells
_FARTHEST = 0.5  # of the radius, from the middle of the patch


def absolute_centre(image: ObjectImage, radius_px: float) -> tuple[Array, Array]:
    """Offset (row, col) px of the middle from the template's origin, and its systematic std."""
    fine = _twice_as_fine(image)
    half = len(fine) / 2
    top = _plateau(fine, image.size, radius_px)
    estimates = []
    for level in _LEVELS:
        found = _centroid(fine > level * top)
        if found is not None:
            estimates.append((found - half) / 2)
        found = None if found is None else _weighted(fine, found, 2 * radius_px)
        if found is not None:
            estimates.append((found - half) / 2)
    circle, _ = refine_circle(fine, (half, half), 2 * radius_px, 2 * REACH_PX)
    estimates.append((np.array(circle) - half) / 2)
    near = [e for e in estimates if float(np.hypot(*e)) < _FARTHEST * radius_px]
    if not near:
        return np.zeros(2), np.full(2, _FARTHEST * radius_px / 2)
    middle = np.median(near, axis=0)
    spread = np.max(np.abs(np.array(near) - middle), axis=0)
    return np.asarray(middle), np.asarray(np.hypot(spread, _LEAST_PX))


def outline_middle(image: ObjectImage, radius_px: float) -> Array:
    """Offset (row, col) px of the outline's centroid from the template's origin."""
    fine = _twice_as_fine(image)
    found = _centroid(fine > 0.5 * _plateau(fine, image.size, radius_px))
    offset = (np.zeros(2) if found is None else (found - len(fine) / 2)) / 2
    return offset if float(np.hypot(*offset)) < _FARTHEST * radius_px else np.zeros(2)


def _plateau(fine: Array, size: int, radius_px: float) -> float:
    return float(np.percentile(fine, 100 * (1 - 0.5 * np.pi * radius_px**2 / size**2)))


def _twice_as_fine(image: ObjectImage) -> Array:
    """(2n, 2n): index 2i + p of an axis is the pixel i - n//2 + p/2."""
    n = image.size
    fine = np.empty((2 * n, 2 * n))
    for p in (0, 1):
        for q in (0, 1):
            fine[p::2, q::2] = image.at(np.array([-p / 2, -q / 2]))[0]
    return fine


def _centroid(inside: NDArray[np.bool_]) -> Array | None:
    """Of the filled piece that lies nearest to the middle."""
    pieces, count = label(inside)
    if not count:
        return None
    rows, cols = np.indices(inside.shape)
    distance = np.hypot(rows - len(inside) / 2, cols - len(inside) / 2)
    nearest = pieces.flat[int(np.argmin(np.where(inside, distance, np.inf)))]
    row, col = np.nonzero(binary_fill_holes(pieces == nearest))
    return np.array([row.mean(), col.mean()])


def _weighted(fine: Array, middle: Array, radius: float) -> Array:
    """Centroid of the signal within the outline: uneven where a shift or a field is at work."""
    rows, cols = np.indices(fine.shape)
    weight = fine * (np.hypot(rows - middle[0], cols - middle[1]) < radius + 1)
    return np.array([np.sum(rows * weight), np.sum(cols * weight)]) / max(
        float(weight.sum()), 1e-300
    )
