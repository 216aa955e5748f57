"""The closed form against a dense solve, against zero-filling, and on bad input."""

import math
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sr_engine.errors import NotFiniteError, ParameterError, ShapeError, SingularShiftSetError
from sr_engine.frames import Region
from sr_engine.psf import Psf
from sr_engine.reconstruction import shiftset
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.fourier import Prior, prepare_filters, reconstruct_fourier
from sr_engine.reconstruction.ibp import PAPER, reconstruct_ibp
from sr_engine.reconstruction.reconstruct import reconstruct
from sr_engine.simulate import render_disc

Array = NDArray[np.float64]


def _axis_matrix(size: int, factor: int, shift: float, blur: Blur) -> Array:
    """One axis of the forward model, summed frequency by frequency in the space domain."""
    fine = size * factor
    position = factor * (np.arange(size) - shift) + (factor - 1) / 2
    matrix = np.full((size, fine), 1.0 / fine)
    for order in range(1, fine // 2 + 1):
        angle = 2 * math.pi * order / fine
        weight = float(blur.transfer(np.array([order / size]))[0]) / fine
        if 2 * order == fine:
            wave = np.cos(angle * position)[:, None] * np.cos(angle * np.arange(fine))
        else:
            wave = 2 * np.cos(angle * (position[:, None] - np.arange(fine)))
        matrix += weight * wave
    return matrix


def _laplacian(size: int) -> Array:
    identity = np.eye(size)
    return 2 * identity - np.roll(identity, 1, axis=0) - np.roll(identity, -1, axis=0)


def _dense(frames: Array, shifts: Array, factor: int, blur: Blur, prior: Prior) -> Array:
    rows, cols = frames.shape[1:]
    views = [
        np.kron(_axis_matrix(rows, factor, d[0], blur), _axis_matrix(cols, factor, d[1], blur))
        for d in shifts
    ]
    stacked = np.vstack(views)
    if prior.smooth:
        along = [_laplacian(factor * size) for size in (rows, cols)]
        ones = [np.eye(factor * size) for size in (rows, cols)]
        gamma = (np.kron(along[0], ones[1]) + np.kron(ones[0], along[1])) / 8
    else:
        gamma = np.eye(factor**2 * rows * cols)
    weight = prior.strength * len(frames) / factor**2
    system = stacked.T @ stacked + weight * gamma
    return np.linalg.solve(system, stacked.T @ frames.ravel()).reshape(factor * rows, -1)


CASES = [
    (2, (6, 9), "quarter", Blur(), Prior(1e-3)),
    (2, (7, 5), "half", Blur(box=True), Prior(1e-2, smooth=False)),
    (2, (8, 6), "lattice5", Blur(gaussian_sigma_px=0.4), Prior(1e-3)),
    (3, (4, 7), "third", Blur(), Prior(1e-3)),
    (4, (4, 5), "eighth", Blur(box=True), Prior(1e-2, smooth=False)),
]


@pytest.mark.parametrize(("factor", "shape", "name", "blur", "prior"), CASES)
def test_the_closed_form_equals_a_dense_solve(
    factor: int, shape: tuple[int, int], name: str, blur: Blur, prior: Prior
) -> None:
    shifts = shiftset.named(name).as_array()
    frames = np.random.default_rng(3).normal(size=(len(shifts), *shape))
    closed = reconstruct_fourier(frames, shifts, factor, blur=blur, prior=prior)
    dense = _dense(frames, shifts, factor, blur, prior)
    assert np.abs(closed - dense).max() < 1e-10 * np.abs(dense).max()


def test_the_closed_form_equals_a_dense_solve_for_the_papers_random_shifts() -> None:
    shifts = shiftset.paper_random(np.random.default_rng(8), 6).as_array()
    frames = np.random.default_rng(4).normal(size=(6, 7, 6))
    prior = Prior(1e-2)
    closed = reconstruct_fourier(frames, shifts, 2, prior=prior)
    dense = _dense(frames, shifts, 2, Blur(), prior)
    assert np.abs(closed - dense).max() < 1e-10 * np.abs(dense).max()


@settings(max_examples=20, deadline=None)
@given(
    shape=st.tuples(st.integers(4, 8), st.integers(4, 8)),
    count=st.integers(4, 7),
    seed=st.integers(0, 10**6),
    blur=st.sampled_from([Blur(), Blur(box=True), Blur(gaussian_sigma_px=0.3)]),
    smooth=st.booleans(),
)
def test_the_closed_form_equals_a_dense_solve_for_any_shape_and_any_shifts(
    shape: tuple[int, int], count: int, seed: int, blur: Blur, smooth: bool
) -> None:
    rng = np.random.default_rng(seed)
    shifts = shiftset.paper_random(rng, count).as_array()
    frames = rng.normal(size=(count, *shape))
    prior = Prior(0.05, smooth)
    if shiftset.condition_number(shifts) > 1e3:
        return
    closed = reconstruct_fourier(frames, shifts, 2, blur=blur, prior=prior)
    dense = _dense(frames, shifts, 2, blur, prior)
    assert np.abs(closed - dense).max() < 1e-10 * np.abs(dense).max()


# A magnitude is known at its samples only, and the half-pixel set samples beside the fine grid.
@pytest.mark.parametrize(
    ("name", "magnitude"), [("quarter", False), ("quarter", True), ("half", False)]
)
def test_four_interlaced_frames_equal_one_frame_filled_with_zeros(
    name: str, magnitude: bool
) -> None:
    shape, centre, radius = (41, 53), (19.3, 27.8), 4.0
    shifts = shiftset.named(name).as_array()
    frames = np.stack(
        [render_disc(shape, (centre[0] + r, centre[1] + c), radius) for r, c in shifts]
    )
    fine_shape, fine_centre = (82, 106), (2 * centre[0] + 0.5, 2 * centre[1] + 0.5)
    zero_filled = render_disc(fine_shape, fine_centre, 2 * radius, psf=Psf(acquired=(0.5, 0.5)))
    if magnitude:
        frames, zero_filled = np.abs(frames), np.abs(zero_filled)
    fine = reconstruct_fourier(frames, shifts, 2, prior=Prior(0.0))
    assert np.abs(fine - zero_filled).max() < 1e-9


def test_a_shifted_object_brings_no_other_k_space_data() -> None:
    shape, centre = (40, 56), (18.2, 30.9)
    reference = np.fft.fft2(render_disc(shape, centre, 4.0))
    for row, col in shiftset.paper_random(np.random.default_rng(1)).shifts_px:
        moved = np.fft.fft2(render_disc(shape, (centre[0] + row, centre[1] + col), 4.0))
        k_row, k_col = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]
        phase = np.exp(-2j * math.pi * (k_row * row + k_col * col))
        inside = (np.abs(k_row) < 0.5) & (np.abs(k_col) < 0.5)
        assert np.abs((moved - phase * reference)[inside]).max() < 1e-12 * np.abs(reference).max()


@pytest.mark.parametrize(
    "shifts",
    [
        [(0.0, 0.0), (0.25, 0.25), (0.5, 0.5), (0.75, 0.75)],
        [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (-2.0, 3.0)],
        [(0.0, 0.0), (0.0, 0.5), (0.0, 0.25), (0.0, 0.75)],
    ],
    ids=["one diagonal", "whole pixels", "one row"],
)
def test_singular_shift_sets_are_refused(shifts: list[tuple[float, float]]) -> None:
    frames = np.random.default_rng(0).normal(size=(4, 12, 9))
    with pytest.raises(SingularShiftSetError, match="singular for factor 2"):
        reconstruct(frames, shifts)


def test_too_few_frames_for_the_factor_are_refused_with_the_number_needed() -> None:
    shifts = shiftset.named("quarter").as_array()
    with pytest.raises(SingularShiftSetError, match="factor 3 needs at least 9 shifts, got 4"):
        reconstruct(np.zeros((4, 12, 9)), shifts, 3)


def test_a_singular_set_can_be_left_to_the_prior_on_demand() -> None:
    frame = render_disc((24, 30), (11.0, 14.0), 4.0)
    done = reconstruct(frame, [(0.0, 0.0)], max_condition_number=math.inf)
    assert done.condition_number == math.inf
    assert np.isfinite(done.image).all()
    assert done.image[23, 29] == pytest.approx(frame[11:13, 14:16].mean(), abs=0.1)


@pytest.mark.parametrize("method", ["fourier", "ibp"])
@pytest.mark.parametrize(("factor", "name"), [(2, "quarter"), (3, "third"), (4, "eighth")])
def test_the_object_stands_where_it_was_in_the_reference_pose(
    method: str, factor: int, name: str
) -> None:
    shape, centre = (33, 48), np.array([14.37, 29.81])
    shifts = shiftset.named(name).as_array() + np.array([0.15, -0.4])
    frames = np.stack([render_disc(shape, tuple(centre + d), 4.0) for d in shifts])
    region = Region(4, 17, 26, 43)
    done = reconstruct(frames, shifts, factor, method, region=region)  # type: ignore[arg-type]
    assert done.image.shape == (22 * factor, 26 * factor)
    rows, cols = np.indices(done.image.shape)
    weight = np.where(done.image > 0.3, done.image, 0.0)
    found = np.array([(weight * rows).sum(), (weight * cols).sum()]) / weight.sum()
    assert np.abs(done.frame_from_fine(found) - centre).max() < 0.03
    assert np.allclose(done.fine_from_frame(done.frame_from_fine(found)), found)


def test_a_region_gives_the_same_as_the_whole_frame_there() -> None:
    shifts = shiftset.named("quarter").as_array()
    frames = np.stack([render_disc((64, 80), (30 + r, 41 + c), 5.0) for r, c in shifts])
    region = Region(15, 25, 46, 58)
    full = reconstruct(frames, shifts).image[30:92, 50:116]
    assert np.abs(reconstruct(frames, shifts, region=region).image - full).max() < 0.01


def test_the_blended_border_keeps_a_camera_frame_from_ringing() -> None:
    # Off the fine grid: on it, interlacing needs no neighbours and nothing could ring.
    shifts = shiftset.named("quarter").as_array() + 0.1
    rows, cols = np.indices((40, 52)).astype(float)
    frames = np.stack([0.02 * (rows - r) + 0.01 * (cols - c) for r, c in shifts])
    fine_rows, fine_cols = (np.indices((80, 104)) + 0.5) / 2 - 0.5
    truth = 0.02 * fine_rows + 0.01 * fine_cols
    error = {
        border: np.abs(reconstruct(frames, shifts, border=border).image - truth)  # type: ignore[arg-type]
        for border in ("periodic", "blend")
    }
    assert error["blend"].max() < 0.05 * error["periodic"].max()
    inner = (slice(12, -12), slice(12, -12))
    assert error["blend"][inner].max() < 0.3 * error["periodic"][inner].max()


def test_the_mean_brightness_survives_the_smooth_prior() -> None:
    shifts = shiftset.named("lattice5").as_array()
    frames = np.full((5, 20, 31), 7.5)
    assert np.allclose(reconstruct(frames, shifts).image, 7.5, atol=1e-9)


def test_filters_are_made_once_for_one_shift_set() -> None:
    shifts = shiftset.named("quarter").as_array()
    assert prepare_filters((17, 23), shifts) is prepare_filters((17, 23), shifts.tolist())


@pytest.mark.parametrize(
    ("frames", "shifts", "error", "message"),
    [
        ([], [], ShapeError, "list of frames is empty"),
        (np.zeros((4, 9, 9)), [], ShapeError, "list of shifts is empty"),
        (np.zeros((4, 9, 9)), [(0, 0)] * 3, ShapeError, "frames 4, shifts 3"),
        ([np.zeros((9, 9)), np.zeros((9, 8))], [(0, 0)] * 2, ShapeError, "frame 1"),
        (np.zeros((4, 9, 9)), [(0, 0, 0)] * 4, ShapeError, "shape"),
        (np.zeros((4, 9, 9)), None, ShapeError, "without shifts"),
        (np.full((1, 9, 9), np.nan), [(0, 0)], NotFiniteError, "row 0, col 0"),
        (np.zeros((1, 9, 9)), [(0, math.nan)], NotFiniteError, r"shifts_px\[0\]"),
        (np.zeros((1, 9, 2)), [(0, 0)], ShapeError, "at least 4 px"),
        (np.zeros((1, 9)), [(0, 0)], ShapeError, "shape"),
        ("no pixels", [(0, 0)], ShapeError, "not a rectangular array"),
        (np.zeros((1, 9, 9), complex), [(0, 0)], ShapeError, "complex"),
    ],
)
def test_bad_frames_and_shifts_give_a_typed_reason(
    frames: object, shifts: object, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        reconstruct(frames, shifts)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "wrong",
    [
        {"factor": 5},
        {"factor": 2.5},
        {"method": "magic"},
        {"prior": "strong"},
        {"region": Region(0, 0, 13, 9)},
        {"region": Region(3, 3, 5, 9)},
    ],
)
def test_bad_parameters_give_a_typed_reason(wrong: dict[str, object]) -> None:
    shifts = shiftset.named("quarter").as_array()
    if wrong == {"prior": "strong"}:
        with pytest.raises(ParameterError):
            Prior(math.nan)
        return
    with pytest.raises((ParameterError, ShapeError)):
        reconstruct(np.zeros((4, 12, 9)), shifts, **wrong)  # type: ignore[arg-type]


def test_a_reconstruction_is_fast_and_fifty_times_faster_than_a_hundred_iterations() -> None:
    shifts = shiftset.named("quarter").as_array()
    frames = np.stack([render_disc((128, 128), (63.2 + r, 64.9 + c), 4.0) for r, c in shifts])
    frames = np.abs(frames + np.random.default_rng(0).normal(0, 0.05, frames.shape))
    reconstruct(frames, shifts)
    closed, iterated = [], []
    # Processor time, in turns: other work on the machine must not decide.
    for _ in range(5):
        closed += [_cpu_s(lambda: reconstruct(frames, shifts)) for _ in range(5)]
        iterated.append(_cpu_s(lambda: reconstruct_ibp(frames, shifts, stopping=PAPER)))
    assert np.median(closed) <= 6e-3
    assert np.median(iterated) >= 50 * np.median(closed)


def _cpu_s(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start
