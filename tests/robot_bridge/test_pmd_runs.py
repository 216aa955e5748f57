"""A motion that was cut short: how far it went is known as well as the time tells, no better."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pmd_bench import NAMES, Bench

from robot_bridge.emulator.axis import Motor
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP
from robot_bridge.pmd.runs import Pace, Run


@pytest.mark.parametrize("latency_s", [0.0, 0.03])
@pytest.mark.parametrize("speed_factor", [1.0, 20.0])
def test_after_a_stop_a_counted_axis_is_known_to_a_part_of_its_run(
    latency_s: float, speed_factor: float
):
    """The boards may run faster than they are told: what a speed amounts to is learned."""
    bench = Bench("open_loop", latency_s, speed_factor)
    bench.motors.move_to({"xt": -9000})
    bench.poll_for(30.0)
    bench.move_and_stop(12_000, 3000)
    status = bench.motors.poll()
    assert "xt" not in status.certain_axes
    assert bench.truth_um("xt") < 11_900
    within_um = status.within_um["xt"]
    assert abs(bench.truth_um("xt") - status.readback_um["xt"]) <= within_um
    if speed_factor == 1.0:
        assert within_um < 1700  # not 6000, half of the run
    bench.motors.declare_position({"xt": round(bench.truth_um("xt"))})
    assert bench.motors.poll().within_um == {}


def test_before_any_run_came_to_its_end_nothing_is_known_of_one_that_did_not():
    bench = Bench("open_loop", 0.0)
    bench.move_and_stop(12_000, 3000)
    status = bench.motors.poll()
    assert (status.readback_um["xt"], status.within_um["xt"]) == (6000, 6000)


@pytest.mark.parametrize("latency_s", [0.0, 0.03])
def test_a_stop_has_not_ended_before_the_encoder_was_asked_where_the_axis_stands(latency_s: float):
    bench = Bench("closed_loop", latency_s)
    bench.move_and_stop(12_000, 3000)
    status = bench.motors.poll()
    assert not status.moving
    assert status.certain_axes == set(NAMES)
    assert bench.truth_um("xt") < 11_900
    assert abs(bench.truth_um("xt") - status.readback_um["xt"]) <= 2


@pytest.mark.parametrize("latency_s", [0.0, 0.004, 0.03])
def test_an_encoder_that_died_just_before_a_stop_is_within_what_is_said(latency_s: float):
    """Nobody can have seen it: the last look was good, and there is no other."""
    bench = Bench("closed_loop", latency_s)
    bench.move_until(12_000, 3000)
    bench.boards[0].faults.encoder_frozen = True
    bench.line.wait(0.05)
    bench.motors.stop()
    bench.poll_for(5.0)
    bench.boards[0].faults.encoder_frozen = False
    status = bench.motors.poll()
    off_um = abs(bench.truth_um("xt") - status.readback_um["xt"])
    assert off_um > 100
    assert "xt" not in status.certain_axes or off_um <= status.within_um["xt"]


@pytest.mark.parametrize("fault", ["encoder_frozen", "stalled"])
@pytest.mark.parametrize("latency_s", [0.0, 0.03])
@pytest.mark.parametrize("way_um", [600, 9000])
def test_after_a_stall_an_axis_may_be_anywhere_that_its_motor_can_have_gone(
    fault: str, latency_s: float, way_um: int
):
    """A motor whose encoder is dead does not end at its target either."""
    bench = Bench("closed_loop", latency_s, names=("xt",))
    bench.move(-1000)
    bench.move_until(-1000 + way_um, -900)
    setattr(bench.board.faults, fault, True)
    status = bench.finish()
    assert status.fault == "stalled"
    assert status.within_um["xt"] >= way_um
    assert abs(bench.truth_um() - status.readback_um["xt"]) <= status.within_um["xt"]


@pytest.mark.parametrize("wrong", [{"encoder_reversed": True}, {"um_per_count": 0.01}])
@pytest.mark.parametrize("stopped", [True, False])
def test_an_encoder_that_is_refuted_leaves_the_axis_within_what_is_said(wrong: dict, stopped: bool):
    bench = Bench("closed_loop", names=("xt",), motor=Motor(**wrong))
    bench.move_until(5000, 120)
    if stopped:
        bench.motors.stop()
    status = bench.finish()
    assert status.certain_axes == set()
    assert abs(bench.truth_um() - status.readback_um["xt"]) <= status.within_um["xt"]


@pytest.mark.parametrize("travel", [(-50, 20_000), (-20_000, 50), (-150, 250)])
@pytest.mark.parametrize("towards", [1, -1])
def test_the_proof_of_an_encoder_stays_inside_of_the_travel(travel: tuple, towards: int):
    low, high = travel
    bench = Bench("closed_loop", names=("xt",), travel_min_um=low, travel_max_um=high)
    way_um = []
    drive = bench.board.physics.drive

    def seen(microsteps: int, frequency_hz: float) -> None:
        drive(microsteps, frequency_hz)
        way_um.append(bench.truth_um())

    bench.board.physics.drive = seen
    assert bench.move(45 * towards).reached
    assert low <= min(way_um)
    assert max(way_um) <= high


def test_an_encoder_that_no_run_inside_of_the_travel_can_prove_is_not_believed():
    bench = Bench("closed_loop", names=("xt",), travel_min_um=-20, travel_max_um=20,
        counts_per_mm=200.0, motor=Motor(um_per_count=5.0), tolerance_um=15)  # fmt: skip
    status = bench.move(20)
    assert status.fault == "encoder_unproven"
    assert bench.truth_um() == 0
    assert "no room" in status.fault_text


def test_a_coarse_encoder_is_proven_over_a_longer_run():
    reversed_one = Motor(um_per_count=25.0, encoder_reversed=True)
    bench = Bench("closed_loop", names=("xt",), motor=reversed_one, counts_per_mm=40.0,
        tolerance_um=100)  # fmt: skip
    assert bench.move(5000).fault == "encoder_disagrees"
    assert abs(bench.truth_um()) < 1000


def run_of(microsteps: int, sent_s: float, begun_by_s: float, polls: list[tuple]) -> Run:
    run = Run(0.0, microsteps, 1000, sent_s)
    run.begun_by_s = begun_by_s
    for turning, asked_s, answered_s in polls:
        run.saw(turning, asked_s, answered_s)
    return run


@given(
    pace=st.floats(0.2, 3.0),
    ends_s=st.lists(st.floats(0.02, 8.0), min_size=1, max_size=5),
    cut_s=st.floats(0.0, 8.0),
    lag_s=st.floats(0.0, 0.2),
    direction=st.sampled_from((1, -1)),
)
def test_what_a_cut_run_has_gone_is_between_its_bounds(
    pace: float, ends_s: list[float], cut_s: float, lag_s: float, direction: int
):
    def seen(microsteps: int, still_s: float) -> Run:
        polls = [
            ((n + 1) * lag_s < still_s, n * lag_s, (n + 2) * lag_s)
            for n in range(int(still_s / lag_s) + 2 if lag_s > 0.01 else 0)
        ]
        polls.append((False, still_s, still_s + lag_s))
        return run_of(microsteps, -lag_s, lag_s, polls)

    known = Pace()
    for lasted_s in ends_s:
        microsteps = max(1, round(lasted_s * pace * 1000 * MICROSTEPS_PER_STEP))
        known.learn(seen(microsteps, lasted_s))
    whole_s = 8.0
    whole = round(whole_s * pace * 1000 * MICROSTEPS_PER_STEP)
    low, high = sorted(known.microsteps_gone(seen(direction * whole, cut_s)))
    truly = direction * cut_s * pace * 1000 * MICROSTEPS_PER_STEP
    assert low - 1 <= truly <= high + 1


def test_a_run_that_nobody_saw_turn_may_be_anything():
    run = run_of(-8192, 0.0, math.inf, [])
    assert Pace().microsteps_gone(run) == (-0.0, -8192)


def test_a_stall_in_its_proof_does_not_make_a_wrong_scale_a_right_one():
    """By half of the way and twice the counts the encoder seems to have followed."""
    bench = Bench(names=("xt",), motor=Motor(um_per_count=0.05))
    bench.motors.move_to({"xt": 436})
    while bench.truth_um() < 100:
        bench.motors.poll()
        bench.line.wait(0.002)
    bench.board.faults.stalled = True
    assert bench.finish().fault == "stalled"
    bench.board.faults.stalled = False
    bench.rest()
    bench.motors.declare_position({"xt": round(bench.truth_um())})
    bench.motors.move_to({"xt": 4000})
    status = bench.finish()
    assert status.fault == "encoder_disagrees"
    assert "xt" not in status.certain_axes
    assert bench.truth_um() < 500
