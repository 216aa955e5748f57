"""Estimates: fusion, prediction, and how sure is sure enough."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ncx2

from service.procedure.estimate import FiducialEstimate, MotionNoise, probability_within
from service.procedure.jacobian import ImageJacobian

HERE = {"xt": 0, "yt": 0}
offsets = st.floats(-0.3, 0.3)
sigmas = st.floats(0.001, 0.3)


def covariance(sigma_a, sigma_b, angle_deg=0.0):
    a = np.radians(angle_deg)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return turn @ np.diag([sigma_a**2, sigma_b**2]) @ turn.T


@given(offsets, offsets, sigmas, st.floats(0.01, 0.2))
def test_the_probability_of_a_round_normal_is_that_of_a_non_central_chi_square(
    row, col, sigma, tolerance
):
    expected = ncx2.cdf((tolerance / sigma) ** 2, 2, (row**2 + col**2) / sigma**2)
    found = probability_within(np.array([row, col]), covariance(sigma, sigma), tolerance)
    assert found == pytest.approx(expected, abs=1e-6)


@given(offsets, offsets, sigmas, sigmas, st.floats(0, 180), st.floats(0.02, 0.2))
def test_the_probability_does_not_depend_on_the_frame(row, col, a, b, angle, tolerance):
    turn = covariance(1, 1)  # identity; the rotation below is explicit
    theta = np.radians(angle)
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    offset, spread = np.array([row, col]), covariance(a, b)
    here = probability_within(offset, spread, tolerance)
    there = probability_within(turn @ offset, turn @ spread @ turn.T, tolerance)
    assert here == pytest.approx(there, abs=1e-6)


def test_the_probability_agrees_with_throwing_dice():
    rng = np.random.default_rng(1)
    offset, spread = np.array([0.02, -0.03]), covariance(0.03, 0.008, 33.0)
    thrown = rng.multivariate_normal(offset, spread, 400_000)
    expected = np.mean(np.linalg.norm(thrown, axis=1) < 0.05)
    assert probability_within(offset, spread, 0.05) == pytest.approx(expected, abs=0.003)


@given(offsets, offsets, sigmas, sigmas, sigmas)
def test_fusion_is_the_information_weighted_mean(row, col, a, b, c):
    prior = FiducialEstimate(HERE, np.zeros(2), covariance(a, b, 20.0))
    seen = np.array([row, col])
    spread = covariance(c, c)
    information = np.linalg.inv(prior.covariance_mm2), np.linalg.inv(spread)
    expected_covariance = np.linalg.inv(information[0] + information[1])
    fused = prior.fused_with(FiducialEstimate(HERE, seen, spread))
    assert fused.covariance_mm2 == pytest.approx(expected_covariance, rel=1e-6, abs=1e-12)
    assert fused.plane_mm == pytest.approx(expected_covariance @ information[1] @ seen, abs=1e-9)


@given(offsets, offsets, st.lists(sigmas, min_size=3, max_size=3), sigmas)
def test_what_all_looks_have_in_common_is_not_averaged_out(row, col, noise, common):
    """However often somebody looks: the centre that is drawn aside is drawn aside."""
    looks = [
        FiducialEstimate(
            HERE,
            np.array([row, col]) * number,
            covariance(spread, spread) + np.eye(2) * common**2,
            np.full(2, common),
        )
        for number, spread in enumerate(noise)
    ]
    fused = looks[0]
    for look in looks[1:]:
        fused = fused.fused_with(look)
    information = sum(spread**-2 for spread in noise)
    expected = 1 / information + common**2
    assert np.diag(fused.covariance_mm2) == pytest.approx([expected] * 2, rel=1e-6)
    # after an approach to the fiducial's own place it is not said any more, but still there
    unsaid = replace(fused, covariance_mm2=fused.noise_mm2, common_mm=None)
    assert unsaid.fused_with(looks[0]).covariance_mm2[0, 0] >= common**2 * (1 - 1e-9)
    assert fused.with_noise_times(0).covariance_mm2 == pytest.approx(np.eye(2) * common**2)
    # what is drawn further aside than the rest tells little, and the estimate stays sound
    other = FiducialEstimate(HERE, np.zeros(2), np.eye(2), np.full(2, 0.9))
    both = fused.fused_with(other)
    assert np.all(np.linalg.eigvalsh(both.noise_mm2) >= -1e-12)
    assert np.all(np.diag(both.covariance_mm2) >= common**2 * (1 - 1e-9))


def test_standing_still_adds_no_uncertainty_and_a_move_adds_its_own():
    columns = np.array([[0.0, 0.0, 1.0, 1.0], [1.0, 1.0, 0.0, 0.0]])
    jacobian = ImageJacobian(("xt", "yt"), columns, np.zeros((8, 8)))
    noise = MotionNoise(0.014, 0.015)
    start = FiducialEstimate(HERE, np.array([1.0, 2.0]), np.eye(2) * 1e-4)
    assert np.array_equal(start.moved_to(HERE, jacobian, noise).covariance_mm2, np.eye(2) * 1e-4)
    moved = start.moved_to({"xt": 3000, "yt": 0}, jacobian, noise)
    assert moved.plane_mm == pytest.approx([1.0, 5.0])
    assert np.diag(moved.covariance_mm2) == pytest.approx([1e-4, 1e-4 + 0.014**2 + 0.045**2])


def test_distance_in_sigmas_counts_both_uncertainties():
    prior = FiducialEstimate(HERE, np.zeros(2), np.eye(2) * 0.03**2)
    assert prior.distance_sigma(np.array([0.1, 0.0]), np.eye(2) * 0.04**2) == pytest.approx(2.0)
