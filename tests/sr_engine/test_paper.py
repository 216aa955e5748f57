"""The paper's three methods: their order, their signs, and what they refuse."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sr_engine.errors import (
    AmbiguousObjectError,
    ConstantFrameError,
    InconsistentFramesError,
    NoRoundObjectError,
    NotFiniteError,
    ObjectAtBorderError,
    OutsideGateError,
    ParameterError,
    SaturatedError,
    ShapeError,
)
from sr_engine.hough import HoughSettings
from sr_engine.localize import localize
from sr_engine.paper import PaperSettings, localize_paper, sigma_px
from sr_engine.reconstruction import shiftset
from sr_engine.reconstruction.ibp import PAPER
from sr_engine.simulate import render_disc, rician

Array = NDArray[np.float64]

SHAPE = (72, 90)
CENTRE = np.array([33.4, 47.2])
SETTINGS = PaperSettings(hough=HoughSettings((2.0, 10.0)))


def _frames(shifts: Array, snr: float = 20.0, seed: int = 0, centre: Array = CENTRE) -> Array:
    rng = np.random.default_rng(seed)
    return np.stack(
        [rician(render_disc(SHAPE, tuple(centre + d), 5.0), 1 / snr, rng) for d in shifts]
    )


@pytest.mark.parametrize("method", ["base", "bicubic", "sr"])
@pytest.mark.parametrize("start", [None, (34.0, 46.0)])
def test_each_method_finds_the_centre_in_the_reference_pose(
    method: str, start: tuple[float, float] | None
) -> None:
    # Displacements of more than the tolerance: a wrong sign would show.
    shifts = shiftset.paper_random(np.random.default_rng(3)).as_array() + np.array([0.9, -0.7])
    found = localize_paper(_frames(shifts), shifts, method, start_px=start, settings=SETTINGS)
    assert math.dist(found.centre_px, CENTRE) < 0.25
    assert found.radius_px == pytest.approx(5.0, abs=1.0)
    assert found.snr == pytest.approx(20.0, rel=0.5)
    assert (found.method, found.n_frames) == (method, 4)
    assert found.residuals_px.shape == (4, 2)
    assert (np.linalg.eigvalsh(found.covariance_px2) > 0).all()


@pytest.mark.parametrize("method", ["base", "bicubic", "sr"])
def test_localize_hands_the_papers_methods_on(method: str) -> None:
    shifts = shiftset.paper_random(np.random.default_rng(3)).as_array()
    frames = _frames(shifts)
    found = localize(frames, shifts, method=method, start_px=CENTRE, radius_px=(3.0, 7.0))
    assert found.method == method
    assert math.dist(found.centre_px, CENTRE) < 0.25
    with pytest.raises(OutsideGateError):
        localize(frames, shifts, method=method, start_px=CENTRE + 1.5, gate_px=0.5)
    with pytest.raises(SaturatedError):
        localize(frames, shifts, method=method, start_px=CENTRE, saturation_level=0.8)
    with pytest.raises(ParameterError, match="known: ml, sr, bicubic, base"):
        localize(frames, shifts, method="median")


def test_one_frame_needs_no_shift() -> None:
    found = localize_paper(_frames(np.zeros((1, 2)))[0], method="base", settings=SETTINGS)
    assert math.dist(found.centre_px, CENTRE) < 0.4


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_the_reconstruction_may_be_finer_still(factor: int) -> None:
    shifts = shiftset.paper_random(np.random.default_rng(3)).as_array()
    settings = PaperSettings(SETTINGS.hough, factor, stopping=PAPER)
    found = localize_paper(_frames(shifts, 50.0), shifts, "sr", start_px=CENTRE, settings=settings)
    assert math.dist(found.centre_px, CENTRE) < 0.25


def test_the_covariance_reported_is_the_papers_mean_error() -> None:
    for method, mean in (("base", 0.156), ("bicubic", 0.135), ("sr", 0.066)):
        draws = np.random.default_rng(0).normal(0, sigma_px(method), size=(200_000, 2))
        assert np.hypot(*draws.T).mean() == pytest.approx(mean, rel=0.01)


def test_a_frame_taken_at_another_shift_is_refused_by_name() -> None:
    shifts = shiftset.named("quarter").as_array()
    frames = _frames(shifts)
    frames[2] = np.roll(frames[2], 3, axis=1)
    with pytest.raises(InconsistentFramesError, match="frame 2 disagrees with its shift"):
        localize_paper(frames, shifts, "sr", start_px=CENTRE, settings=SETTINGS)


def test_a_circle_outside_of_the_gate_is_refused() -> None:
    frame = _frames(np.zeros((1, 2)))
    with pytest.raises(OutsideGateError, match=r"allowed 1 px"):
        localize_paper(frame, None, "base", start_px=CENTRE + 2.0, gate_px=1.0, settings=SETTINGS)
    with pytest.raises(ParameterError, match="gate needs a predicted position"):
        localize_paper(frame, None, "base", gate_px=1.0, settings=SETTINGS)


def test_two_equal_circles_are_refused_without_a_start_and_told_apart_with_one() -> None:
    disc = render_disc(SHAPE, (33.0, 24.0), 5.0)
    frame = disc + np.roll(disc, 40, axis=1)
    with pytest.raises(AmbiguousObjectError, match="two circles are equally good"):
        localize_paper(frame, None, "bicubic", settings=SETTINGS)
    found = localize_paper(frame, None, "bicubic", start_px=(33, 64), settings=SETTINGS)
    assert math.dist(found.centre_px, (33.0, 64.0)) < 0.3


def test_a_circle_cut_by_the_border_is_refused() -> None:
    rng = np.random.default_rng(1)
    frame = rician(render_disc((72, 110), (33.0, 88.0), 6.0)[:, :90], 0.02, rng)
    with pytest.raises((ObjectAtBorderError, NoRoundObjectError)):
        localize_paper(frame, None, "base", start_px=(33, 87), settings=SETTINGS)


@pytest.mark.parametrize("method", ["base", "bicubic", "sr"])
def test_noise_alone_has_no_circle_near_the_start(method: str) -> None:
    frames = rician(np.zeros((4, *SHAPE)), 1.0, np.random.default_rng(0))
    shifts = shiftset.named("quarter").as_array()
    with pytest.raises((NoRoundObjectError, InconsistentFramesError)):
        localize_paper(frames, shifts, method, start_px=CENTRE, settings=SETTINGS)


@pytest.mark.parametrize(
    ("frames", "shifts", "error"),
    [
        ([], None, ShapeError),
        (np.ones((2, *SHAPE)), [], ShapeError),
        (np.ones((2, *SHAPE)), None, ShapeError),
        (np.ones((2, *SHAPE)), [(0, 0)], ShapeError),
        (np.ones(SHAPE), None, ConstantFrameError),
        (np.full(SHAPE, math.inf), None, NotFiniteError),
    ],
)
def test_bad_frames_give_a_typed_reason(
    frames: object, shifts: object, error: type[Exception]
) -> None:
    with pytest.raises(error):
        localize_paper(frames, shifts, "sr")  # type: ignore[arg-type]


def test_an_unknown_method_and_a_start_that_is_none_are_refused() -> None:
    with pytest.raises(ParameterError, match="'median'; base, bicubic or sr"):
        localize_paper(np.ones(SHAPE), None, "median")
    with pytest.raises(ParameterError, match="start_px"):
        localize_paper(np.ones(SHAPE), None, "base", start_px=(math.nan, 3.0))
