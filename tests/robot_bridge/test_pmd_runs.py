"""A motion that was cut short: how far it went is known as well as the time tells, no better."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pmd_rig import axis_config
from virtual_ports import Line, Plug

from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.driver import PmdMotors
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP
from robot_bridge.pmd.runs import Pace, Run

NAMES = ("xt", "yt", "xb", "yb")


class Bench:
    """Four axes on one bus, in virtual time."""

    def __init__(self, drive: str, latency_s: float, speed_factor: float = 1.0) -> None:
        switches = Switches()
        self.line = Line()
        self.boards = [
            EmulatedController(n, IdealStage(), Motor(), switches, self.line.now_s, speed_factor)
            for n in (1, 2, 3, 4)
        ]
        bus = EmulatedBus(self.boards, switches, random.Random(1))
        bus.faults.reply_delay_s = latency_s
        self.line.plugs["port"] = Plug(self.line, bus)
        axes = [axis_config(name, "port", n, drive) for n, name in enumerate(NAMES, start=1)]
        self.motors = PmdMotors(axes, clock=lambda: self.line.now_s, open_port=self.line.open_port)
        self.motors.open()
        self.motors.declare_position(dict.fromkeys(NAMES, 0))

    def poll_for(self, seconds: float) -> None:
        until_s = self.line.now_s + seconds
        while self.line.now_s < until_s and self.motors.poll().moving:
            self.line.wait(0.02)

    def truth_um(self, axis: str) -> float:
        return self.boards[NAMES.index(axis)].physics.position_um

    def move_and_stop(self, to_um: int, at_um: float) -> None:
        self.motors.move_to({"xt": to_um})
        while self.truth_um("xt") < at_um:
            self.motors.poll()
            self.line.wait(0.005)
        self.motors.stop()
        self.poll_for(5.0)


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
    bench.motors.move_to({"xt": 12_000})
    while bench.truth_um("xt") < 3000:
        bench.motors.poll()
        bench.line.wait(0.005)
    bench.boards[0].faults.encoder_frozen = True
    bench.line.wait(0.05)
    bench.motors.stop()
    bench.poll_for(5.0)
    bench.boards[0].faults.encoder_frozen = False
    status = bench.motors.poll()
    off_um = abs(bench.truth_um("xt") - status.readback_um["xt"])
    assert off_um > 100
    assert "xt" not in status.certain_axes or off_um <= status.within_um["xt"]


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
