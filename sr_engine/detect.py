"""Which round objects are in a frame: candidates for the fit, none where there is none.

Matched filters find candidates at every radius of the range, large radii on a coarser copy of the
frame; a candidate must then explain what is under its edge, stand out from the noise and from the
grey levels' own steps, be large enough to show a shape, and have its edge in all directions, on a
circle.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.checks import checked_frames, checked_radii
from sr_engine.errors import ParameterError, ShapeError
from sr_engine.match import Match, best_matches, correlate, radius_grid
from sr_engine.reconstruction.resolution import LEAST_RADIUS_PX, grey_step, radius_seen_px
from sr_engine.roundness import REACH_PX, out_of_round_px, refine_circle, roundness

Array = NDArray[np.float64]

DEFAULT_RADII_PX = (2.0, 40.0)
LEAST_EXPLAINED = 0.45
SMALL_PX, LEAST_EXPLAINED_SMALL = 3.0, 0.65  # few pixels look like anything: they must fit better
LARGE_PX = 5.5  # from here on LEAST_EXPLAINED is enough
LEAST_SIGNIFICANCE = 100.0
LEAST_COVERAGE = 0.8
LEAST_SHARPNESS = 0.08  # of the edge's profile, not explained by a straight slope
SOFT_REACHES_PX, MOST_REACH = (4.5, 6.0), 0.8  # px, of the radius: bands of a soft edge's profile
LEAST_CONTRAST = 4.0  # of the edge, over the noise of a sector of it
LEAST_GREY_STEPS = 4.0  # of the edge: the corners of one or two levels are round by chance
MOST_OUT_OF_ROUND_PX, MOST_OUT_OF_ROUND = 0.4, 0.02  # px, or of the radius if that is more
_MAY_BE_A_SPOT_PX = 3.0  # radii of templates up to which an unresolved spot may match
_OCTAVE_PX = 24.0  # radii above are looked for on a frame of half the size
_CANDIDATES_PER_OBJECT = 3


@dataclass(frozen=True)
class Candidate:
    """A round object: centre (row, col), radius, and how sure it is.

    strength: share of the variance about the edge that a round object explains, times the share
    of directions in which the edge is there; 0 to 1.
    """

    centre_px: tuple[float, float]
    radius_px: float
    strength: float
    coverage: float
    sharpness: float
    contrast: float


def detect(
    frame: ArrayLike,
    radius_px: tuple[float, float] | float | None = None,
    *,
    max_objects: int = 50,
    roi: tuple[int, int, int, int] | None = None,
) -> list[Candidate]:
    """All round objects of a frame (rows, cols), strongest first; an empty list where none is.

    radius_px: (low, high) or one number within 25 %; default 2 to 40 px. What is smaller than
    1.5 px is not resolved, so that its shape cannot be told: it is never offered.
    roi: (row0, col0, row1, col1), centres are looked for in row0 <= row < row1 and likewise.
    An object may be brighter or darker than what surrounds it, or have only a wall.
    Objects inside of larger ones (vials in a phantom) are found beside them.
    Raises NotFiniteError, ConstantFrameError, ShapeError, ParameterError.
    """
    image = checked_frames(frame)[0]
    if max_objects < 1:
        raise ParameterError(f"max_objects must be at least 1, is {max_objects}")
    radii = _resolvable(checked_radii(radius_px) or DEFAULT_RADII_PX)
    bounds = checked_roi(roi, (image.shape[0], image.shape[1]))
    matches: list[Match] = []
    for scale, low, high in _octaves(radii, image.shape):
        matches += _matches_at_scale(image, scale, (low, high), max_objects)
    matches.sort(key=lambda m: -m.explained)
    least_contrast = LEAST_GREY_STEPS * grey_step(image)
    found: list[Candidate] = []
    for match in matches:
        if not _within(match.centre_px, bounds) or _is_known(match, found):
            continue
        candidate = _verified(image, match, least_contrast)
        if candidate is not None:
            found.append(candidate)
    found.sort(key=lambda c: -c.strength)
    return found[:max_objects]


def _resolvable(radii: tuple[float, float]) -> tuple[float, float]:
    if radii[1] <= LEAST_RADIUS_PX:
        raise ParameterError(
            f"round objects of radius {radii[0]:.2f} to {radii[1]:.2f} px cannot be told from "
            f"other spots; shape is visible only from {LEAST_RADIUS_PX:g} px up"
        )
    return max(radii[0], LEAST_RADIUS_PX), radii[1]


def checked_roi(
    roi: tuple[int, int, int, int] | None, shape: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The region of interest, or the whole frame."""
    if roi is None:
        return 0, 0, shape[0], shape[1]
    row0, col0, row1, col1 = roi
    if not (0 <= row0 < row1 <= shape[0] and 0 <= col0 < col1 <= shape[1]):
        raise ShapeError(f"region {roi} is empty or not inside a frame of {shape}")
    return row0, col0, row1, col1


def _octaves(radii: tuple[float, float], shape: tuple[int, ...]) -> list[tuple[int, float, float]]:
    """(scale, low, high): radii of the full frame to look for on a copy 1/scale as large."""
    low, high = radii[0], min(radii[1], min(shape) / 2)
    octaves = []
    scale = 1
    while low < high:
        top = min(high, _OCTAVE_PX * scale) if min(shape) / scale > 16 else high
        if top > low:
            octaves.append((scale, low, top))
            low = top
        scale *= 2
    return octaves


def _matches_at_scale(
    image: Array, scale: int, radii: tuple[float, float], max_objects: int
) -> list[Match]:
    coarse = _shrunk(image, scale)
    grid = radius_grid(radii[0] / scale, radii[1] / scale)
    found = []
    for with_wall in (False, True):
        correlation = correlate(coarse, grid, with_wall)
        count = _CANDIDATES_PER_OBJECT * max_objects
        found += best_matches(correlation, count, 3.0, LEAST_EXPLAINED)
    half = (scale - 1) / 2  # the first coarse pixel is centred on this fine index
    return [
        Match(
            (m.centre_px[0] * scale + half, m.centre_px[1] * scale + half),
            m.radius_px * scale,
            m.explained,
            m.n_pixels,
        )
        for m in found
        if m.significance > LEAST_SIGNIFICANCE and m.explained > _least_explained(m.radius_px)
    ]


def _least_explained(radius_px: float) -> float:
    radii, shares = (SMALL_PX, LARGE_PX), (LEAST_EXPLAINED_SMALL, LEAST_EXPLAINED)
    return float(np.interp(radius_px, radii, shares))


def _shrunk(image: Array, scale: int) -> Array:
    """Means of blocks of scale x scale pixels; what does not fill a block is left out."""
    rows, cols = (n // scale for n in image.shape)
    blocks = image[: rows * scale, : cols * scale].reshape(rows, scale, cols, scale)
    return np.asarray(blocks.mean(axis=(1, 3)))


def _within(centre_px: tuple[float, float], roi: tuple[int, int, int, int]) -> bool:
    row0, col0, row1, col1 = roi
    return row0 - 0.5 <= centre_px[0] < row1 - 0.5 and col0 - 0.5 <= centre_px[1] < col1 - 0.5


def _is_known(match: Match, found: list[Candidate]) -> bool:
    """True where a stronger candidate overlaps: the same object, or a part of its edge.

    An object well inside of a larger one is another object; one about the same centre is not,
    unless it is less than half as large.
    """
    for other in found:
        distance = np.hypot(
            match.centre_px[0] - other.centre_px[0], match.centre_px[1] - other.centre_px[1]
        )
        small, large = sorted((match.radius_px, other.radius_px))
        if distance < 0.7 * (small + large) and distance + small > 0.8 * large:
            return True
        if distance + small <= 0.8 * large and small > 0.5 * large:
            return True
    return False


def _sharpness(image: Array, centre: tuple[float, float], radius: float, seen: float) -> float:
    """Of the edge over as wide a band as it is soft: a filtered, zero-filled edge takes 4 to 6 px.

    Never wider than most of the radius: over a small part of it the hill of a coil stays straight.
    """
    reaches = [r for r in SOFT_REACHES_PX if r <= MOST_REACH * radius]
    return max([seen, *(roundness(image, centre, radius, r).sharpness for r in reaches)])


def _verified(image: Array, match: Match, least_contrast: float) -> Candidate | None:
    """The candidate with its circle drawn through its edge, if that is round and sharp."""
    centre, radius = match.centre_px, match.radius_px
    if radius > _OCTAVE_PX / 2:  # smaller ones are placed well enough by the filter
        centre, radius = refine_circle(image, centre, radius, REACH_PX + 0.06 * radius)
    moved = np.hypot(centre[0] - match.centre_px[0], centre[1] - match.centre_px[1])
    if moved > 0.25 * match.radius_px or not 0.7 < radius / match.radius_px < 1.4:
        return None
    seen = roundness(image, centre, radius)
    inside = all(
        radius - 0.5 <= x <= n - 0.5 - radius for x, n in zip(centre, image.shape, strict=True)
    )
    real = (
        seen.coverage >= LEAST_COVERAGE
        and _sharpness(image, centre, radius, seen.sharpness) >= LEAST_SHARPNESS
        and seen.contrast > LEAST_CONTRAST * seen.noise
        and seen.contrast >= least_contrast
    )
    if not (real and inside):
        return None
    if radius < _MAY_BE_A_SPOT_PX and radius_seen_px(image, centre) < LEAST_RADIUS_PX:
        return None
    allowed_px = max(MOST_OUT_OF_ROUND_PX, MOST_OUT_OF_ROUND * radius)
    if out_of_round_px(image, centre, radius) > allowed_px:
        return None
    strength = match.explained * seen.coverage
    return Candidate(centre, radius, strength, seen.coverage, seen.sharpness, seen.contrast)
