"""The simulated slice against definitions that share no code with it."""

import numpy as np
import pytest

from sr_engine.errors import ParameterError, ShapeError
from sr_engine.psf import Psf
from sr_engine.simulate import filtered_noise, render_disc, render_sphere_slab, rician

SHAPE = (48, 66)
KINDS = [
    Psf("flat"),
    Psf("hamming"),
    Psf("fermi"),
    Psf("elliptical"),
    Psf("box"),
    Psf("gaussian", (0.7,)),
    Psf("hamming", (0.5,), acquired=(0.5, 0.75)),
]


def _area_coverage(
    shape: tuple[int, int], centre: tuple[float, float], radius: float, fine: int = 64
) -> np.ndarray:
    """Fraction of every pixel inside of the disc, by counting points of a fine grid."""
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    rows = (np.arange(shape[0])[:, None] + sub).ravel() - centre[0]
    cols = (np.arange(shape[1])[:, None] + sub).ravel() - centre[1]
    inside = rows[:, None] ** 2 + cols[None, :] ** 2 <= radius**2
    return inside.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))


def test_square_pixels_see_the_share_of_their_area_that_the_disc_covers() -> None:
    centre = (21.3, 33.8)
    image = render_disc(SHAPE, centre, 4.0, psf=Psf("box"))
    assert np.abs(image - _area_coverage(SHAPE, centre, 4.0)).max() < 0.01


def test_a_finely_drawn_disc_scanned_through_few_k_space_samples_is_the_same_frame() -> None:
    fine, centre, radius = 16, (21.3, 33.8), 5.0
    shape = (SHAPE[0] * fine, SHAPE[1] * fine)
    half = (fine - 1) / 2
    big_centre = (centre[0] * fine + half, centre[1] * fine + half)
    drawn = _area_coverage(shape, big_centre, radius * fine, 8)
    spectrum = np.fft.fft2(drawn) / fine**2
    k_row, k_col = np.fft.fftfreq(shape[0]) * fine, np.fft.fftfreq(shape[1]) * fine
    # the fine grid's first centre lies half a coarse pixel less half a fine one before ours
    spectrum *= np.exp(1j * np.pi * (1 - 1 / fine) * (k_row[:, None] + k_col[None, :]))
    keep_row = np.concatenate([np.arange(SHAPE[0] // 2), np.arange(-(SHAPE[0] // 2), 0)])
    keep_col = np.concatenate([np.arange(SHAPE[1] // 2), np.arange(-(SHAPE[1] // 2), 0)])
    scanned = np.fft.ifft2(spectrum[np.ix_(keep_row, keep_col)]).real
    assert np.abs(scanned - render_disc(SHAPE, centre, radius)).max() < 0.004


@pytest.mark.parametrize("psf", KINDS, ids=lambda p: p.kind)
def test_a_shift_by_whole_pixels_moves_the_frame_and_nothing_else(psf: Psf) -> None:
    at_a = render_disc(SHAPE, (20.3, 30.6), 4.2, psf=psf)
    at_b = render_disc(SHAPE, (23.3, 28.6), 4.2, psf=psf)
    np.testing.assert_allclose(np.roll(at_a, (3, -2), (0, 1)), at_b, atol=1e-12)


@pytest.mark.parametrize("psf", KINDS, ids=lambda p: p.kind)
def test_the_area_under_the_disc_is_kept_by_every_point_spread(psf: Psf) -> None:
    image = render_disc(SHAPE, (20.3, 30.6), 4.2, amplitude=3.0, psf=psf)
    assert image.sum() == pytest.approx(3 * np.pi * 4.2**2)


def test_a_displacement_is_a_phase_on_the_very_same_k_space_samples() -> None:
    a = render_disc((47, 65), (20.0, 30.0), 4.2, psf=Psf("hamming"))
    b = render_disc((47, 65), (20.25, 29.6), 4.2, psf=Psf("hamming"))
    k_row, k_col = np.fft.fftfreq(47)[:, None], np.fft.fftfreq(65)[None, :]
    phase = np.exp(-2j * np.pi * (0.25 * k_row - 0.4 * k_col))
    assert np.abs(np.fft.ifft2(np.fft.fft2(a) * phase) - b).max() < 1e-13


def test_a_window_leaves_no_signal_where_the_scanner_filled_zeros() -> None:
    psf = Psf("flat", acquired=(0.5, 0.75))
    spectrum = np.abs(np.fft.fft2(render_disc(SHAPE, (20.3, 30.6), 4.2, psf=psf)))
    outside = (np.abs(np.fft.fftfreq(48)) > 0.2501)[:, None] | (
        np.abs(np.fft.fftfreq(66)) > 0.3751
    )[None, :]
    assert spectrum[outside].max() < 1e-10 * spectrum.max()


def test_a_slab_through_the_middle_of_a_sphere_is_a_blurred_disc() -> None:
    thin = render_sphere_slab(SHAPE, (20.3, 30.6), 4.2, slab_px=(0.0, 0.01))
    np.testing.assert_allclose(thin, render_disc(SHAPE, (20.3, 30.6), 4.2), atol=1e-5)
    flat = render_sphere_slab(SHAPE, (20.3, 30.6), 4.2, slab_px=(2.0, 0.0))
    ring = np.sqrt(4.2**2 - 4.0)
    np.testing.assert_allclose(flat, render_disc(SHAPE, (20.3, 30.6), ring), atol=1e-12)


@pytest.mark.parametrize(("offset", "thickness"), [(0, 3), (1.5, 3), (3, 4), (0, 20), (9, 2)])
def test_a_slab_holds_the_volume_of_the_sphere_that_it_cuts(
    offset: float, thickness: float
) -> None:
    a = 4.2
    low, high = max(offset - thickness / 2, -a), min(offset + thickness / 2, a)
    high = max(high, low)
    volume = np.pi * (a**2 * (high - low) - (high**3 - low**3) / 3)
    image = render_sphere_slab(SHAPE, (20.3, 30.6), a, slab_px=(offset, thickness))
    assert image.sum() == pytest.approx(volume / thickness, abs=1e-9)


def test_shading_and_background_are_what_they_say() -> None:
    plain = render_disc(SHAPE, (20.0, 30.0), 4.0, amplitude=2.0, background=1.0)
    shaded = render_disc(
        SHAPE, (20.0, 30.0), 4.0, amplitude=2.0, background=1.0, slopes=(0.01, -0.02)
    )
    assert shaded[20, 30] == pytest.approx(plain[20, 30])
    assert shaded[25, 40] == pytest.approx(plain[25, 40] * (1 + 0.05 - 0.2))


def test_rician_noise_has_the_moments_that_it_must_have() -> None:
    rng = np.random.default_rng(5)
    noise = rician(np.zeros((300, 400)), 2.0, rng)
    assert noise.mean() == pytest.approx(2.0 * np.sqrt(np.pi / 2), rel=0.01)
    signal = rician(np.full((300, 400), 40.0), 2.0, rng)
    assert (signal**2).mean() == pytest.approx(40.0**2 + 2 * 2.0**2, rel=0.001)
    assert signal.std() == pytest.approx(2.0, rel=0.01)


def test_filtered_noise_keeps_its_std_and_takes_the_colour_of_the_window() -> None:
    psf = Psf("hamming", acquired=(0.5, 1.0))
    noise = filtered_noise((96, 130), 3.0, psf, np.random.default_rng(6))
    assert noise.std() == pytest.approx(3.0, rel=0.1)
    spectrum = np.abs(np.fft.fft2(noise))
    assert spectrum[40:56].max() < 1e-9 * spectrum.max()


def test_nonsense_is_refused_by_name() -> None:
    with pytest.raises(ParameterError, match="radius"):
        render_disc(SHAPE, (20, 30), -1.0)
    with pytest.raises(ParameterError, match="radius"):
        render_disc(SHAPE, (20, 30), np.nan)
    with pytest.raises(ShapeError):
        render_disc((0, 5), (20, 30), 1.0)
    with pytest.raises(ParameterError, match="noise"):
        rician(np.ones((3, 4)), -1.0, np.random.default_rng(0))
    with pytest.raises(ParameterError, match="unknown psf"):
        Psf("round")  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="parameters"):
        Psf("fermi", (0.9,))
    with pytest.raises(ParameterError, match="acquired"):
        Psf("flat", acquired=(0.0, 1.0))
