"""Which thing in the frames moves as the robot moved: no shape is presumed.

Frames laid over each other by the known displacements agree where the object is, and laid over each
other as they are where things stand still. The object is where the first explains the pixels and
the second does not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, gaussian_filter, label

from sr_engine.errors import TemplateError

Array = NDArray[np.float64]

DEFAULT_RADII_PX = (1.5, 20.0)
LEAST_SPREAD_PX = 0.15  # rms of the displacements about their mean, of either axis or both
_SMOOTH_PX = 3.0
_LEAST_EVIDENCE = 12.0  # of the highest place, over the scatter of the others
_OUTLINE = 0.3  # of the contrast
_NEAR_PX = 3.0


@dataclass(frozen=True, eq=False)
class Moving:
    """centre_px (row, col) in the reference pose; radius_px of the disc of the outline's area."""

    centre_px: Array
    radius_px: float


def moving_object(
    frames: Array,
    shifts_px: Array,
    radius_px: tuple[float, float] | None = None,
    near_px: Array | None = None,
) -> Moving:
    """The compact object that moves by shifts_px (M, 2) in frames (M, rows, cols).

    near_px: where to look, within 3 px. Raises TemplateError where nothing moves that way, or
    where what moves is no compact object of radius_px (low, high).
    """
    low, high = radius_px or DEFAULT_RADII_PX
    spread = float(np.sqrt(np.mean(np.sum((shifts_px - shifts_px.mean(axis=0)) ** 2, axis=1))))
    if near_px is None and not spread > LEAST_SPREAD_PX:
        raise TemplateError(
            f"the displacements differ by only {spread:.2f} px: the moving object cannot be told "
            "from the static background"
        )
    back = np.array([_moved(f, -d) for f, d in zip(frames, shifts_px, strict=True)])
    together = np.median(back, axis=0) if len(back) > 4 else back.mean(axis=0)
    peak = _peak(frames, shifts_px, back, together) if near_px is None else np.rint(near_px)
    return _outlined(together, peak.astype(int), (low, high))


def _moved(image: Array, by_px: Array) -> Array:
    """Between pixels along straight lines; beyond the border as at it."""
    for axis, by in enumerate(by_px):
        whole = int(np.floor(by))
        places = np.arange(image.shape[axis]) - whole
        last = image.shape[axis] - 1
        here = image.take(np.clip(places, 0, last), axis)
        before = image.take(np.clip(places - 1, 0, last), axis)
        image = here + (by - whole) * (before - here)
    return image


def _peak(frames: Array, shifts_px: Array, back: Array, together: Array) -> Array:
    still = frames.mean(axis=0)
    as_still = np.array([_moved(still, -d) for d in shifts_px])
    gain = np.sum((back - as_still) ** 2 - (back - together) ** 2, axis=0)
    evidence = gaussian_filter(gain, _SMOOTH_PX)
    reach = int(np.ceil(np.max(np.abs(shifts_px)))) + 2
    inside = np.zeros(evidence.shape, dtype=bool)
    rows, cols = evidence.shape
    if 2 * reach < min(rows, cols):
        inside[reach : rows - reach, reach : cols - reach] = True
    else:
        inside[:] = True
    scatter = 1.4826 * float(np.median(np.abs(evidence - np.median(evidence)))) + 1e-300
    evidence = np.where(inside, evidence, -np.inf)
    peak = np.array(np.unravel_index(int(np.argmax(evidence)), evidence.shape))
    if not evidence[tuple(peak)] > _LEAST_EVIDENCE * scatter:
        raise TemplateError("nothing in the frames moves by the given displacements")
    return np.asarray(peak, dtype=float)


def _outlined(image: Array, peak: NDArray[np.int_], radii: tuple[float, float]) -> Moving:
    """The connected thing at the peak, holes filled."""
    half = int(np.ceil(2.5 * min(radii[1], 16.0))) + 4
    r0, c0 = np.maximum(peak - half, 0)
    part = gaussian_filter(image[r0 : peak[0] + half + 1, c0 : peak[1] + half + 1], 0.5)
    at = peak - (r0, c0)
    level = float(np.median(part))
    rows, cols = np.indices(part.shape)
    distance = np.hypot(rows - at[0], cols - at[1])
    near = distance <= max(_NEAR_PX, min(radii[1], 10.0))
    contrast = part - level
    strongest = float(np.max(np.abs(contrast[near])))
    sign = np.sign(contrast[near][int(np.argmax(np.abs(contrast[near])))])
    inside = sign * contrast > _OUTLINE * float(np.percentile(sign * contrast[near], 95))
    if strongest == 0 or not inside.any():
        raise TemplateError("the moving object has no contrast")
    pieces, _ = label(inside, structure=np.ones((3, 3)))
    closest = int(np.argmin(np.where(inside, distance, np.inf)))
    whole = binary_fill_holes(pieces == pieces.flat[closest])
    row, col = np.nonzero(whole)
    radius = float(np.sqrt(row.size / np.pi))
    if not 0.7 * radii[0] <= radius <= 1.4 * radii[1]:
        raise TemplateError(
            f"the moving object, at row {peak[0]}, col {peak[1]}, is as large as a disc of radius "
            f"{radius:.1f} px; {radii[0]:.1f} to {radii[1]:.1f} px are looked for"
        )
    return Moving(np.array([row.mean() + r0, col.mean() + c0]), radius)
