"""The benchtop camera against what is known of it."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from simulator.benchtop import (
    Benchtop,
    acquire_frame,
    frame_from_photograph,
    photograph,
    sensor_from_frame,
    true_centre_px,
)
from sr_engine.localize import localize
from sr_engine.psf import Psf

CLEAN = Benchtop(
    shape=(112, 128), noise_dn=0.0, bayer=False, shading_per_px=(0.0, 0.0), sheet_mm=(90.0, 100.0)
)


def centroid_px(redness: Any) -> Any:
    weight = np.where(redness > 20, redness, 0.0)
    rows, cols = np.indices(redness.shape)
    return np.array([(weight * rows).sum(), (weight * cols).sum()]) / weight.sum()


@settings(max_examples=30, deadline=None)
@given(xt=st.floats(-15, 15), yt=st.floats(-15, 15))
def test_the_circle_is_where_the_truth_says(xt: float, yt: float) -> None:
    frame = acquire_frame(CLEAN, {"xt": xt, "yt": yt}, np.random.default_rng(0))
    assert frame.redness.shape == (112, 128)
    assert np.allclose(centroid_px(frame.redness), frame.centre_px, atol=0.05)


@pytest.mark.parametrize("interpolation", ["bicubic", "bilinear"])
@pytest.mark.parametrize("antialias", [True, False])
def test_scaling_down_displaces_nothing_on_average(interpolation: Any, antialias: bool) -> None:
    bench = CLEAN.model_copy(update={"interpolation": interpolation, "antialias": antialias})
    rng = np.random.default_rng(3)
    errors = []
    # all phases of the interpolation, which repeats every two pixels
    for xt, yt in itertools.product(np.arange(4) / 2, repeat=2):
        frame = acquire_frame(bench, {"xt": float(xt), "yt": float(yt)}, rng)
        errors.append(centroid_px(frame.redness) - frame.centre_px)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.01
    assert np.std(errors) < 0.05


def test_the_part_of_the_sensor_that_is_computed_is_that_of_the_photograph() -> None:
    for bench in (CLEAN, CLEAN.model_copy(update={"bayer": True})):
        stage = {"xt": 7.3, "yt": -5.2}
        frame = acquire_frame(bench, stage, np.random.default_rng(0))
        photo = photograph(bench, stage, np.random.default_rng(0))
        assert photo.shape == (480, 640, 3)
        assert np.allclose(frame_from_photograph(bench, photo), frame.redness, atol=1e-9)


def test_the_photograph_shows_a_red_circle_on_a_white_sheet_on_a_dark_stage() -> None:
    stage = {"xt": 2.0, "yt": 3.0}
    bench = Benchtop()
    photo = photograph(bench, stage, np.random.default_rng(1)).astype(int)
    row, col = np.rint(sensor_from_frame(bench, true_centre_px(bench, stage))).astype(int)
    red, green, blue = photo[row, col]
    assert red > 150
    assert max(green, blue) < 70
    assert photo[row, col + 16].min() > 180
    assert photo[row, col + 60].max() < 90
    half = photo[row, col - 20 : col + 21, 0] - photo[row, col - 20 : col + 21, 1] > 75
    assert half.sum() == pytest.approx(2 * bench.radius_mm * 1.5, abs=1.5)


def test_the_outer_edges_of_photograph_and_scaled_photograph_coincide() -> None:
    whole = Benchtop(sensor_shape=(480, 660), shape=(300, 420))
    # 660 / 1.5 = 440 columns, of which the middle 420 are kept
    assert np.allclose(sensor_from_frame(whole, np.array([-10.5, -10.5])), -0.5)
    assert np.allclose(sensor_from_frame(whole, np.array([309.5, 429.5])), [479.5, 659.5])


def test_the_stages_move_the_circle_by_the_cameras_scale_and_rotation() -> None:
    bench = Benchtop(rotation_deg=90.0, scale=(1.0, 1.0))
    origin = true_centre_px(bench, {"xt": 0.0, "yt": 0.0})
    assert np.allclose(origin, bench.centre_px)
    assert np.allclose(true_centre_px(bench, {"xt": 10.0, "yt": 0.0}) - origin, [10.0, 0.0])
    assert np.allclose(true_centre_px(bench, {"xt": 0.0, "yt": 10.0}) - origin, [0.0, -10.0])


def test_noise_is_as_strong_as_stated_and_differs_from_frame_to_frame() -> None:
    bench = Benchtop(bayer=False, sheet_mm=(300.0, 400.0), shading_per_px=(0.0, 0.0), noise_dn=3.0)
    rng = np.random.default_rng(2)
    first, second = (photograph(bench, {"xt": 0.0, "yt": 0.0}, rng).astype(float) for _ in "12")
    corner = (slice(60, 160), slice(60, 160))
    difference = (first - second)[corner]
    assert difference.std() / np.sqrt(2) == pytest.approx(3.0, rel=0.05)
    assert first[corner].mean() == pytest.approx(255 * np.mean(bench.white), abs=0.5)


def test_a_fit_of_the_right_model_finds_the_circle_to_a_hundredth_of_a_pixel() -> None:
    bench = Benchtop(bayer=False)
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(12):
        stage = dict(zip(("xt", "yt"), rng.uniform(-12, 12, 2), strict=True))
        frame = acquire_frame(bench, stage, rng)
        start_px = tuple(np.rint(frame.centre_px))
        psf = Psf("gaussian", (0.6,))
        found = localize([frame.redness], start_px=start_px, radius_px=(3, 7), psf=psf)
        errors.append(found.centre_px - frame.centre_px)
        assert found.radius_px == pytest.approx(5.0, abs=0.05)
    assert np.hypot(*np.transpose(errors)).mean() < 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": (400, 128)}, "does not fit"),
        ({"radius_mm": -1.0}, "radius_mm"),
        ({"red": (1.2, 0.0, 0.0)}, "red"),
        ({"noise_dn": float("nan")}, "noise_dn"),
        ({"lens": "wide"}, "lens"),
    ],
)
def test_an_impossible_camera_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Benchtop.model_validate(change)
