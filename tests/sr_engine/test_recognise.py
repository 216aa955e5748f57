"""The point spread of a frame from the colour of its noise, with known truth."""

import numpy as np
import pytest

from sr_engine.checks import refuse_non_square
from sr_engine.errors import NonSquarePixelsError
from sr_engine.localize import localize
from sr_engine.psf import Psf
from sr_engine.recognise import psf_of_noise
from sr_engine.simulate import filtered_noise, render_disc, render_sphere_slab

SHAPE = (112, 136)


def scanned(psf: Psf, snr: float, rng: np.random.Generator, radius: float = 4.0) -> np.ndarray:
    clean = render_disc(SHAPE, (55.3, 66.8), radius, psf=psf)
    real = clean + filtered_noise(SHAPE, 1 / snr, psf, rng)
    return np.asarray(np.hypot(real, filtered_noise(SHAPE, 1 / snr, psf, rng)))


@pytest.mark.parametrize(
    "psf",
    [
        Psf(), Psf("hamming"), Psf("elliptical"), Psf("flat", (), (0.75, 0.75)),
        Psf("flat", (), (1.0, 0.5)), Psf("hamming", (), (0.75, 0.75)),
    ],
    ids=lambda p: f"{p.kind} {p.acquired}",
)  # fmt: skip
def test_the_noise_tells_the_window_and_what_was_filled_with_zeros(psf: Psf) -> None:
    rng = np.random.default_rng(5)
    for snr in (10.0, 20.0, 40.0):
        found = psf_of_noise(scanned(psf, snr, rng))
        # fractions come in steps of an eighth; a filter hides its own border
        assert found.acquired == pytest.approx(psf.acquired, abs=0.13)
        assert found.kind == psf.kind or {found.kind, psf.kind} == {"fermi", "elliptical"}


def test_a_soft_object_in_white_noise_is_not_taken_for_a_filter() -> None:
    rng = np.random.default_rng(6)
    for _ in range(10):
        clean = render_sphere_slab(SHAPE, (55.3, 66.8), 6.0, slab_px=(3.0, 5.0))
        frame = np.hypot(
            clean + 0.03 * rng.standard_normal(SHAPE), 0.03 * rng.standard_normal(SHAPE)
        )
        assert psf_of_noise(frame) == Psf()


def test_a_frame_without_air_is_taken_for_flat_k_space() -> None:
    rng = np.random.default_rng(7)
    assert psf_of_noise(5 + filtered_noise(SHAPE, 0.1, Psf("hamming"), rng)) == Psf()
    assert psf_of_noise(np.zeros((20, 20))) == Psf()


def test_a_filtered_series_is_localized_better_for_it() -> None:
    rng = np.random.default_rng(8)
    truth = np.array([55.3, 66.8])
    errors: dict[str, list[float]] = {"flat": [], "recognised": []}
    for _ in range(40):
        frame = scanned(Psf("hamming"), 20.0, rng)
        for name, psf in (("flat", Psf()), ("recognised", psf_of_noise(frame))):
            found = localize(frame, start_px=truth, radius_px=(2.5, 6.0), psf=psf)
            errors[name].append(float(np.hypot(*(found.centre_px - truth))))
    assert np.mean(errors["recognised"]) < 0.95 * np.mean(errors["flat"])


def test_pixels_that_are_not_square_are_refused_by_name() -> None:
    refuse_non_square((1.0, 1.005))
    with pytest.raises(NonSquarePixelsError, match="not square"):
        refuse_non_square((1.0, 1.2))
