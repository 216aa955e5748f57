"""Where the manuals are silent or contradicted, the driver works with either answer, unchanged."""

import itertools

import pytest
from pmd_bench import NAMES, Bench
from pmd_rig import finish, opened, rig, wait_until
from virtual_line import VirtualLine

from robot_bridge.daemon.motors import POLL_BOUND_S, STOP_BOUND_S
from robot_bridge.emulator.axis import Motor
from robot_bridge.emulator.switches import Switches

SINGLE = [
    Switches(terminator="cr"),
    Switches(terminator="lf"),
    Switches(terminator="crlf"),
    Switches(run_answer="222"),
    Switches(flash_answer_comma=False),
    Switches(hex_case="upper"),
    Switches(own_echo=True),
    Switches(m6_parks=False),
    Switches(overspeed="refuse"),
    Switches(while_unparking="refuse"),
    Switches(target_beyond_limit="refuse"),
    Switches(broadcast_stop=False),
    Switches(encoder_type_description=False),
    Switches(bare_status=False),
    Switches(collisions="lost"),
]
COMBINED = [
    Switches(terminator=terminator, run_answer="222", hex_case="upper", own_echo=echo)
    for terminator, echo in itertools.product(("mixed", "lf", "crlf"), (False, True))
]


def differing(switches: Switches) -> str:
    standard = Switches()
    changed = [
        f"{name}={value}"
        for name, value in vars(switches).items()
        if value != getattr(standard, name)
    ]
    return ",".join(changed) or "standard"


@pytest.mark.parametrize("switches", [*SINGLE, *COMBINED], ids=differing)
def test_every_switch_alone_and_in_combination_leaves_a_driver_that_works(switches: Switches):
    """Opening, moves both ways in either kind of loop, parking, a move from parked, stopping."""
    with rig(switches=switches) as made, opened(made, "mixed") as motors:
        for setpoint_um in (900, -300):
            motors.move_to({"xt": setpoint_um, "yt": -setpoint_um})
            status = finish(motors)
            assert status.fault is None, status
            assert status.reached
            assert made.position_um(1) == pytest.approx(setpoint_um, abs=1)
            assert made.position_um(2) == pytest.approx(-setpoint_um, abs=1)
        motors.park()
        wait_until(motors, lambda s: s.parked)
        motors.move_to({"xt": 0, "yt": 0})
        assert finish(motors).reached
        motors.stop()
        assert motors.poll().certain


def test_the_other_model():
    with (
        rig(motor=Motor("PMD301", firmware="V20")) as made,
        opened(made, "mixed") as motors,
    ):
        motors.move_to({"xt": 700, "yt": 100})
        assert finish(motors).reached
        assert made.position_um(1) == pytest.approx(700, abs=1)


@pytest.mark.parametrize("broadcast_works", [True, False])
def test_stop_needs_no_broadcast(broadcast_works: bool):
    switches = Switches(broadcast_stop=broadcast_works)
    with rig(switches=switches, speed_factor=1.0) as made, opened(made) as motors:
        motors.move_to({"xt": 15_000, "yt": 15_000})
        wait_until(motors, lambda s: s.readback_um["yt"] > 300)
        motors.stop()
        with made.lock:
            assert not any(c.moving for c in made.bus.controllers)


@pytest.mark.parametrize("into_the_answer_s", [0.0001, 0.0004, 0.0008])
def test_stop_gets_through_although_it_collides_with_an_answer(into_the_answer_s: float):
    line = VirtualLine(
        {"xt": "open_loop", "yt": "closed_loop"}, switches=Switches(collisions="lost")
    )
    line.open_at_zero()
    line.motors.move_to({"xt": 15_000, "yt": 15_000})
    line.poll(10)
    assert line.moving()
    line.write(b"X1U0\r")
    line.wait(into_the_answer_s)
    before = line.bus.collisions
    begun_s = line.now_s
    line.motors.stop()
    assert line.bus.collisions == before + 1
    assert not line.moving()
    assert line.now_s - begun_s < 0.1


@pytest.mark.parametrize("latency_s", [0.001, 0.016])
def test_four_axes_on_one_bus_behind_a_slow_adapter(latency_s: float):
    names = ("xt", "yt", "xb", "yb")
    line = VirtualLine(dict.fromkeys(names, "open_loop"))
    line.bus.faults.reply_delay_s = latency_s
    line.open_at_zero()
    line.motors.move_to({name: 1000 * k for k, name in enumerate(names, 1)})
    longest_s, moving = 0.0, True
    while moving:
        begun_s = line.now_s
        status = line.motors.poll()
        longest_s = max(longest_s, line.now_s - begun_s)
        moving = status.moving
        line.wait(0.005)
    assert status.reached, status
    assert longest_s < POLL_BOUND_S
    for k in (1, 2, 3, 4):
        assert line.position_um(k) == pytest.approx(1000 * k, abs=1)
    line.motors.move_to(dict.fromkeys(names, 15_000))
    line.poll(15)
    assert line.moving()
    begun_s = line.now_s
    line.motors.stop()
    assert line.now_s - begun_s < STOP_BOUND_S
    assert not line.moving()


def test_stops_of_four_axes_behind_the_slowest_adapter_are_confirmed():
    bench = Bench(latency_s=0.03)
    bench.motors.move_to(dict.fromkeys(NAMES, 500))
    assert bench.finish().reached
    for number in range(12):
        way_um = 8000 if number % 2 else -8000
        bench.motors.move_to(dict.fromkeys(NAMES, way_um))
        bench.poll_for(0.9 + 0.03 * number)
        begun_s = bench.line.now_s
        bench.motors.stop()  # raises if one does not confirm
        assert bench.line.now_s - begun_s < STOP_BOUND_S
        bench.rest(1.0)
        bench.motors.declare_position({name: round(bench.truth_um(name)) for name in NAMES})
