"""The template on frames made by physics that is not ours, and on input that is none.

tests/data/outside_physics: frames cut out of Bloch and k-space simulations of public packages, 36
positions each; `centre_px` is the truth. The tolerances are goals, not what the code happens to do.
"""

from pathlib import Path

import numpy as np
import pytest

from sr_engine.errors import (
    AmbiguousObjectError,
    EngineError,
    NoRoundObjectError,
    TemplateError,
    TemplateMismatchError,
)
from sr_engine.simulate import render_disc, rician
from sr_engine.template.learn import Template, learn_template

OUTSIDE = Path(__file__).parents[1] / "data/outside_physics"
LEARNT_FROM = 9
# mean error of the displacement between successive frames, px: a template of cubic splines has it
GOALS_PX = {
    "ring_5_2": 0.0226,
    "ring_5_2_gre_brass_3T": 0.0220,
    "bubble_big": 0.0276,
    "smooth3x3": 0.0348,
    "denoise_tv": 0.0310,
    "sos16": 0.0400,
}


def outside(name: str) -> tuple[np.ndarray, np.ndarray]:
    with np.load(OUTSIDE / f"{name}.npz") as data:
        return data["frames"].astype(float), data["centre_px"]


@pytest.mark.parametrize("name", GOALS_PX)
def test_displacements_and_their_sigma_on_outside_physics(name: str) -> None:
    frames, true = outside(name)
    template = learn_template(frames[:LEARNT_FROM], true[:LEARNT_FROM] - true[0])
    fits = [template.fit(frame) for frame in frames[LEARNT_FROM:]]
    errors = np.array([fit.centre_px for fit in fits]) - true[LEARNT_FROM:]
    steps = np.hypot(*np.diff(errors, axis=0).T)
    assert steps.mean() <= GOALS_PX[name]
    apart = errors - errors.mean(axis=0)
    squares = [
        one @ np.linalg.solve(fit.covariance_px2, one) for one, fit in zip(apart, fits, strict=True)
    ]
    assert 0.9 < np.mean(squares) < 3.1  # 2; 27 frames tell it to 0.4
    assert np.max(np.abs(errors.mean(axis=0)) / template.systematic_px) < 4


def scene(centre: tuple[float, float], still: tuple[float, float] | None = None) -> np.ndarray:
    image = render_disc((72, 88), centre, 4.0) + 0.0
    if still is not None:
        image = image + render_disc((72, 88), still, 4.0)
    return image


def frames_at(
    places: np.ndarray, rng: np.random.Generator, still: tuple[float, float] | None = None
) -> np.ndarray:
    return np.array([rician(scene(tuple(place), still), 0.05, rng) for place in places])


@pytest.fixture
def places() -> np.ndarray:
    return np.array((34.0, 42.0)) + np.random.default_rng(2).uniform(-3, 3, (9, 2))


def learnt(places: np.ndarray, seed: int = 3) -> Template:
    return learn_template(frames_at(places, np.random.default_rng(seed)), places - places[0])


def test_of_two_alike_the_one_that_moves_is_learnt(places: np.ndarray) -> None:
    frames = frames_at(places, np.random.default_rng(5), still=(20.0, 66.0))
    template = learn_template(frames, places - places[0])
    assert np.hypot(*(template.reference_px - places[0])) < 0.1
    with pytest.raises(AmbiguousObjectError):
        template.fit(frames[0])
    fit = template.fit(frames[0], region=(24, 30, 48, 54))
    assert np.hypot(*(fit.centre_px - places[0])) < 0.1


def test_a_region_finds_what_the_whole_frame_does_and_none_lies_outside(places: np.ndarray) -> None:
    template = learnt(places)
    frame = frames_at(places[:1], np.random.default_rng(5))[0]
    everywhere = template.fit(frame)
    row, col = np.rint(everywhere.centre_px).astype(int)
    for region in ((row - 4, col - 6, row + 7, col + 5), (-9, -9, row + 3, 10**6)):
        assert template.fit(frame, region=region).centre_px == pytest.approx(
            everywhere.centre_px, abs=1e-6
        )
    for region in ((10**4, 0, 10**4 + 9, 9), (-30, 0, -20, 9), (9, 9, 9, 9)):
        with pytest.raises(NoRoundObjectError, match="outside of the frame"):
            template.fit(frame, region=region)


def test_one_frame_and_two_are_too_few(places: np.ndarray) -> None:
    frames = frames_at(places[:2], np.random.default_rng(5))
    for count in (1, 2):
        with pytest.raises(TemplateError, match="at least 3"):
            learn_template(frames[:count], places[:count] - places[0])


def test_frames_without_displacement_cannot_tell_what_moves(places: np.ndarray) -> None:
    frames = frames_at(np.repeat(places[:1], 9, axis=0), np.random.default_rng(5))
    with pytest.raises(TemplateError, match="static background"):
        learn_template(frames, np.zeros((9, 2)))


def test_what_stands_still_is_no_template(places: np.ndarray) -> None:
    frames = frames_at(np.repeat(places[:1], 9, axis=0), np.random.default_rng(5))
    with pytest.raises(TemplateError):
        learn_template(frames, places - places[0])


def test_one_wrong_displacement_is_named(places: np.ndarray) -> None:
    frames = frames_at(places, np.random.default_rng(5))
    shifts = places - places[0]
    shifts[4, 1] += 0.5
    with pytest.raises(TemplateError, match="frame 4"):
        learn_template(frames, shifts)


def test_displacements_of_the_wrong_sign_are_refused(places: np.ndarray) -> None:
    frames = frames_at(places, np.random.default_rng(5))
    with pytest.raises(TemplateError):
        learn_template(frames, places[0] - places)


def test_noise_has_no_template(places: np.ndarray) -> None:
    frames = np.abs(np.random.default_rng(1).normal(0, 1, (9, 72, 88)))
    with pytest.raises(TemplateError):
        learn_template(frames, places - places[0])


def test_another_object_is_refused_by_name(places: np.ndarray) -> None:
    template = learnt(places)
    rng = np.random.default_rng(8)
    ring = render_disc((72, 88), (34, 42), 6.0) - render_disc((72, 88), (34, 42), 3.5)
    with pytest.raises((TemplateMismatchError, NoRoundObjectError)):
        template.fit(rician(ring, 0.02, rng))
    bubble = scene((34, 42)) - render_disc((72, 88), (31.5, 42), 1.8)
    with pytest.raises(TemplateMismatchError):
        template.fit(rician(bubble, 0.05, rng))


def test_an_empty_frame_is_refused(places: np.ndarray) -> None:
    template = learnt(places)
    with pytest.raises(EngineError):
        template.fit(rician(np.zeros((72, 88)), 0.05, np.random.default_rng(1)))
