"""Shift sets: what they are worth, and what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sr_engine.errors import NotFiniteError, ParameterError, ShapeError
from sr_engine.reconstruction import shiftset

IDEAL = [("quarter", 2), ("half", 2), ("lattice5", 2), ("third", 3), ("eighth", 4)]


@pytest.mark.parametrize(("name", "factor"), IDEAL)
def test_the_designed_sets_are_ideal_for_their_factor(name: str, factor: int) -> None:
    chosen = shiftset.named(name)
    assert chosen.condition_number(factor) == pytest.approx(1.0)
    assert chosen.noise_factor(factor) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["quarter", "lattice5", "third", "eighth"])
def test_zero_mean_sets_have_zero_mean(name: str) -> None:
    assert np.allclose(shiftset.named(name).mean_px(), 0.0)


def test_the_lattice_has_five_different_phases_on_each_axis() -> None:
    for axis in shiftset.named("lattice5").as_array().T:
        assert np.allclose(np.sort(np.mod(axis, 1.0)), np.arange(5) / 5)


def test_the_papers_set_starts_at_the_origin_and_stays_within_a_pixel() -> None:
    chosen = shiftset.paper_random(np.random.default_rng(7), 40)
    points = chosen.as_array()
    assert points[0].tolist() == [0.0, 0.0]
    assert len(chosen) == 40
    assert (np.abs(points) <= 1.0).all()
    assert np.abs(points).max() > 0.9


def test_the_steps_lead_from_point_to_point_and_back_to_the_first() -> None:
    chosen = shiftset.paper_random(np.random.default_rng(7))
    steps, points = chosen.steps_px(), chosen.as_array()
    assert np.allclose(points[0] + np.cumsum(steps[:-1], axis=0), points[1:])
    assert np.allclose(steps.sum(axis=0), 0.0)


def test_random_sets_of_four_amplify_noise_as_much_as_is_known() -> None:
    rng = np.random.default_rng(11)
    factors = [shiftset.paper_random(rng).noise_factor() for _ in range(4000)]
    middle, high = np.percentile(factors, [50, 90])
    assert 8 < middle < 13
    assert 180 < high < 350


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_too_few_shifts_have_an_infinite_condition_number(factor: int) -> None:
    shifts = np.random.default_rng(0).uniform(size=(factor**2 - 1, 2))
    assert shiftset.condition_number(shifts, factor) == math.inf
    assert shiftset.noise_factor(shifts, factor) == math.inf


points = st.tuples(st.floats(-1, 1), st.floats(-1, 1))


@given(
    shifts=st.lists(points, min_size=4, max_size=8),
    by=points,
    whole=st.tuples(st.integers(-3, 3), st.integers(-3, 3)),
)
def test_the_condition_number_ignores_a_common_displacement_and_whole_pixels(
    shifts: list[tuple[float, float]], by: tuple[float, float], whole: tuple[int, int]
) -> None:
    condition = shiftset.condition_number(shifts)
    assert condition >= 1.0
    if condition < 1e4:
        moved = np.array(shifts) + by
        moved[0] += whole
        assert shiftset.condition_number(moved) == pytest.approx(condition, rel=1e-6)


def test_an_own_set_is_taken_as_it_is_given() -> None:
    chosen = shiftset.from_points([(0.1, -0.2), (0.3, 0.4)], name="mine")
    assert chosen.shifts_px == ((0.1, -0.2), (0.3, 0.4))
    assert chosen.name == "mine"


@pytest.mark.parametrize(
    ("bad", "error"),
    [
        ([], ShapeError),
        ([(0.0,)], ShapeError),
        ([(0.0, 1.0), (2.0,)], ShapeError),
        ([("a", "b")], ShapeError),
        ([(0.0, math.nan)], NotFiniteError),
        ([(math.inf, 0.0)], NotFiniteError),
    ],
)
def test_an_own_set_that_is_none_is_refused(bad: list[tuple[float]], error: type) -> None:
    with pytest.raises(error):
        shiftset.from_points(bad)


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(ParameterError, match=r"'spiral'; known: .*quarter.*lattice5.*paper"):
        shiftset.named("spiral")


def test_an_empty_random_set_is_refused() -> None:
    with pytest.raises(ParameterError, match="at least one point"):
        shiftset.paper_random(np.random.default_rng(0), 0)
