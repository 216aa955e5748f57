"""Is it round? A sharp edge must be there in all directions, at one distance from the centre.

Profiles along rays from the centre across the edge are compared, sector by sector, with their
mean: on a disc, with or without a wall, every sector looks like the mean; along a straight side, at
a corner or in noise it does not. The hill of a coil's sensitivity is round too, but has no edge.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

REACH_PX = 3.0  # of the profiles, to either side of the edge
_STEP_PX = 0.5
_ALIKE = 0.7  # correlation of a sector with the mean profile
_STRONG = 0.25  # least size of a sector, over that of the mean
_FEWEST_SECTORS, _MOST_SECTORS = 12, 48


@dataclass(frozen=True)
class Roundness:
    """coverage: share of directions in which the edge is there.

    sharpness: share of the mean profile's variance that a straight slope does not explain.
    contrast: highest less lowest value of the mean profile, in pixel values.
    noise: what is left of the profiles beside their mean, rms of a sector.
    """

    coverage: float
    sharpness: float
    contrast: float
    noise: float


def out_of_round_px(
    frame: Array, centre_px: tuple[float, float], radius_px: float, reach_px: float = REACH_PX
) -> float:
    """How far the edge strays from the circle drawn through it: std over the directions, px.

    From the median deviation, so that a gap, a bubble or a neighbour in a few directions does not
    count. Noise of a fifth of the contrast brings it to 0.25 px; the outlines of tissue have
    0.5 px and more. Infinite where no edge can be followed.
    """
    centre_px, radius_px = refine_circle(frame, centre_px, radius_px, reach_px)
    profiles, distance, complete = _profiles(frame, centre_px, radius_px, reach_px)
    offsets, _ = _edge_offsets(profiles, distance, complete)
    if offsets.size < 8:
        return float("inf")
    return float(1.4826 * np.median(np.abs(offsets - np.median(offsets))))


def roundness(
    frame: Array,
    centre_px: tuple[float, float],
    radius_px: float,
    reach_px: float = REACH_PX,
) -> Roundness:
    """Compare the edge profiles of all directions around a circle (row, col, radius in px).

    Directions that leave the frame count as missing.
    """
    profiles, distance, complete = _profiles(frame, centre_px, radius_px, reach_px)
    mean = np.median(profiles, axis=0)
    shape = mean - mean.mean()
    norm = float(np.linalg.norm(shape))
    if norm == 0:
        return Roundness(0.0, 0.0, 0.0, float(profiles.std()))
    centred = profiles - profiles.mean(axis=1, keepdims=True)
    projected = centred @ shape / norm
    alike = projected > _ALIKE * np.maximum(np.linalg.norm(centred, axis=1), 1e-300)
    strong = projected > _STRONG * norm  # a flat sector is not an edge, however alike
    rest = centred - np.outer(projected / norm, shape)
    slope = distance - distance.mean()
    straight = float(shape @ slope) ** 2 / float(slope @ slope) / norm**2
    return Roundness(
        coverage=float(np.mean(alike & strong & complete)),
        sharpness=1 - straight,
        contrast=float(np.ptp(mean)),
        noise=float(np.sqrt(np.mean(rest**2))),
    )


def refine_circle(
    frame: Array, centre_px: tuple[float, float], radius_px: float, reach_px: float
) -> tuple[tuple[float, float], float]:
    """Centre and radius of the circle through the edge points of all directions.

    In each direction the edge is where the profile, within reach_px of the circle, lies best
    under the mean of all; a few rounds, points far from the circle left out.
    """
    for _ in range(4):
        profiles, distance, complete = _profiles(frame, centre_px, radius_px, reach_px)
        offsets, angle = _edge_offsets(profiles, distance, complete)
        if offsets.size < 8:
            break
        basis = np.stack([np.sin(angle), np.cos(angle), np.ones(angle.size)], axis=1)
        keep = np.ones(offsets.size, dtype=bool)
        for _ in range(3):
            move, *_ = np.linalg.lstsq(basis[keep], offsets[keep], rcond=None)
            left = np.abs(offsets - basis @ move)
            keep = left <= max(2.5 * float(np.median(left)), 0.3)
        move = np.clip(move, -reach_px, reach_px)
        centre_px = (centre_px[0] + float(move[0]), centre_px[1] + float(move[1]))
        radius_px = max(radius_px + float(move[2]), 1.0)
        reach_px = max(REACH_PX, reach_px / 2)
    return centre_px, radius_px


def _edge_offsets(profiles: Array, distance: Array, complete: Flags) -> tuple[Array, Array]:
    """Distance of the steepest place of each sector's profile from the circle, and its angle."""
    smooth = (profiles[:, :-2] + profiles[:, 1:-1] + profiles[:, 2:]) / 3
    steps = np.diff(smooth, axis=1)
    mean = np.median(steps, axis=0)
    sign = np.sign(mean[np.argmax(np.abs(mean))]) or 1.0
    rise = np.maximum(steps * sign, 0.0)
    best = np.argmax(rise, axis=1)
    middles = (distance[1:-2] + distance[2:-1]) / 2 - distance.mean()
    angle = 2 * np.pi * (np.arange(len(profiles)) + 0.5) / len(profiles)
    good = complete & (rise.max(axis=1) > 0)
    # the vertex of a parabola through the steepest place and its neighbours
    inner = np.clip(best, 1, rise.shape[1] - 2)
    here = np.arange(len(profiles))
    before, at, after = (rise[here, inner + d] for d in (-1, 0, 1))
    bend = before - 2 * at + after
    vertex = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, 1.0), 0.0)
    return (middles[inner] + np.clip(vertex, -0.5, 0.5) * _STEP_PX)[good], angle[good]


def _profiles(
    frame: Array, centre_px: tuple[float, float], radius_px: float, reach_px: float
) -> tuple[Array, Array, Flags]:
    """Profiles (sectors, samples), their distances from the centre, and which are complete."""
    sectors = int(np.clip(np.pi * radius_px, _FEWEST_SECTORS, _MOST_SECTORS))
    rays = sectors * max(2, int(np.ceil(2 * np.pi * radius_px / sectors)))
    distance = radius_px + np.arange(-min(reach_px, radius_px), reach_px + 1e-9, _STEP_PX)
    angle = 2 * np.pi * (np.arange(rays) + 0.5) / rays
    rows = centre_px[0] + distance[None, :] * np.sin(angle)[:, None]
    cols = centre_px[1] + distance[None, :] * np.cos(angle)[:, None]
    sampled = map_coordinates(frame, [rows, cols], order=1, mode="nearest")
    inside = (rows >= -0.5) & (cols >= -0.5)
    inside &= (rows <= frame.shape[0] - 0.5) & (cols <= frame.shape[1] - 0.5)
    profiles = sampled.reshape(sectors, -1, distance.size).mean(axis=1)
    complete = np.asarray(inside.reshape(sectors, -1).all(axis=1), dtype=np.bool_)
    return profiles, distance, complete
