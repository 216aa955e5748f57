"""Laying plates of vials over each other, and the scatter of repeated centres."""

import numpy as np
import pytest

from sr_engine.simulate import render_disc
from studies.peers import radial_symmetry
from studies.plates import (
    consensus,
    in_one_order,
    match_to_design,
    residual_mm,
    similarity,
    taken,
)
from studies.repeats import displaced, scatter

RING = np.radians(36 * np.arange(10))
DESIGN = np.concatenate([
    50 * np.stack([np.sin(RING), -np.cos(RING)], axis=1),
    20.0 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]),
])  # fmt: skip


def _turned(points: np.ndarray, degrees: float, mirror: float = 1.0) -> np.ndarray:
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return 1.01 * points @ turn.T * [1.0, mirror] + [70.0, 95.0]


@pytest.mark.parametrize(("degrees", "mirror"), [(5, 1), (93, 1), (-31, -1)])
def test_vials_are_matched_to_the_drawing_whatever_the_pose(degrees: float, mirror: float) -> None:
    rng = np.random.default_rng(1)
    seen = _turned(DESIGN + rng.normal(0, 0.3, DESIGN.shape), degrees, mirror)
    posts = _turned(np.array([(75.0, 10.0), (-60.0, 60.0), (10.0, -80.0)]), degrees, mirror)
    points = np.concatenate([posts, seen])[rng.permutation(17)]
    orders = match_to_design(points, DESIGN)
    assert len(orders) >= 2  # half a turn and the mirror look alike
    for order in orders:
        assert residual_mm(taken(points, order), DESIGN) < 0.8


def test_two_scans_of_one_plate_are_read_in_the_same_order() -> None:
    rng = np.random.default_rng(2)
    plate = DESIGN + rng.normal(0, 0.4, DESIGN.shape)
    scans = [_turned(plate, 7), _turned(plate, 171, -1.0), _turned(plate, -50)]
    scans = [scan[rng.permutation(14)] for scan in scans]
    orders = in_one_order(scans, [match_to_design(s, DESIGN) for s in scans])
    vials = [taken(s, o) for s, o in zip(scans, orders, strict=True)]
    assert residual_mm(vials[1], consensus([vials[0], vials[2]])) < 1e-6


def test_a_similarity_takes_out_pose_and_scale_and_nothing_else() -> None:
    target = DESIGN.copy()
    target[3] += (0.0, 1.0)
    laid = similarity(_turned(DESIGN, 40), target)
    assert 0.2 < np.hypot(*(laid - target).T).max() < 1.0
    assert residual_mm(_turned(DESIGN, 40), DESIGN) < 1e-9


def test_scatter_leaves_drift_out_and_counts_failures() -> None:
    rng = np.random.default_rng(3)
    drift = np.linspace(0, 1, 400)[None, :, None]
    centres = drift + rng.normal(0, 0.05, (7, 400, 2))
    centres[2, 5] = np.nan
    found = scatter(centres)
    assert found.neighbours_px == pytest.approx(0.05, rel=0.1)
    assert (found.failures, found.attempts) == (1, 2800)


def test_a_displaced_frame_is_the_frame_of_a_displaced_object() -> None:
    here = render_disc((48, 65), (20.0, 30.0), 5.0, background=1.0)
    there = render_disc((48, 65), (20.25, 29.6), 5.0, background=1.0)
    assert np.abs(displaced(here, np.array([0.25, -0.4])) - there)[5:-5, 5:-5].max() < 0.02


def test_radial_symmetry_finds_a_clean_disc() -> None:
    frame = render_disc((48, 65), (20.3, 30.8), 5.0)
    centre = radial_symmetry(frame, (20.0, 31.0), 5.0)
    assert centre == pytest.approx((20.3, 30.8), abs=0.05)
