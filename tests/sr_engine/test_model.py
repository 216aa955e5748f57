"""Derivatives, noise moments and the fit's parts against independent computation."""

import numpy as np
import pytest

from sr_engine.model import DISC, Patch, Shape, unit_object
from sr_engine.noise import correlation, moments, sigma_of
from sr_engine.psf import Psf
from sr_engine.signal import ObjectModel, signal_of
from sr_engine.simulate import filtered_noise, render_disc, render_sphere_slab, rician

PATCH = Patch(np.arange(8.0, 31.0), np.arange(12.0, 40.0), (48, 66))


@pytest.mark.parametrize("psf", [Psf(), Psf("hamming", acquired=(0.75, 1.0)), Psf("box")])
def test_a_patch_is_a_part_of_the_rendered_frame(psf: Psf) -> None:
    part, *_ = unit_object(PATCH, psf, DISC, (19.3, 25.8), 4.3)
    whole = render_disc((48, 66), (19.3, 25.8), 4.3, psf=psf)
    np.testing.assert_allclose(part, whole[8:31, 12:40], atol=4e-4 if psf.folds else 1e-5)


def test_a_sphere_on_a_patch_is_a_part_of_the_rendered_frame() -> None:
    part, *_ = unit_object(PATCH, Psf(), Shape((1.0, 3.0)), (19.3, 25.8), 5.3)
    whole = render_sphere_slab((48, 66), (19.3, 25.8), 5.3, slab_px=(1.0, 3.0))
    np.testing.assert_allclose(part, whole[8:31, 12:40], atol=2e-3)


@pytest.mark.parametrize("wall_px", [None, 1.5])
@pytest.mark.parametrize("psf", [Psf(), Psf("hamming"), Psf("gaussian", (0.7,))])
def test_analytic_derivatives_are_those_of_finite_differences(
    psf: Psf, wall_px: float | None
) -> None:
    model = ObjectModel(psf, DISC, (19.0, 26.0), wall_px)
    parameters = np.array([19.3, 25.8, 4.26, 1.3, 0.4, 0.01, -0.02, 0.03, -0.01, -0.7, 1.4])
    parameters = parameters[: model.n_parameters]
    _, derivatives = signal_of(parameters, PATCH, model)
    for i in range(model.n_parameters):
        step = np.zeros_like(parameters)
        step[i] = 1e-5
        above, _ = signal_of(parameters + step, PATCH, model)
        below, _ = signal_of(parameters - step, PATCH, model)
        # the radius is expanded to third order from the nearest eighth of a pixel
        np.testing.assert_allclose(derivatives[i], (above - below) / 2e-5, atol=2e-4)


@pytest.mark.parametrize("ratio", [0.0, 0.7, 2.0, 6.0, 50.0])
def test_rician_moments_are_those_of_many_draws(ratio: float) -> None:
    sigma = 0.3
    draws = rician(np.full((1000, 1000), ratio * sigma), sigma, np.random.default_rng(1))
    expected = moments(np.array([ratio * sigma]), sigma, "rician")
    assert expected.mean[0] == pytest.approx(draws.mean(), rel=2e-3)
    assert expected.variance[0] == pytest.approx(draws.var(), rel=6e-3)


def test_the_moments_derivatives_are_those_of_finite_differences() -> None:
    signal = np.linspace(-3, 12, 40)
    here = moments(signal, 0.5, "rician")
    above, below = moments(signal + 1e-5, 0.5, "rician"), moments(signal - 1e-5, 0.5, "rician")
    np.testing.assert_allclose(here.slope, (above.mean - below.mean) / 2e-5, atol=1e-7)
    np.testing.assert_allclose(here.curvature, (above.slope - below.slope) / 2e-5, atol=1e-6)


@pytest.mark.parametrize("level", [0.0, 1.0, 30.0])
def test_the_noise_level_is_found_from_any_start(level: float) -> None:
    draws = rician(np.full(200_000, level), 0.5, np.random.default_rng(2))
    sigma = 2.0
    for _ in range(60):
        sigma = sigma_of(draws, np.full(draws.size, level), sigma, "rician", 0)
    assert sigma == pytest.approx(0.5, rel=0.01)


def test_filtered_noise_is_correlated_as_its_filter_says() -> None:
    psf = Psf("hamming", acquired=(0.75, 1.0))
    noise = np.stack(
        [filtered_noise((48, 66), 1.0, psf, np.random.default_rng(s)) for s in range(80)]
    )
    table = correlation((48, 66), psf, 3)
    for row, col in ((0, 1), (1, 0), (2, 1), (0, 3)):
        measured = np.mean(noise * np.roll(noise, (row, col), (1, 2)))
        assert measured == pytest.approx(table[row, col], abs=0.02)
