"""Detection on simulated frames: all round objects, and none where there is none."""

import numpy as np
import pytest

from sr_engine.detect import detect
from sr_engine.errors import ConstantFrameError, NoRoundObjectError, ParameterError, ShapeError
from sr_engine.locate import locate_all
from sr_engine.simulate import render_disc, rician

SHAPE = (96, 128)


def _vials(rng: np.random.Generator) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """A bright bath with five vials of every contrast, one with nothing but its wall."""
    centres = [(22.3, 30.1), (24.7, 66.5), (23.9, 101.2), (68.2, 45.6), (66.4, 88.8)]
    image = np.full(SHAPE, 1.0)
    for (row, col), level in zip(centres, (0.6, -0.7, 0.25, -0.3, 0.0), strict=True):
        image += render_disc(SHAPE, (row, col), 8.0, amplitude=-0.8)
        image += render_disc(SHAPE, (row, col), 6.5, amplitude=0.8 + level)
    return rician(image, 0.03, rng), centres


def test_vials_brighter_darker_and_as_bright_as_their_bath_are_all_found() -> None:
    frame, centres = _vials(np.random.default_rng(1))
    found = detect(frame, (4, 10))
    assert len(found) == len(centres)
    for centre in centres:
        assert min(np.hypot(*np.subtract(c.centre_px, centre)) for c in found) < 1.0


def test_located_vials_come_with_centre_covariance_radius_and_wall() -> None:
    frame, centres = _vials(np.random.default_rng(2))
    found = locate_all(frame, (4, 10))
    assert len(found) == len(centres)
    for centre in centres:
        best = min(found, key=lambda f: float(np.hypot(*(f.centre_px - centre))))
        assert np.hypot(*(best.centre_px - centre)) < 0.03
        assert best.radius_px == pytest.approx(6.5, abs=0.3)
        assert best.wall_px == pytest.approx(1.5, abs=0.5)
        assert np.all(best.sigma_px < 0.02)


def test_small_and_large_objects_are_found_in_one_frame() -> None:
    image = render_disc(SHAPE, (50.0, 40.0), 30.0) + render_disc(SHAPE, (48.0, 105.0), 3.5)
    found = detect(rician(image, 0.05, np.random.default_rng(3)), (2.5, 40))
    radii = sorted(c.radius_px for c in found)
    assert radii == pytest.approx([3.5, 30.0], abs=1.0)


def test_a_small_object_at_low_signal_is_found() -> None:
    for seed in range(5):
        image = render_disc(SHAPE, (40.3, 80.7), 4.0)
        found = detect(rician(image, 0.2, np.random.default_rng(seed)), (2.5, 8))
        assert len(found) == 1
        assert found[0].centre_px == pytest.approx((40.3, 80.7), abs=0.6)


def test_only_the_region_asked_for_is_searched() -> None:
    frame, centres = _vials(np.random.default_rng(4))
    found = detect(frame, (4, 10), roi=(0, 0, 45, 48))
    assert len(found) == 1
    assert found[0].centre_px == pytest.approx(centres[0], abs=1.0)


def test_a_rectangle_has_no_round_object() -> None:
    image = np.zeros(SHAPE)
    image[20:75, 30:95] = 1.0
    image *= 1 + 0.3 * np.cos(np.linspace(-1.5, 1.5, SHAPE[1]))
    frame = rician(image, 0.03, np.random.default_rng(5))
    assert detect(frame, (3, 45)) == []
    with pytest.raises(NoRoundObjectError):
        locate_all(frame, (3, 45))


@pytest.mark.parametrize("size", [9, 14])
def test_a_small_square_is_not_round(size: int) -> None:
    image = np.zeros(SHAPE)
    image[40 : 40 + size, 60 : 60 + 2 * size] = 1.0
    assert detect(rician(image, 0.03, np.random.default_rng(6)), (3, 20)) == []


def test_a_smooth_hill_of_sensitivity_is_not_an_object() -> None:
    row, col = np.indices(SHAPE)
    hill = 1 + np.exp(-((row - 50) ** 2 + (col - 60) ** 2) / (2 * 20**2))
    assert detect(rician(hill, 0.01, np.random.default_rng(7)), (3, 40)) == []


def test_noise_has_no_round_object() -> None:
    for seed in range(10):
        noise = rician(np.zeros(SHAPE), 1.0, np.random.default_rng(seed))
        assert detect(noise, (2, 40)) == []


def test_an_object_cut_by_the_border_is_not_offered() -> None:
    image = render_disc((160, 190), (30.0, 90.0), 6.0)[32:, :120]
    frame = rician(image, 0.03, np.random.default_rng(8))
    assert detect(frame, (4, 9)) == []


def test_what_cannot_be_searched_is_refused() -> None:
    frame, _ = _vials(np.random.default_rng(9))
    with pytest.raises(ConstantFrameError):
        detect(np.ones(SHAPE))
    with pytest.raises(ParameterError):
        detect(frame, (9, 4))
    with pytest.raises(ParameterError):
        detect(frame, max_objects=0)
    with pytest.raises(ShapeError):
        detect(frame, roi=(0, 0, 200, 20))
