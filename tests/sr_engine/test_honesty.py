"""The reported covariance against the scatter, for every point spread that is accepted."""

import numpy as np
import pytest
from scipy.special import j1

from dicom_slice.geometry import SliceGeometry
from sr_engine.errors import EngineError, NoRoundObjectError, NotConvergedError
from sr_engine.localize import localize
from sr_engine.psf import Psf
from sr_engine.request import localize_request
from sr_engine.simulate import filtered_noise, render_disc
from sr_engine.views import Frames

KINDS = ("flat", "hamming", "fermi", "elliptical")
ACQUIRED = ((1.0, 1.0), (0.8, 0.8), (2 / 3, 2 / 3), (0.5, 0.5), (1.0, 0.5))
BACKGROUNDS = (0.0, 0.3)
EVERY = [(kind, a, b) for kind in KINDS for a in ACQUIRED for b in BACKGROUNDS]
A_FEW = [
    ("flat", (0.5, 0.5), 0.0),
    ("hamming", (2 / 3, 2 / 3), 0.3),
]


def normalised_squares(psf: Psf, background: float, snr: float, trials: int) -> np.ndarray:
    """(trials,) squared errors over the covariance that came with them; 2 on average."""
    rng = np.random.default_rng(1)
    out = []
    radius = 4 / max(psf.acquired)
    for _ in range(trials):
        true = np.array((52.0, 60.0)) + rng.uniform(-4, 4, 2)
        clean = render_disc((104, 120), tuple(true), radius, background=background, psf=psf)
        channels = [filtered_noise(clean.shape, 1 / snr, psf, rng) for _ in range(2)]
        found = localize(
            np.hypot(clean + channels[0], channels[1]),
            start_px=true + rng.normal(0, 0.4, 2),
            radius_px=(0.6 * radius, 1.6 * radius),
            psf=psf,
        )
        error = found.centre_px - true
        out.append(error @ np.linalg.solve(found.covariance_px2, error))
    return np.array(out)


@pytest.mark.parametrize(("kind", "acquired", "background"), A_FEW)
def test_covariance_is_what_the_scatter_is(
    kind: str, acquired: tuple[float, float], background: float
) -> None:
    squares = normalised_squares(Psf(kind, acquired=acquired), background, 60, 24)
    assert 0.9 < squares.mean() < 3.6


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("snr", [20, 60])
@pytest.mark.parametrize(("kind", "acquired", "background"), EVERY)
def test_covariance_is_what_the_scatter_is_everywhere(
    kind: str, acquired: tuple[float, float], background: float, snr: float
) -> None:
    squares = normalised_squares(Psf(kind, acquired=acquired), background, snr, 300)
    assert 1.6 < squares.mean() < 2.45


def test_a_ring_never_ends_in_anything_but_an_answer_or_a_refusal() -> None:
    """The disc fit of a ring can slide to an object without contrast: refused, not crashed."""
    rng = np.random.default_rng(4)
    outcomes = []
    for _ in range(60):
        centre = tuple(np.array((50.0, 62.0)) + rng.uniform(-3, 3, 2))
        clean = render_disc((100, 124), centre, 5.0) - render_disc((100, 124), centre, 3.3)
        frame = np.hypot(clean + rng.normal(0, 0.05, clean.shape), rng.normal(0, 0.05, clean.shape))
        try:
            found = localize(frame, start_px=centre, radius_px=(2.5, 6.5))
        except EngineError as error:
            outcomes.append(type(error))
        else:
            assert np.all(np.linalg.eigvalsh(found.covariance_px2) > 0)
    assert set(outcomes) <= {NoRoundObjectError, NotConvergedError}


def oval(centre: np.ndarray, radius: float, ratio: float, angle: float) -> np.ndarray:
    """(100, 124) image of an ellipse, from analytic k-space."""
    k_row, k_col = np.fft.fftfreq(100)[:, None], np.fft.fftfreq(124)[None, :]
    u = k_row * np.cos(angle) + k_col * np.sin(angle)
    v = k_col * np.cos(angle) - k_row * np.sin(angle)
    a, b = radius * ratio**0.5, radius / ratio**0.5
    q = np.maximum(np.hypot(a * u, b * v), 1e-12)
    spectrum = a * b * j1(2 * np.pi * q) / q
    phase = np.exp(-2j * np.pi * (k_row * centre[0] + k_col * centre[1]))
    return np.fft.ifft2(spectrum * phase).real


@pytest.mark.parametrize("ratio", [1.06, 1.15])
def test_the_disc_fit_of_an_oval_says_what_its_mask_may_have_done(ratio: float) -> None:
    """Pixels at one end of the outline are left out as odd: the centre goes, and sigma says so."""
    rng = np.random.default_rng(3)
    sigmas = []
    for _ in range(12):
        centre = np.array((50.0, 62.0)) + rng.uniform(-0.5, 0.5, 2)
        clean = oval(centre, 5.0, ratio, rng.uniform(0, np.pi))
        frame = np.hypot(
            clean + rng.normal(0, 1 / 60, clean.shape), rng.normal(0, 1 / 60, clean.shape)
        )
        found = localize(frame, start_px=centre + rng.normal(0, 0.3, 2), radius_px=(2.5, 6.5))
        error = found.centre_px - centre
        sigmas.append(np.sqrt(error @ np.linalg.solve(found.covariance_px2, error)))
    assert np.max(sigmas) < 4


def with_a_spot(
    centre: np.ndarray,
    shifts: np.ndarray,
    level: float = 0.2,
    radius: float = 1.5,
    away: float = 2.5,
) -> list[np.ndarray]:
    """Frames of a disc, R 5 px, with a fainter spot that moves with it."""
    rng = np.random.default_rng(8)
    frames = []
    for place in centre + shifts:
        spot = render_disc((100, 124), tuple(place + np.array((0, away))), radius)
        clean = render_disc((100, 124), tuple(place), 5.0) + level * spot
        noise = rng.normal(0, 1 / 60, (2, *clean.shape))
        frames.append(np.hypot(clean + noise[0], noise[1]))
    return frames


def test_what_draws_a_disc_in_all_frames_alike_is_apart_and_does_not_average_out() -> None:
    """A spot at one side draws the centre of one frame as that of eight: only the noise shrinks."""
    centre = np.array((50.2, 61.9))
    shifts = np.random.default_rng(9).uniform(-0.5, 0.5, (8, 2))
    frames = with_a_spot(centre, shifts)
    one = localize(frames[0], start_px=centre + shifts[0], radius_px=(2.5, 6.5), robust=False)
    eight = localize(frames, shifts, start_px=centre, radius_px=(2.5, 6.5), robust=False)
    assert one.systematic_px is not None
    assert eight.systematic_px == pytest.approx(one.systematic_px, rel=0.3)
    noise_px = np.sqrt(np.diag(eight.covariance_px2))
    assert np.all(noise_px < 0.5 * np.sqrt(np.diag(one.covariance_px2)))
    bias = float(eight.centre_px[1] - centre[1])
    assert 1.5 * noise_px[1] < abs(bias) < 2 * eight.sigma_px[1]
    assert eight.sigma_px == pytest.approx(np.hypot(noise_px, eight.systematic_px))


def test_in_a_room_what_draws_a_disc_counts_for_every_target() -> None:
    """A calibration by discs knows no part that is common to all places."""
    centre = np.array((50.2, 61.9))
    frames = np.array(with_a_spot(centre, np.zeros((1, 2)), 0.3, 3, 3))
    geometry = SliceGeometry((0, 0, 0), (1, 0, 0), (0, 0, 1), (1.0, 1.0), frames[0].shape)
    request = {"radius_mm": (2.5, 6.5), "expected_plane_mm": None, "gate_mm": None}
    found = localize_request(Frames(frames, np.zeros((1, 2)), geometry, ()), "ml", request).by
    alone = localize(frames, start_px=found.centre_px, radius_px=(2.5, 6.5))
    assert alone.systematic_px is not None
    assert np.min(alone.systematic_px) > 0
    assert found.systematic_px is None
    assert found.common_px == pytest.approx(alone.systematic_px, rel=0.2)
    assert np.sqrt(np.diag(found.covariance_px2)) == pytest.approx(alone.sigma_px, rel=0.2)


def test_the_oval_is_not_taken_for_lopsided() -> None:
    frame = oval(np.array((50.3, 62.4)), 5.0, 1.06, 0.7)
    rng = np.random.default_rng(2)
    noise = rng.normal(0, 1 / 60, (2, *frame.shape))
    found = localize(
        np.hypot(frame + noise[0], noise[1]), start_px=(50, 62), radius_px=(2.5, 6.5), robust=False
    )
    assert np.all(found.systematic_px < 0.03)
