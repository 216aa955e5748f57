"""The fit against the Cramer-Rao bound: bias, scatter and honesty of its covariance.

Short campaigns here, with bounds that chance rarely breaks; the long ones are marked `soak`.
"""

import numpy as np
import pytest

from sr_engine.bound import bound_px, rician_information
from sr_engine.localize import localize
from sr_engine.psf import Psf
from sr_engine.simulate import filtered_noise, render_disc, render_sphere_slab, rician

SHAPE = (64, 80)
MIDDLE = np.array([31.0, 39.0])
QUARTERS = np.array([(0.25, 0.25), (0.25, -0.25), (-0.25, 0.25), (-0.25, -0.25)])
LATTICE_16 = (np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2) - 1.5) / 4


def _campaign(
    trials: int,
    radius: float,
    snr: float,
    shifts: np.ndarray,
    seed: int,
    psf: Psf = Psf(),  # noqa: B008
    slopes: tuple[float, float] = (0.0, 0.0),
    background: float = 0.0,
    fitted: Psf | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (trials, 2) and normalised squared errors (trials,) at random pixel phases."""
    rng = np.random.default_rng(seed)
    errors, normalised = [], []
    for _ in range(trials):
        truth = MIDDLE + rng.uniform(-0.5, 0.5, 2)
        frames = []
        for row, col in truth + shifts:
            clean = render_disc(
                SHAPE, (row, col), radius, background=background, psf=psf, slopes=slopes
            )
            if psf.folds or psf.kind == "flat":
                frames.append(rician(clean, 1 / snr, rng))
            else:
                real = clean + filtered_noise(SHAPE, 1 / snr, psf, rng)
                frames.append(np.hypot(real, filtered_noise(SHAPE, 1 / snr, psf, rng)))
        start = truth + rng.uniform(-1, 1, 2)
        found = localize(
            frames, shifts, start_px=start, radius_px=(0.6 * radius, 1.6 * radius),
            psf=fitted or psf, noise="rician",
        )  # fmt: skip
        error = found.centre_px - truth
        errors.append(error)
        normalised.append(error @ np.linalg.solve(found.covariance_px2, error))
    return np.array(errors), np.array(normalised)


def _mean_error(errors: np.ndarray) -> float:
    return float(np.hypot(*errors.T).mean())


def _std(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


NONE = np.zeros((1, 2))


def test_the_bound_agrees_with_its_closed_form_where_that_holds() -> None:
    for radius, snr in ((2.5, 40), (4, 80), (10, 40)):
        exact = bound_px(radius, snr, background=5.0, with_nuisance=False)
        assert exact == pytest.approx(0.533 / (snr * np.sqrt(radius)), rel=0.03)


def test_magnitudes_lose_information_at_low_signal_only() -> None:
    assert rician_information(np.array([0.0])) == pytest.approx(0, abs=1e-6)
    assert rician_information(np.array([100.0])) == pytest.approx(1, abs=1e-3)
    for snr, loss in ((5, 1.17), (10, 1.09), (20, 1.05)):
        magnitude = bound_px(4, snr, with_nuisance=False)
        assert magnitude / (0.533 / (snr * 2)) == pytest.approx(loss, abs=0.03)


def test_without_noise_the_centre_is_exact_at_every_pixel_phase() -> None:
    worst = 0.0
    for i in range(20):
        for j in range(20):
            truth = MIDDLE + (np.array([i, j]) + 0.5) / 20 - 0.5
            frame = np.abs(render_disc(SHAPE, (truth[0], truth[1]), 4.0))
            found = localize(frame, start_px=MIDDLE, radius_px=(2.5, 6))
            worst = max(worst, float(np.hypot(*(found.centre_px - truth))))
    assert worst < 1e-4


@pytest.mark.parametrize(
    "psf",
    [
        Psf("hamming"), Psf("fermi"), Psf("elliptical"), Psf("box"), Psf("gaussian"),
        Psf("flat", acquired=(0.75, 0.5)),
    ],
    ids=lambda p: p.kind + ("" if p.acquired == (1.0, 1.0) else " zero-filled"),
)  # fmt: skip
def test_without_noise_the_centre_is_exact_through_every_point_spread(psf: Psf) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        truth = MIDDLE + rng.uniform(-0.5, 0.5, 2)
        frame = np.abs(render_disc(SHAPE, (truth[0], truth[1]), 4.0, psf=psf))
        found = localize(frame, start_px=MIDDLE, radius_px=(2.5, 6), psf=psf)
        assert np.hypot(*(found.centre_px - truth)) < 2e-4


@pytest.mark.parametrize(
    ("radius", "snr", "shifts", "trials"),
    [
        (4.0, 20, NONE, 300),
        (4.0, 20, QUARTERS, 120),
        (2.5, 20, NONE, 250),
        (2.5, 10, QUARTERS, 80),
        (4.0, 80, NONE, 200),
        (10.0, 40, NONE, 150),
        (4.0, 20, LATTICE_16, 30),
    ],
)
def test_the_scatter_is_that_of_the_bound(
    radius: float, snr: float, shifts: np.ndarray, trials: int
) -> None:
    errors, _ = _campaign(trials, radius, snr, shifts, seed=11)
    bound = bound_px(radius, snr, n_frames=len(shifts))
    # a std from n numbers is uncertain by 1/sqrt(2n): three of those beside the 10 % allowed
    slack = 3 / np.sqrt(4 * trials)
    assert 0.9 - slack < _std(errors) / bound < 1.1 + slack


@pytest.mark.soak
@pytest.mark.parametrize("snr", [10, 20, 40, 80])
@pytest.mark.parametrize("radius", [2.5, 4.0, 6.0, 10.0])
@pytest.mark.parametrize("shifts", [NONE, QUARTERS, LATTICE_16], ids=["1", "4", "16"])
def test_the_scatter_is_within_ten_percent_of_the_bound_everywhere(
    radius: float, snr: float, shifts: np.ndarray
) -> None:
    trials = {1: 1200, 4: 500, 16: 200}[len(shifts)]
    errors, _ = _campaign(trials, radius, snr, shifts, seed=12)
    assert 0.9 < _std(errors) / bound_px(radius, snr, n_frames=len(shifts)) < 1.1


def test_at_snr_20_the_mean_error_is_a_fiftieth_of_a_pixel_from_one_frame() -> None:
    errors, _ = _campaign(400, 4.0, 20, NONE, seed=13)
    assert _mean_error(errors) < 0.020 * (1 + 2 * 0.52 / np.sqrt(400))


def test_at_snr_20_the_mean_error_is_a_hundredth_of_a_pixel_from_four_frames() -> None:
    errors, _ = _campaign(150, 4.0, 20, QUARTERS, seed=14)
    assert _mean_error(errors) < 0.010 * (1 + 2 * 0.52 / np.sqrt(150))


@pytest.mark.soak
def test_at_snr_20_the_mean_errors_hold_over_many_trials() -> None:
    one, _ = _campaign(2000, 4.0, 20, NONE, seed=15)
    four, _ = _campaign(2000, 4.0, 20, QUARTERS, seed=16)
    assert _mean_error(one) <= 0.020
    assert _mean_error(four) <= 0.010


def test_the_reported_covariance_is_that_of_the_errors() -> None:
    _, normalised = _campaign(500, 4.0, 20, NONE, seed=17)
    assert normalised.mean() == pytest.approx(2, abs=0.2 + 2 * 2 / np.sqrt(500))


@pytest.mark.soak
@pytest.mark.parametrize(
    ("radius", "snr"), [(4.0, 20), (2.5, 10), (2.5, 80), (10.0, 10), (10.0, 80)]
)
@pytest.mark.parametrize("shifts", [NONE, QUARTERS], ids=["1", "4"])
def test_the_reported_covariance_is_calibrated_within_ten_percent(
    shifts: np.ndarray, radius: float, snr: float
) -> None:
    trials = 3000 if len(shifts) == 1 else 1200
    _, normalised = _campaign(trials, radius, snr, shifts, seed=18)
    # mean squares of two unit normals scatter by 2 over sqrt(trials)
    assert normalised.mean() == pytest.approx(2, abs=0.2 + 2 * 2 / np.sqrt(trials))


def test_the_noise_level_is_right_where_the_surroundings_are_air() -> None:
    """Left free, the background takes up noise: the covariance came out 9 % too small."""
    rng = np.random.default_rng(24)
    levels = []
    for _ in range(250):
        truth = MIDDLE + rng.uniform(-0.5, 0.5, 2)
        frame = rician(render_disc(SHAPE, (truth[0], truth[1]), 2.5), 0.1, rng)
        levels.append(localize(frame, start_px=truth, radius_px=(1.5, 4)).sigma)
    assert np.mean(levels) == pytest.approx(0.1, rel=0.032)


def test_coloured_noise_of_a_filter_is_told_in_the_covariance() -> None:
    errors, normalised = _campaign(120, 4.0, 20, NONE, seed=19, psf=Psf("hamming"))
    # filtered to SNR 20, so 7.95 before the filter: that is what the bound knows
    raw_snr = 20 * float(np.sqrt(np.mean(_hamming_power())))
    assert _std(errors) / bound_px(4.0, raw_snr) == pytest.approx(1, abs=0.25)
    assert 1.4 < normalised.mean() < 2.9


def _hamming_power() -> np.ndarray:
    k_row, k_col = np.fft.fftfreq(SHAPE[0]), np.fft.fftfreq(SHAPE[1])
    return Psf("hamming").window(k_row[:, None], k_col[None, :]) ** 2


def test_shifts_that_add_up_to_zero_cancel_an_error_of_the_jacobian() -> None:
    truth = np.add(MIDDLE, (0.13, -0.29))
    wrong = QUARTERS * 1.05
    frames = [np.abs(render_disc(SHAPE, (r, c), 4.0)) for r, c in truth + QUARTERS]
    found = localize(frames, QUARTERS, start_px=MIDDLE, radius_px=(2.5, 6))
    noisy = localize(frames, wrong, start_px=MIDDLE, radius_px=(2.5, 6), shift_sigma_px=0.02)
    assert np.hypot(*(noisy.centre_px - found.centre_px)) < 1e-4


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_shading_of_two_percent_a_pixel_does_not_move_the_centre(background: float) -> None:
    errors, _ = _campaign(
        60, 4.0, 40, QUARTERS, seed=20, slopes=(0.02, -0.02), background=background
    )
    of_the_mean = errors.std(axis=0) / np.sqrt(len(errors))
    assert np.all(np.abs(errors.mean(axis=0)) < 0.002 + 2 * of_the_mean)


def test_shading_without_noise_does_not_move_the_centre() -> None:
    truth = np.add(MIDDLE, (0.21, 0.34))
    frame = np.abs(render_disc(SHAPE, (truth[0], truth[1]), 4.0, slopes=(0.02, 0.01)))
    found = localize(frame, start_px=MIDDLE, radius_px=(2.5, 6))
    assert np.hypot(*(found.centre_px - truth)) < 0.002


@pytest.mark.parametrize("true", [Psf("box"), Psf("gaussian", (0.5,))], ids=lambda p: p.kind)
def test_the_wrong_point_spread_costs_little(true: Psf) -> None:
    flat = Psf("flat")
    trials = 150
    one_right, _ = _campaign(trials, 4.0, 20, NONE, seed=21, psf=true)
    one_wrong, _ = _campaign(trials, 4.0, 20, NONE, seed=21, psf=true, fitted=flat)
    assert _mean_error(one_wrong) - _mean_error(one_right) < 0.02
    four_right, _ = _campaign(trials, 4.0, 20, QUARTERS, seed=22, psf=true)
    four_wrong, _ = _campaign(trials, 4.0, 20, QUARTERS, seed=22, psf=true, fitted=flat)
    assert _mean_error(four_wrong) - _mean_error(four_right) < 0.002


def test_a_sphere_cut_off_centre_is_localized_without_bias() -> None:
    truth = np.add(MIDDLE, (0.17, -0.38))
    rng = np.random.default_rng(22)
    clean = render_sphere_slab(SHAPE, (truth[0], truth[1]), 5.0, slab_px=(1.5, 4.0))
    frames = [rician(clean, 0.01, rng) for _ in range(8)]
    found = localize(frames, np.zeros((8, 2)), start_px=MIDDLE, radius_px=(2.5, 7))
    assert np.hypot(*(found.centre_px - truth)) < 0.01


def test_a_bubble_is_masked_and_does_not_pull_the_centre() -> None:
    truth = np.add(MIDDLE, (0.2, 0.1))
    clean = render_disc(SHAPE, (truth[0], truth[1]), 6.0)
    clean -= render_disc(SHAPE, (truth[0] + 2, truth[1] + 2), 1.2)
    rng = np.random.default_rng(23)
    frames = [rician(clean, 0.02, rng) for _ in range(4)]
    shifts = np.zeros((4, 2))
    masked = localize(frames, shifts, start_px=MIDDLE, radius_px=(4, 8))
    plain = localize(frames, shifts, start_px=MIDDLE, radius_px=(4, 8), robust=False)
    error, plain_error = (float(np.hypot(*(x.centre_px - truth))) for x in (masked, plain))
    assert error < 0.03
    assert error < 0.5 * plain_error
