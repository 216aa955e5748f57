"""Gradient descent: its operators, its stopping rules, what it converges to."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sr_engine.errors import ParameterError, ShapeError
from sr_engine.psf import Psf
from sr_engine.reconstruction import shiftset
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.ibp import (
    PAPER,
    Stopping,
    estimate_noise_sigma,
    reconstruct_ibp,
    view_matrix,
)
from sr_engine.reconstruction.reconstruct import reconstruct
from sr_engine.simulate import render_disc, rician

Array = NDArray[np.float64]


def _frames(shifts: Array, sigma: float = 0.0, shape: tuple[int, int] = (40, 52)) -> Array:
    rng = np.random.default_rng(5)
    return np.stack(
        [rician(render_disc(shape, (19.2 + r, 27.7 + c), 4.0), sigma, rng) for r, c in shifts]
    )


def _seen(scene: Array, row: float, col: float, blur: Blur) -> Array:
    rows, cols = (
        view_matrix(size // 2, 2, shift, blur)
        for size, shift in zip(scene.shape, (row, col), strict=True)
    )
    return np.asarray(rows @ scene @ cols.T)


@pytest.mark.parametrize("blur", [Blur(), Blur(box=True), Blur(True, 0.5)])
@pytest.mark.parametrize("factor", [2, 3, 4])
def test_the_view_of_a_constant_scene_is_that_constant(factor: int, blur: Blur) -> None:
    matrix = view_matrix(17, factor, 0.37, blur)
    assert matrix.shape == (17, 17 * factor)
    assert np.allclose(matrix.sum(axis=1), 1.0)


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_the_view_of_a_ramp_is_the_ramp_moved_by_the_shift(factor: int) -> None:
    fine = (np.arange(30 * factor) + 0.5) / factor - 0.5
    seen = view_matrix(30, factor, 0.37, Blur(True, 0.4)) @ fine
    assert np.allclose(seen[5:-5], np.arange(30)[5:-5] - 0.37)


@pytest.mark.parametrize("count", [2, 3, 5, 9])
@pytest.mark.parametrize("factor", [2, 3, 4])
def test_any_number_of_frames_is_reconstructed_and_explained_better_each_iteration(
    count: int, factor: int
) -> None:
    shifts = shiftset.paper_random(np.random.default_rng(count), count).as_array()
    done = reconstruct_ibp(_frames(shifts), shifts, factor, stopping=Stopping(12, 0.0))
    assert done.image.shape == (40 * factor, 52 * factor)
    assert len(done.residual_history) == 13
    assert (np.diff(done.residual_history) < 0).all()


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_one_frame_is_explained_by_its_own_back_projection(factor: int) -> None:
    frames = _frames(np.zeros((1, 2)))
    done = reconstruct_ibp(frames, [(0.0, 0.0)], factor)
    assert done.iterations == 0
    assert np.allclose(done.image[::factor, ::factor], frames[0])


def test_the_papers_rule_stops_at_a_ten_thousandth_of_the_first_error() -> None:
    shifts = shiftset.named("quarter").as_array()
    done = reconstruct_ibp(_frames(shifts), shifts, stopping=PAPER)
    first, last = done.residual_history[0], done.residual_history[-1]
    if done.stopped_by == "relative-mse":
        assert last <= 1e-4 * first < done.residual_history[-2]
    else:
        assert (done.stopped_by, done.iterations) == ("max-iterations", 100)
    tight = Stopping(relative_mse=0.5)
    early = reconstruct_ibp(_frames(shifts), shifts, stopping=tight)
    assert early.stopped_by == "relative-mse"
    assert early.residual_history[-1] <= 0.5 * first < early.residual_history[-2]


def test_the_papers_rule_stops_at_a_hundred_iterations_on_noisy_frames() -> None:
    shifts = shiftset.named("quarter").as_array()
    done = reconstruct_ibp(_frames(shifts, 0.1), shifts, stopping=PAPER)
    assert (done.stopped_by, done.iterations) == ("max-iterations", 100)


def test_the_default_stops_at_the_noise_and_is_nearer_to_the_truth_than_the_papers_rule() -> None:
    shifts = shiftset.paper_random(np.random.default_rng(2)).as_array()
    truth = render_disc((80, 104), (38.9, 55.9), 8.0)
    blurred = np.stack([_seen(truth, r, c, Blur(True, 0.5)) for r, c in shifts])
    frames = blurred + np.random.default_rng(3).normal(0, 0.1, blurred.shape)
    default = reconstruct_ibp(frames, shifts, blur=Blur(True, 0.5))
    paper = reconstruct_ibp(frames, shifts, blur=Blur(True, 0.5), stopping=PAPER)
    assert default.stopped_by == "noise"
    assert default.iterations < 50 < paper.iterations
    error = [np.sqrt(np.mean((done.image - truth) ** 2)) for done in (default, paper)]
    assert error[0] < error[1]


def test_a_scene_that_its_frames_determine_is_found_again() -> None:
    scene = render_disc((60, 84), (28.7, 41.2), 8.0, psf=Psf("hamming", acquired=(0.6, 0.6)))
    shifts = shiftset.named("third").as_array()
    frames = np.stack([_seen(scene, row, col, Blur()) for row, col in shifts])
    done = reconstruct_ibp(frames, shifts, blur=Blur(), stopping=Stopping(400, 0.0))
    assert done.residual_history[-1] < 1e-5 * done.residual_history[0]
    assert np.abs(done.image - scene)[4:-4, 4:-4].max() < 2e-3


def test_the_noise_is_estimated_from_the_frames_beside_a_bright_object() -> None:
    rng = np.random.default_rng(9)
    image = render_disc((60, 90), (22.0, 41.0), 9.0, 50.0, 20.0, psf=Psf("hamming"))
    frames = image + rng.normal(0, 0.7, size=(4, 60, 90))
    assert estimate_noise_sigma(frames) == pytest.approx(0.7, rel=0.1)


def test_each_iteration_can_be_watched() -> None:
    shifts = shiftset.named("quarter").as_array()
    seen: list[tuple[int, float]] = []
    done = reconstruct(
        _frames(shifts),
        shifts,
        method="ibp",
        stopping=Stopping(5, 0.0),
        observe=lambda iteration, mse: seen.append((iteration, mse)),
    )
    assert seen == list(enumerate(done.residual_history))[1:]
    assert done.iterations == 5


def test_constant_frames_stay_constant() -> None:
    shifts = shiftset.named("quarter").as_array()
    done = reconstruct_ibp(np.full((4, 12, 9), 3.25), shifts, stopping=PAPER)
    assert np.allclose(done.image, 3.25)
    assert math.isfinite(done.residual_history[-1])


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_iterations": 0},
        {"relative_mse": 1.0},
        {"relative_mse": math.nan},
        {"noise_sigma": -1.0},
        {"noise_sigma": math.inf},
    ],
)
def test_a_stopping_rule_that_cannot_work_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        Stopping(**wrong)  # type: ignore[arg-type]


def test_a_blur_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(ParameterError, match="gaussian_sigma_px"):
        Blur(gaussian_sigma_px=math.nan)


def test_frames_without_shifts_are_refused() -> None:
    with pytest.raises(ShapeError, match="list of shifts is empty"):
        reconstruct_ibp(np.zeros((2, 12, 9)), [])
