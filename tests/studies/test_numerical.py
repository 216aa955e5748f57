"""The numerical study: its scene, its order of methods, its statistics."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, stats

from sr_engine.paper import PAPER_MEAN_ERROR_PX
from studies.circle_scene import CircleScene
from studies.numerical import METHODS, SCENES, StudyPoint, Trial, run_trial, run_trials, scene_frame
from studies.numerical_study import map_points, run_study, trials_in_all
from studies.statistics import (
    bound_mean_error_px,
    f_test,
    rician_information,
    summarise,
)

POINT = StudyPoint()


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    return run_trials(POINT, list(range(100)))


@pytest.mark.parametrize(
    ("fine_shape", "factor", "centre", "radius", "blur"),
    [((1000, 1240), 20, (24.3, 31.7), 4.0, 0.5), ((900, 1500), 30, (13.1, 22.9), 5.5, 0.0)],
)
def test_the_frame_is_that_of_the_drawn_blurred_and_scaled_image(
    fine_shape: tuple[int, int],
    factor: int,
    centre: tuple[float, float],
    radius: float,
    blur: float,
) -> None:
    rows, cols = np.indices(fine_shape)
    row, col = ((c + 0.5) * factor - 0.5 for c in centre)
    image = ((rows - row) ** 2 + (cols - col) ** 2 <= (radius * factor) ** 2).astype(float)
    if blur:
        image = ndimage.gaussian_filter(image, blur * factor, truncate=6.0, mode="constant")
    shape = fine_shape[0] // factor, fine_shape[1] // factor
    literal = image.reshape(shape[0], factor, shape[1], factor).mean(axis=(1, 3))
    frame = CircleScene(radius, blur, fine_shape, factor).frame(centre)
    assert frame.shape == shape
    assert np.abs(frame - literal).max() < 1e-12


def test_the_papers_image_has_5000_pixels_a_side() -> None:
    scene = CircleScene(4.0, 0.3)
    frame = scene.frame((62.0, 61.5))
    assert frame.shape == (125, 125)
    assert frame.sum() == pytest.approx(math.pi * 16, rel=1e-3)
    assert np.average(np.arange(125), weights=frame.sum(axis=0)) == pytest.approx(61.5, abs=1e-3)


def test_a_circle_that_leaves_the_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="leaves the"):
        CircleScene(4.0, 0.3).frame((2.0, 60.0))


def test_the_order_of_the_paper_holds_and_ours_is_five_times_better(trials: list[Trial]) -> None:
    mean = {}
    for method in METHODS:
        summary = summarise(trials, method)
        assert summary is not None
        assert summary.failures == 0
        mean[method] = summary.mean_error_px
    assert mean["base"] > mean["bicubic"] >= mean["sr"] > mean["ml1"] > mean["ml"]
    native_against_sr = f_test(trials, "base", "sr")
    assert native_against_sr is not None
    assert native_against_sr.p_value < 1e-4
    assert native_against_sr.variance_ratio > 1
    assert mean["sr"] >= 5 * mean["ml"]


def test_the_papers_own_numbers_come_out_within_a_factor(trials: list[Trial]) -> None:
    for method, paper in PAPER_MEAN_ERROR_PX.items():
        summary = summarise(trials, method)
        assert summary is not None
        assert 0.5 < summary.mean_error_px / paper < 1.5


@pytest.mark.parametrize("frames", [1, 4])
def test_ours_comes_near_the_bound(trials: list[Trial], frames: int) -> None:
    summary = summarise(trials, "ml1" if frames == 1 else "ml")
    assert summary is not None
    # 100 distances are known to 5 %; slopes that are fitted as well cost 10 %.
    assert 0.85 < summary.mean_error_px / bound_mean_error_px(POINT, frames) < 1.3


def test_the_circle_moves_one_high_resolution_pixel_to_the_right_each_trial(
    trials: list[Trial],
) -> None:
    columns = np.array([trial.truth_px[1] for trial in trials])
    assert np.allclose(np.diff(columns), 1 / 40)
    rows = np.array([trial.truth_px[0] for trial in trials])
    assert rows.std() > 0.2


def test_a_trial_depends_on_seed_place_and_number_alone() -> None:
    point = replace(POINT, methods=("base",))
    assert run_trial(point, 7) == run_trials(point, [3, 7])[1]
    assert run_trial(point, 7) != run_trial(replace(point, seed=2), 7)
    assert run_trial(point, 7).estimates_px != run_trial(replace(point, index=1), 7).estimates_px


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("shift_set", ["paper", "quarter", "lattice5"])
def test_every_scene_and_shift_set_can_be_studied(scene: str, shift_set: str) -> None:
    point = replace(POINT, scene=scene, shift_set=shift_set, snr=40.0)
    trial = run_trial(point, 0)
    assert set(trial.estimates_px) == set(METHODS), trial.failures
    for method in METHODS:
        assert math.hypot(*trial.error_px(method)) < 0.7


def test_a_method_that_finds_nothing_is_counted_and_not_averaged() -> None:
    lost = replace(POINT, snr=1.0, methods=("base", "ml"))
    trials = run_trials(lost, list(range(6)))
    failures = [method for trial in trials for method in trial.failures]
    assert failures
    for method in lost.methods:
        summary = summarise(trials, method)
        if summary is not None:
            assert summary.failures == failures.count(method)
            assert math.isfinite(summary.mean_error_px)


def test_the_f_test_is_the_two_tailed_one() -> None:
    rng = np.random.default_rng(5)
    wide, narrow = rng.normal(0, 1.3, size=(30, 2)), rng.normal(0, 1.0, size=(30, 2))
    trials = [Trial(i, (0.0, 0.0), {"a": tuple(wide[i]), "b": tuple(narrow[i])}) for i in range(30)]
    test, other = f_test(trials, "a", "b"), f_test(trials, "b", "a")
    assert test is not None
    assert other is not None
    ratio = wide.var(axis=0, ddof=1).mean() / narrow.var(axis=0, ddof=1).mean()
    assert test.variance_ratio == pytest.approx(ratio)
    assert test.p_value == pytest.approx(2 * stats.f.sf(ratio, 58, 58))
    assert other.p_value == pytest.approx(test.p_value)


def test_the_bound_of_a_scanner_frame_is_the_known_one() -> None:
    point = StudyPoint(scene="flat", snr=40.0, radius_px=4.0)
    known = 0.533 / (40.0 * math.sqrt(4.0)) * math.sqrt(math.pi / 2)
    one, four = (bound_mean_error_px(point, count) for count in (1, 4))
    assert one == pytest.approx(known, rel=0.06)
    assert four == pytest.approx(one / 2)
    assert one >= known * 0.99


def test_a_filter_does_not_move_the_bound() -> None:
    flat, filtered = (StudyPoint(scene=scene, snr=40.0) for scene in ("flat", "hamming"))
    assert bound_mean_error_px(filtered, 4) == bound_mean_error_px(flat, 4)


def test_a_magnitude_pixel_without_signal_carries_no_information_and_a_bright_one_all() -> None:
    assert rician_information(np.array([0.0, 50.0])) == pytest.approx([0.0, 1.0], abs=1e-6)
    assert np.all(np.diff(rician_information(np.linspace(0, 12, 50))) > -1e-9)
    sampled = 3.0 + np.random.default_rng(1).normal(size=(2, 400_000)) * [[1.0], [1.0]]
    sampled[1] -= 3.0
    magnitude = np.hypot(*sampled)
    from scipy.special import i0e, i1e

    score = magnitude * i1e(3 * magnitude) / i0e(3 * magnitude) - 3.0
    assert rician_information(np.array([3.0]))[0] == pytest.approx(score.var(), rel=0.01)


def test_the_map_covers_every_scene_radius_and_snr_once() -> None:
    points = map_points(POINT)
    assert len({point.index for point in points}) == len(points) == 36
    assert 0 not in {point.index for point in points}
    assert trials_in_all(100, 10) == 460
    for point in points[::5]:
        assert np.isfinite(scene_frame(point, np.array([60.2, 60.4]))).all()


def test_progress_counts_the_trials() -> None:
    counted: list[int] = []
    study = run_study(replace(POINT, seed=4), 6, 0, progress=counted.append)
    assert len(study.trials) == 6
    assert sum(counted) >= 6
    assert study.cells == []
