"""Geometric accuracy: the vials of one plate as several scanners see them.

A scan's vial positions (mm) are matched to the plate's drawing, then laid over those of other
scanners by a similarity (shift, rotation, scale). The drawing is not the truth, because plates
are built to half a millimetre; what scanners agree on is nearer to it.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Order = NDArray[np.intp]

LARGEST_MISMATCH_MM = 3.0
FEWEST_VIALS = 10


def match_to_design(points_mm: Array, design_mm: Array) -> list[Order]:
    """All ways to read the points (n, 2) as the vials of the drawing (14, 2), best first.

    The drawing looks the same after half a turn and in a mirror, so there are several. Each is
    (14,) indices of points, -1 for a vial without a point within 3 mm. The points may hold other
    objects too.
    """
    centred = points_mm - np.median(points_mm, axis=0)
    found: list[tuple[float, Order]] = []
    for mirror in (1.0, -1.0):
        for degree in range(0, 360, 4):
            angle = np.radians(degree)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            left, order = _fitted((centred @ turn.T) * [1.0, mirror], design_mm)
            if np.isfinite(left) and not any(np.array_equal(order, other) for _, other in found):
                found.append((left, order))
    found.sort(key=lambda item: item[0])
    return [order for left, order in found if left < 1.5 * found[0][0] + 0.1]


def _fitted(turned: Array, design_mm: Array) -> tuple[float, Order]:
    """(rms distance in mm, nearest point to each vial), the shift refined; infinite if too few."""
    best, chosen = np.inf, np.full(len(design_mm), -1)
    for start in turned[np.argsort(np.hypot(*turned.T))[:4]]:
        # one of the innermost points is one of the inner square's vials
        for corner in design_mm[10:]:
            left, order = _settled(turned - start + corner, design_mm)
            if left < best:
                best, chosen = left, order
    return best, chosen


def _settled(moved: Array, design_mm: Array) -> tuple[float, Order]:
    for _ in range(3):
        distance = np.linalg.norm(design_mm[:, None] - moved[None], axis=2)
        nearest, least = distance.argmin(axis=1), distance.min(axis=1)
        near = least < LARGEST_MISMATCH_MM
        if near.sum() < FEWEST_VIALS or len(set(nearest[near])) < near.sum():
            return np.inf, nearest
        moved = moved + (design_mm[near] - moved[nearest[near]]).mean(axis=0)
    missing = LARGEST_MISMATCH_MM * np.count_nonzero(~near)  # more vials are a better match
    return float(np.sqrt(np.mean(least[near] ** 2)) + missing), np.where(near, nearest, -1)


def taken(points_mm: Array, order: Order) -> Array:
    """Points (14, 2) in the order of the drawing, NaN for vials without one."""
    return np.where(order[:, None] >= 0, points_mm[order], np.nan)


def similarity(source: Array, target: Array, mirror: bool = True) -> Array:
    """Source laid over target by shift, rotation, scale (and mirror); rows with NaN left out.

    Least squares (Umeyama 1991). Both (n, 2); the result is (n, 2), NaN where source is.
    """
    good = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    a, b = source[good], target[good]
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    u, s, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    sign = 1.0 if mirror else float(np.sign(np.linalg.det(u @ vt)))
    turn = u @ np.diag([1.0, sign]) @ vt
    scale = (s[0] + sign * s[1]) / np.sum((a - mean_a) ** 2)
    return np.asarray(scale * (source - mean_a) @ turn.T + mean_b)


def residuals_mm(source: Array, target: Array) -> Array:
    """What a similarity fit of source to target leaves, (n, 2), NaN where either is."""
    return similarity(source, target) - target


def residual_mm(source: Array, target: Array) -> float:
    """Rms distance of source from target after a similarity fit, for its 4 parameters."""
    left = residuals_mm(source, target)
    good = np.isfinite(left).all(axis=1)
    degrees = max(2 * int(good.sum()) - 4, 1)
    return float(np.sqrt(2 * np.sum(left[good] ** 2) / degrees))


def likeness(one_mm: Array, other_mm: Array) -> float:
    """Correlation of two sets of residuals (n, 2) in the same frame; rows with NaN left out."""
    good = np.isfinite(one_mm).all(axis=1) & np.isfinite(other_mm).all(axis=1)
    one, other = one_mm[good], other_mm[good]
    return float(np.sum(one * other) / np.sqrt(np.sum(one**2) * np.sum(other**2)))


def consensus(scans: list[Array], rounds: int = 10) -> Array:
    """Mean shape of several (14, 2) after laying them over each other (generalised Procrustes)."""
    mean = scans[0]
    for _ in range(rounds):
        laid = np.stack([similarity(scan, mean) for scan in scans])
        mean = np.nanmean(laid, axis=0)
    return mean


def in_one_order(points_mm: list[Array], orders: list[list[Order]]) -> list[Order]:
    """Of each scan's possible readings the one that agrees best with the scans before it."""
    chosen = [orders[0][0]]
    for points, possible in zip(points_mm[1:], orders[1:], strict=True):
        before = [taken(p, o) for p, o in zip(points_mm, chosen, strict=False)]
        reference = consensus(before)
        chosen.append(min(possible, key=lambda o: residual_mm(taken(points, o), reference)))
    return chosen
