"""Damage on the controllers' line, at every place and by chance: no double move, no wrong one.

The line has no checksum, so the driver's rules have to do it: store, check the echo, run; never
run twice; stop at an echo that nobody asked for; believe nothing less than the readback.
"""

import logging
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_line import VirtualLine

from robot_bridge.daemon.motors import MotorError, MotorStatus
from robot_bridge.emulator.switches import LineFaults, Switches

DAMAGE = (
    "drop_replies",
    "garble_replies",
    "truncate_replies",
    "garble_commands",
    "lose_commands",
)
EVERY_PLACE = 40  # a move with an approach has some 30 lines


@pytest.fixture(autouse=True)
def quiet():
    log = logging.getLogger("robot_bridge.pmd.driver")
    before = log.level
    log.setLevel(logging.CRITICAL)
    yield
    log.setLevel(before)


@pytest.mark.parametrize("kind", DAMAGE)
@pytest.mark.parametrize("drive", ["open_loop", "closed_loop"])
def test_damage_at_any_place_of_a_move_never_moves_twice_or_elsewhere(drive: str, kind: str):
    """Damage the n-th line of a move for every n: it arrives, or it ends in a fault."""
    faults = set()
    for nth in range(EVERY_PLACE):
        line = VirtualLine({"xt": drive}, seed=nth)
        line.open_at_zero()
        line.motors.move_to({"xt": -1000})  # from above: two legs
        end = line.bus.lines_received + nth
        while line.bus.lines_received < end and line.motors.poll().moving:
            line.wait(0.001)
        setattr(line.bus.faults, kind, 1)
        status = line.finish()
        setattr(line.bus.faults, kind, 0)
        status = line.poll(5)
        assert not line.moving()
        runs = line.runs()
        # Two legs; a target may be run again after a lost answer, an open-loop run may not.
        assert runs <= (2 if drive == "open_loop" else 3)
        assert -1051 <= line.position_um() <= 30
        if status.reached and status.certain:
            assert line.position_um() == pytest.approx(-1000, abs=1)
        else:
            assert status.fault is not None or not status.certain
        faults.add(status.fault)
    assert None in faults  # damage is survived wherever repeating is safe


@dataclass
class Noisy:
    """What came of moves on a noisy line."""

    arrived: int = 0
    failed: int = 0
    lies: list[str] = field(default_factory=list)  # certain to be where the stage is not
    runs_most: int = 0  # in one move

    @property
    def moves(self) -> int:
        return self.arrived + self.failed


def noisy_moves(
    seed: int, drives: dict[str, str], faults: LineFaults, moves: int, bare_status: bool = True
) -> Noisy:
    switches = Switches(bare_status=bare_status)
    line = VirtualLine(drives, seed=seed, switches=switches)
    line.open_at_zero()
    line.bus.faults = faults
    found = Noisy()
    for number in range(moves):
        setpoints_um = {
            name: ((seed + 7919 * number + 104_729 * k) % 4001) - 2000
            for k, name in enumerate(drives)
        }
        runs = line.runs()
        start_again_if_needed(line, drives)
        try:
            line.motors.move_to(setpoints_um)
        except MotorError:
            found.failed += 1
            continue
        line.finish()
        status = line.poll(3)
        found.lies += lies(line, setpoints_um, status)
        found.runs_most = max(found.runs_most, line.runs() - runs)
        found.arrived += status.reached
        found.failed += not status.reached
    return found


def start_again_if_needed(line: VirtualLine, drives: dict[str, str]) -> None:
    """What the operator does after a fault: stop, look where it truly stands, say so."""
    for _ in range(20):
        status = line.poll(2)
        if status.certain and status.fault is None:
            return
        truth_um = {name: round(line.position_um(k)) for k, name in enumerate(drives, 1)}
        try:
            line.motors.stop()
            line.motors.declare_position(truth_um)
        except MotorError:
            continue


def lies(line: VirtualLine, setpoints_um: dict[str, int], status: MotorStatus) -> list[str]:
    """Axes of which the driver says that they stand at their setpoints for certain, but do not."""
    if not (status.reached and status.certain and status.fault is None):
        return []
    return [
        f"{name} is at {line.position_um(address):.0f} um: {status}"
        for address, (name, setpoint_um) in enumerate(setpoints_um.items(), 1)
        if not abs(line.position_um(address) - setpoint_um) <= 20
    ]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), drive=st.sampled_from(["open_loop", "closed_loop"]))
def test_on_a_noisy_line_the_driver_never_claims_to_be_where_it_is_not(seed: int, drive: str):
    faults = LineFaults(
        drop_probability=0.01, garble_probability=0.01, garble_command_probability=0.01
    )
    found = noisy_moves(seed, {"xt": drive}, faults, moves=8)
    assert found.lies == []
    assert found.moves == 8
    if drive == "open_loop":
        # Two legs; what noise alone begins (`J1` for `B1`) is stopped at its echo.
        assert found.runs_most <= 3


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), bare_status=st.booleans())
def test_two_axes_on_one_noisy_bus(seed: int, bare_status: bool):
    faults = LineFaults(drop_probability=0.01, garble_command_probability=0.01)
    drives = {"xt": "open_loop", "yt": "closed_loop"}
    found = noisy_moves(seed, drives, faults, moves=6, bare_status=bare_status)
    assert found.lies == []
    assert found.moves == 6


def test_a_slightly_noisy_line_still_gets_most_moves_done():
    faults = LineFaults(drop_probability=0.001, garble_probability=0.001)
    found = noisy_moves(5, {"xt": "open_loop", "yt": "open_loop"}, faults, moves=60)
    assert found.lies == []
    assert found.moves == 60
    assert found.arrived >= 45
    assert found.runs_most <= 6  # two legs an axis, and what noise may begin


@pytest.mark.soak
@settings(max_examples=3000, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    drive=st.sampled_from(["open_loop", "closed_loop"]),
    noise=st.sampled_from([0.001, 0.01, 0.05]),
    bare_status=st.booleans(),
)
def test_many_noisy_lines(seed: int, drive: str, noise: float, bare_status: bool):
    """In closed loop `U0`, where a unit needs it, is a known weak spot on a line this bad: its
    damage to `T0` is found by its echo, and here the echo may be lost as well."""
    bare_status = bare_status or drive == "closed_loop"
    faults = LineFaults(
        drop_probability=noise, garble_probability=noise, garble_command_probability=noise
    )
    drives = {"xt": drive, "yt": drive}
    found = noisy_moves(seed, drives, faults, moves=10, bare_status=bare_status)
    assert found.lies == []
    assert found.moves == 10
    if drive == "open_loop":
        assert found.runs_most <= 6
