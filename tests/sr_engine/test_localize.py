"""The maximum-likelihood fit on simulated frames with known truth."""

import numpy as np
import pytest

from sr_engine.errors import (
    AmbiguousObjectError,
    ConstantFrameError,
    EngineError,
    InconsistentFramesError,
    NoRoundObjectError,
    NotFiniteError,
    ObjectAtBorderError,
    OutsideGateError,
    ParameterError,
    SaturatedError,
    ShapeError,
)
from sr_engine.localize import localize
from sr_engine.psf import Psf
from sr_engine.simulate import render_disc, rician

SHAPE = (96, 128)
QUARTERS = np.array([(0.25, 0.25), (0.25, -0.25), (-0.25, 0.25), (-0.25, -0.25)])
TRUTH = np.array([47.31, 70.84])


def _frames(
    snr: float, shifts: np.ndarray = QUARTERS, seed: int = 3, radius: float = 4.0
) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    centres = [(float(r), float(c)) for r, c in TRUTH + shifts]
    return [rician(render_disc(SHAPE, c, radius), 1 / snr, rng) for c in centres]


def _error_px(centre: np.ndarray) -> float:
    return float(np.hypot(*(centre - TRUTH)))


def test_four_shifted_frames_give_the_centre_in_the_reference_pose() -> None:
    found = localize(_frames(40), QUARTERS, start_px=np.add(TRUTH, (1.0, -0.8)), radius_px=(2, 8))
    assert _error_px(found.centre_px) < 0.02
    assert found.radius_px == pytest.approx(4.0, abs=0.05)
    assert found.snr == pytest.approx(40, rel=0.15)
    assert found.n_frames == 4
    assert found.residuals_px.shape == (4, 2)


def test_an_object_alone_is_found_without_a_start() -> None:
    found = localize(_frames(20), QUARTERS)
    assert _error_px(found.centre_px) < 0.06


def test_a_dark_object_on_a_bright_surrounding_is_as_good() -> None:
    rng = np.random.default_rng(4)
    image = render_disc(SHAPE, (47.31, 70.84), 5.0, amplitude=-1.0, background=1.5)
    found = localize(rician(image, 0.03, rng), radius_px=(3, 8))
    assert _error_px(found.centre_px) < 0.05
    assert found.amplitude < 0


def test_a_frame_taken_at_another_shift_is_noticed_and_named() -> None:
    frames = _frames(20)
    wrong = QUARTERS.copy()
    wrong[2] += (0.0, 0.3)
    with pytest.raises(InconsistentFramesError, match="frame 2"):
        localize(frames, wrong, start_px=TRUTH)


def test_a_known_uncertainty_of_the_shifts_widens_the_covariance_as_it_must() -> None:
    frames = _frames(20)
    sure = localize(frames, QUARTERS, start_px=TRUTH)
    unsure = localize(frames, QUARTERS, start_px=TRUTH, shift_sigma_px=0.1)
    growth = np.diag(unsure.covariance_px2 - sure.covariance_px2)
    np.testing.assert_allclose(growth, 0.1**2 / 4, rtol=0.02)


def test_nan_pixels_are_refused() -> None:
    frames = _frames(20)
    frames[1][5, 7] = np.nan
    with pytest.raises(NotFiniteError, match="frame 1"):
        localize(frames, QUARTERS)


def test_a_constant_frame_is_refused() -> None:
    with pytest.raises(ConstantFrameError):
        localize(np.full(SHAPE, 7.0))


@pytest.mark.parametrize(
    ("frames", "shifts"),
    [
        ([], []),
        (np.zeros((0, 0)), None),
        (np.ones(5), None),
        ([np.eye(20), np.eye(21)], np.zeros((2, 2))),
        ([np.eye(20), np.eye(20)], np.zeros((3, 2))),
        ([np.eye(20), np.eye(20)], None),
        ([np.eye(20)], []),
        (np.eye(4), None),
    ],
)
def test_sizes_that_do_not_fit_together_are_refused(frames: object, shifts: object) -> None:
    with pytest.raises(ShapeError):
        localize(frames, shifts)  # type: ignore[arg-type]


def test_an_object_cut_by_the_border_is_refused() -> None:
    image = rician(render_disc(SHAPE, (2.0, 60.0), 4.0), 0.02, np.random.default_rng(0))
    image[60:] = rician(np.zeros((36, 128)), 0.02, np.random.default_rng(1))
    with pytest.raises(ObjectAtBorderError):
        localize(image, start_px=(2.0, 60.0))


def test_a_start_outside_of_the_frame_is_refused() -> None:
    with pytest.raises(ObjectAtBorderError):
        localize(_frames(20)[0], start_px=(500.0, 3.0))


def test_two_equal_objects_without_a_start_are_ambiguous() -> None:
    image = render_disc(SHAPE, (30.0, 40.0), 4.0) + render_disc(SHAPE, (60.0, 90.0), 4.0)
    frame = rician(image, 0.05, np.random.default_rng(2))
    with pytest.raises(AmbiguousObjectError):
        localize(frame)
    assert localize(frame, start_px=(60, 90)).centre_px == pytest.approx((60.0, 90.0), abs=0.06)


def test_noise_alone_has_no_round_object() -> None:
    noise = rician(np.zeros(SHAPE), 1.0, np.random.default_rng(8))
    with pytest.raises(NoRoundObjectError):
        localize(noise)
    with pytest.raises(EngineError):
        localize(noise, start_px=(40, 60))


def test_saturated_pixels_are_refused() -> None:
    frame = np.minimum(_frames(20)[0], 0.9)
    with pytest.raises(SaturatedError):
        localize(frame, start_px=TRUTH)
    with pytest.raises(SaturatedError):
        localize(_frames(20)[0], start_px=TRUTH, saturation_level=0.8)


def test_an_object_outside_of_its_gate_is_refused() -> None:
    start = np.add(TRUTH, (1.5, 0.0))
    assert localize(_frames(20)[0], start_px=start, gate_px=2.0).n_frames == 1
    with pytest.raises(OutsideGateError):
        localize(_frames(20)[0], start_px=start, gate_px=1.0)


def test_parameters_out_of_range_are_named() -> None:
    with pytest.raises(ParameterError, match="radius"):
        localize(_frames(20)[0], radius_px=(5, 2))
    with pytest.raises(ParameterError, match="method"):
        localize(_frames(20)[0], method="guess")


def test_a_camera_frame_is_fitted_with_square_pixels() -> None:
    rng = np.random.default_rng(5)
    image = render_disc(SHAPE, (47.31, 70.84), 6.0, psf=Psf("box"))
    frame = image + 0.02 * rng.standard_normal(SHAPE)
    assert _error_px(localize(frame, psf=Psf("box"), start_px=TRUTH).centre_px) < 0.04
