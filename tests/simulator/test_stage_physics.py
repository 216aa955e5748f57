"""The Piezo LEGS stage: step length and what it depends on, with known numbers."""

import math
import random
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP
from simulator.motion_truth import MotionTruth
from simulator.stage_physics import PiezoLegsStage, StageParameters

PERFECT = {
    "asymmetry": 0.0,
    "load": 0.0,
    "scatter": 0.0,
    "repeatability_um": 0.0,
    "park_shift_um": 0.0,
}


def stage(seed: int = 1, position_um: float = 0.0, **changes) -> PiezoLegsStage:
    return PiezoLegsStage(StageParameters(**changes), position_um, random.Random(seed))


def run(made: PiezoLegsStage, steps: int, frequency_hz: float = 1000.0) -> float:
    """Distance of one run of whole steps, made in many ticks."""
    before_um = made.position_um
    made.begin_run()
    sign = 1 if steps > 0 else -1
    for _ in range(abs(steps)):
        made.drive(sign * MICROSTEPS_PER_STEP, frequency_hz)
    return made.position_um - before_um


def test_a_perfect_motor_steps_its_step_length():
    assert run(stage(**PERFECT), 1000) == pytest.approx(4500)
    assert run(stage(**PERFECT), -1000) == pytest.approx(-4500)


def test_there_and_back_does_not_close_by_the_asymmetry():
    made = stage(**PERFECT | {"asymmetry": 0.04})
    run(made, 1000)
    run(made, -1000)
    assert made.position_um == pytest.approx(0.04 * 4500)


def test_the_step_falls_by_13_percent_from_1_to_900_hertz():
    slow, fast = stage(**PERFECT), stage(**PERFECT)
    assert run(fast, 1000, 900.0) / run(slow, 1000, 1.0) == pytest.approx(0.87, abs=0.02)


def test_the_step_halves_towards_stall_and_nothing_moves_beyond():
    assert run(stage(**PERFECT | {"load": 0.999}), 100) == pytest.approx(225, abs=0.5)
    assert run(stage(**PERFECT | {"load": 1.0}), 100) == 0.0
    assert run(stage(**PERFECT | {"load": 1.0}), -100) == pytest.approx(-675)  # it helps


def test_a_load_that_grows_with_the_stroke_shortens_the_steps():
    made = stage(**PERFECT | {"load_per_mm": 0.06})
    first_um = run(made, 100)
    run(made, 2000)
    assert run(made, 100) < 0.8 * first_um


def test_scatter_from_run_to_run_is_one_percent():
    made = stage(**PERFECT | {"scatter": 0.01}, travel_um=(-1e9, 1e9))
    lengths_um = [run(made, 100) / 100 for _ in range(2000)]
    # 2000 draws: the mean is known to 0.02 %, the deviation to 1.6 %.
    assert statistics.mean(lengths_um) == pytest.approx(4.5, rel=0.001)
    assert statistics.stdev(lengths_um) / 4.5 == pytest.approx(0.01, rel=0.06)


def test_a_long_run_ends_14_micrometres_from_where_it_should():
    made = stage(**PERFECT | {"repeatability_um": 14.0}, travel_um=(-1e9, 1e9))
    errors_um = [run(made, 200) - 900 for _ in range(2000)]
    assert statistics.mean(errors_um) == pytest.approx(0, abs=1.0)
    assert statistics.stdev(errors_um) == pytest.approx(14.0, rel=0.06)


def test_a_short_run_has_only_its_share_of_that_error():
    made = stage(**PERFECT | {"repeatability_um": 14.0})
    errors_um = [run(made, 2) - 9 for _ in range(1000)]
    assert statistics.stdev(errors_um) == pytest.approx(14.0 * 0.09, rel=0.1)


def test_parking_shifts_a_little_each_time():
    made = stage(**PERFECT | {"park_shift_um": 2.0})
    places_um = []
    for _ in range(1000):
        before_um = made.position_um
        made.park()
        made.unpark()
        places_um.append(made.position_um - before_um)
    assert statistics.stdev(places_um) == pytest.approx(2.0 * math.sqrt(2), rel=0.1)


def test_the_hard_stops_hold():
    made = stage(**PERFECT, travel_um=(-100.0, 200.0))
    run(made, 1000)
    assert made.position_um == 200.0
    run(made, -1000)
    assert made.position_um == -100.0


def test_an_unpowered_stage_slips_above_its_holding_force_and_a_powered_one_does_not():
    made = stage(**PERFECT)
    made.apply_load(1.05)
    assert made.position_um == 0.0
    made.apply_load(1.2, slip_um=150.0)
    assert made.position_um == -150.0
    made.unpark()
    made.apply_load(1.2)
    assert made.position_um == -150.0


@given(seed=st.integers(0, 10_000), runs=st.lists(st.integers(-300, 300), max_size=8))
def test_the_same_seed_gives_the_same_track(seed: int, runs: list[int]):
    one, other = stage(seed), stage(seed)
    assert [run(one, n) for n in runs] == [run(other, n) for n in runs]


def test_a_mounting_the_other_way_turns_the_axis_but_not_the_encoder():
    made = stage(**PERFECT, mounting=-1, has_encoder=True, encoder_noise_um=0.0)
    assert run(made, 100) == pytest.approx(-450)
    assert made.read_encoder_um() == pytest.approx(450)
    assert stage(**PERFECT).read_encoder_um() is None


@pytest.mark.parametrize(
    "changes",
    [
        {"mounting": 0},
        {"step_um": 0.0},
        {"step_um": float("nan")},
        {"scatter": -0.1},
        {"scatter": float("nan")},
        {"repeatability_um": float("inf")},
        {"asymmetry": 3.0},
        {"travel_um": (1.0, -1.0)},
    ],
)
def test_parameters_that_make_no_sense_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        StageParameters(**changes)


def test_truth_tells_commanded_motions_from_others():
    truth = MotionTruth({"xt": 0.0, "yt": 0.0}, 100.0)
    truth.begin("xt", "run", 101.0)
    assert truth.observe({"xt": 0.1, "yt": 0.0}, 101.1)
    assert not truth.observe({"xt": 0.1, "yt": 0.0}, 101.2)
    truth.end("xt", 101.3)
    assert truth.observe({"xt": 0.1, "yt": 0.5}, 102.0)
    assert [(m.axis, m.cause, m.from_mm, m.to_mm) for m in truth.motions] == [
        ("xt", "run", 0.0, 0.1),
        ("yt", "unprompted", 0.0, 0.5),
    ]
    history = truth.history(101.05, 101.5)
    assert history["start_mm"] == {"xt": 0.0, "yt": 0.0}
    assert history["samples"] == [[101.1, {"xt": 0.1, "yt": 0.0}]]
    assert truth.history(101.5, 101.9)["moved"] is False
    assert truth.history(99.0, 99.5)["known"] is False
