"""The circle Hough transform and bicubic enlargement, on discs with known centres."""

import math

import numpy as np
import pytest
from skimage.filters import threshold_otsu

from sr_engine.errors import ConstantFrameError, NoRoundObjectError, NotFiniteError, ParameterError
from sr_engine.hough import HoughSettings, hough_circles, otsu_threshold, strongest_circle
from sr_engine.psf import Psf
from sr_engine.reconstruction.interpolate import enlarge_bicubic, fine_from_frame, frame_from_fine
from sr_engine.simulate import render_disc, rician

WIDE = HoughSettings((3.0, 14.0), sensitivity=0.92)


@pytest.mark.parametrize("centre", [(20.0, 31.0), (24.4, 40.7), (15.3, 18.8)])
@pytest.mark.parametrize("radius", [5.0, 7.5, 11.0])
def test_a_disc_is_found_to_a_fraction_of_a_pixel(
    centre: tuple[float, float], radius: float
) -> None:
    image = render_disc((48, 64), centre, radius, psf=Psf("hamming"))
    found = strongest_circle(image, WIDE)
    assert math.dist(found.centre_px, centre) < 0.35
    assert found.radius_px == pytest.approx(radius, abs=0.8)


def test_a_dark_disc_is_found_as_dark_and_not_as_bright() -> None:
    image = 1.0 - render_disc((48, 64), (22.3, 37.6), 6.0, psf=Psf("hamming"))
    dark = HoughSettings((3.0, 12.0), polarity="dark")
    assert math.dist(strongest_circle(image, dark).centre_px, (22.3, 37.6)) < 0.35
    both = HoughSettings((3.0, 12.0), polarity="both")
    assert math.dist(strongest_circle(image, both).centre_px, (22.3, 37.6)) < 0.35
    with pytest.raises(NoRoundObjectError, match="radius 3 to 12 px"):
        strongest_circle(image, HoughSettings((3.0, 12.0)))


def test_two_discs_are_two_circles_the_better_one_first() -> None:
    image = render_disc((60, 90), (20.4, 25.1), 6.0, psf=Psf("hamming"))
    image += render_disc((60, 90), (38.2, 66.6), 9.0, 0.9, psf=Psf("hamming"))
    found = hough_circles(image, WIDE)
    assert len(found) == 2
    assert found[0].strength >= found[1].strength
    by_col = sorted(found, key=lambda circle: circle.centre_px[1])
    for circle, truth in zip(by_col, [(20.4, 25.1), (38.2, 66.6)], strict=True):
        assert math.dist(circle.centre_px, truth) < 0.4


def test_lower_sensitivity_asks_for_a_more_complete_circle() -> None:
    image = render_disc((48, 64), (24.4, 30.7), 8.0, psf=Psf("hamming"))
    image[:, 31:] = 0.0
    assert hough_circles(image, HoughSettings((5.0, 11.0), sensitivity=0.9))
    assert not hough_circles(image, HoughSettings((5.0, 11.0), sensitivity=0.1))


def test_noise_at_the_papers_level_does_not_lose_the_disc() -> None:
    rng = np.random.default_rng(2)
    clean = render_disc((64, 80), (30.3, 44.9), 6.0)
    for _ in range(10):
        found = strongest_circle(rician(clean, 0.05, rng), HoughSettings((3.0, 12.0)))
        assert math.dist(found.centre_px, (30.3, 44.9)) < 0.6


def test_otsus_threshold_is_the_known_one() -> None:
    rng = np.random.default_rng(4)
    values = np.clip(np.concatenate([rng.normal(0.2, 0.06, 900), rng.normal(0.7, 0.1, 300)]), 0, 1)
    assert otsu_threshold(values) == pytest.approx(threshold_otsu(values), abs=0.02)


def test_a_constant_image_has_no_edge() -> None:
    with pytest.raises(ConstantFrameError, match="constant"):
        hough_circles(np.full((30, 40), 17.0), WIDE)


def test_a_pixel_that_is_no_number_is_refused() -> None:
    image = np.zeros((30, 40))
    image[3, 7] = np.nan
    with pytest.raises(NotFiniteError, match="row 3, col 7"):
        hough_circles(image, WIDE)


@pytest.mark.parametrize(
    "wrong",
    [
        {"radius_px": (5.0, 5.0)},
        {"radius_px": (0.0, 5.0)},
        {"radius_px": (2.0, math.inf)},
        {"radius_px": (math.nan, 5.0)},
        {"sensitivity": 1.0},
        {"sensitivity": math.nan},
        {"edge_threshold": 1.5},
        {"radius_step_px": 0.0},
        {"polarity": "grey"},
    ],
)
def test_settings_that_cannot_work_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ParameterError):
        HoughSettings(**{"radius_px": (3.0, 9.0), **wrong})  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_bicubic_enlargement_keeps_a_parabola(factor: int) -> None:
    rows, cols = np.indices((13, 22)).astype(float)
    fine = enlarge_bicubic(0.3 * rows**2 - rows * cols + 2 * cols + 1, factor)
    fine_rows, fine_cols = frame_from_fine(np.indices((13 * factor, 22 * factor)), factor)
    truth = 0.3 * fine_rows**2 - fine_rows * fine_cols + 2 * fine_cols + 1
    inner = (slice(2 * factor, -2 * factor),) * 2
    assert np.allclose(fine[inner], truth[inner])


def test_bicubic_enlargement_mirrors_the_border() -> None:
    assert np.allclose(enlarge_bicubic(np.full((5, 9), 2.5), 3), 2.5)
    frame = np.random.default_rng(0).normal(size=(6, 9))
    mirrored = np.pad(frame, 4, mode="symmetric")
    assert np.allclose(enlarge_bicubic(frame), enlarge_bicubic(mirrored)[8:-8, 8:-8])


def test_the_half_pixel_of_the_finer_grid_is_known_both_ways() -> None:
    assert np.allclose(fine_from_frame([0.0, 0.0], 2), 0.5)
    assert np.allclose(frame_from_fine([0.0, 0.0], 4), -0.375)
    points = np.random.default_rng(1).normal(size=(7, 2))
    assert np.allclose(frame_from_fine(fine_from_frame(points, 3), 3), points)
