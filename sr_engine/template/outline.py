"""A compact object of any shape in one frame, roughly: where a template begins that nobody has yet.

A ring with a hole, an odd outline: what stands out from its surroundings in one piece, holes
filled, of about the right size. Its centre is good to a fraction of a pixel, and says so.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, find_objects, gaussian_filter, label

from sr_engine.errors import AmbiguousObjectError, NoRoundObjectError

Array = NDArray[np.float64]

SIGMA_PX = 0.35  # of the centre: pixels of the outline that noise gives or takes
_SMOOTH_PX = 0.7
_LEAST_SIGMA = 6.0  # of the noise, that a piece stands out by
_LEVEL = 0.35  # of the strongest contrast
_SIZES = (0.8, 1.25)  # of the radii asked for
_LEAST_COMPACT = 0.55  # area over that of the circle about it
_STRAIGHT = np.ones((3, 3))


def compact_object(image: Array, radius_px: tuple[float, float]) -> tuple[Array, float]:
    """(row, col) and radius of the disc of the same area, of the one compact object of a frame.

    Raises NoRoundObjectError where there is none of radius_px (low, high), AmbiguousObjectError
    where there are several.
    """
    smooth = gaussian_filter(image, _SMOOTH_PX)
    contrast = smooth - np.median(smooth)
    noise = 1.4826 * float(np.median(np.abs(np.diff(smooth, axis=1)))) / np.sqrt(2)
    level = max(_LEAST_SIGMA * noise, _LEVEL * float(np.percentile(contrast, 99.5)))
    pieces, count = label(contrast > level, structure=_STRAIGHT)
    found = []
    for number, place in enumerate(find_objects(pieces), start=1):
        one = _measured(pieces[place] == number, radius_px)
        touches = any(s.start == 0 or s.stop == n for s, n in zip(place, image.shape, strict=True))
        if one is not None and not touches:
            found.append((one[0] + (place[0].start, place[1].start), one[1]))
    if not found:
        raise NoRoundObjectError(
            f"none of the {count} pieces that stand out is compact and of radius "
            f"{radius_px[0]:.1f} to {radius_px[1]:.1f} px"
        )
    if len(found) > 1:
        (row, col), (row2, col2) = found[0][0], found[1][0]
        raise AmbiguousObjectError(
            f"{len(found)} compact objects are of the right size, at row {row:.0f} col {col:.0f} "
            f"and at row {row2:.0f} col {col2:.0f}: give a region or a narrower radius range"
        )
    return found[0]


def _measured(
    piece: NDArray[np.bool_], radius_px: tuple[float, float]
) -> tuple[Array, float] | None:
    row, col = np.nonzero(binary_fill_holes(np.pad(piece, 1)))
    centre = np.array([row.mean(), col.mean()])
    radius = float(np.sqrt(row.size / np.pi))
    around = float(np.hypot(row - centre[0], col - centre[1]).max()) + 0.5
    fits = _SIZES[0] * radius_px[0] <= radius <= _SIZES[1] * radius_px[1]
    return (centre - 1, radius) if fits and (radius / around) ** 2 >= _LEAST_COMPACT else None
