"""What every driver of motors must do: the seam `Motors` (`robot_bridge/daemon/motors.py`), tried.

`check_motors` drives two axes by up to 0.6 mm from where they stand, and back. Give it a driver
that is not open yet, on a bench, with nothing in the way.
"""

import contextlib
import time

import pytest

from robot_bridge.daemon.motors import MotorError, Motors, MotorStatus

TOLERANCE_UM = 20
PATIENCE_S = 120.0


def ended(motors: Motors) -> MotorStatus:
    """Poll as the daemon does until nothing moves."""
    deadline_s = time.monotonic() + PATIENCE_S
    while (status := motors.poll()).moving or status.setting_up:
        assert time.monotonic() < deadline_s, "a motion does not end"
        time.sleep(0.02)
    return status


def check_motors(motors: Motors, first: str, second: str) -> None:
    motors.stop()  # allowed before `open`
    with pytest.raises(MotorError):
        motors.move_to({first: 0})
    try:
        _check_open(motors, first, second)
    finally:
        with contextlib.suppress(MotorError):
            motors.stop()
        motors.close()
        motors.close()  # twice is once


def _check_open(motors: Motors, first: str, second: str) -> None:
    status = motors.open()
    assert {first, second} <= status.readback_um.keys()
    status = ended(motors)
    assert status.fault is None, status.fault_text
    assert not status.certain_axes, "after power-up nobody knows where the axes stand"
    with pytest.raises(MotorError):
        motors.move_to({first: 100})
    _declared(motors, first, second)
    _moved(motors, first, second)
    _stopped(motors, first)
    motors.park()
    assert not ended(motors).moving
    motors.move_to({first: 0, second: 0})  # unparks
    status = ended(motors)
    assert status.reached
    assert abs(status.readback_um[first]) <= TOLERANCE_UM


def _declared(motors: Motors, first: str, second: str) -> None:
    motors.declare_position({first: 0})
    status = motors.poll()
    assert status.certain_axes == {first}, "what is said of one axis is said of no other"
    with pytest.raises(MotorError):
        motors.move_to({second: 100})
    motors.declare_position({second: 0})
    assert motors.poll().certain


def _moved(motors: Motors, first: str, second: str) -> None:
    motors.move_to({first: 600, second: -300})
    status = ended(motors)
    assert status.reached
    assert abs(status.readback_um[first] - 600) <= TOLERANCE_UM
    assert abs(status.readback_um[second] + 300) <= TOLERANCE_UM
    before_um = status.readback_um[second]
    motors.move_to({first: -600})
    status = ended(motors)
    assert abs(status.readback_um[first] + 600) <= TOLERANCE_UM
    assert status.readback_um[second] == before_um, "an axis that nobody named stays"


def _stopped(motors: Motors, first: str) -> None:
    motors.move_to({first: 600})
    began_s = time.monotonic()
    while abs(motors.poll().readback_um[first] + 600) < 30:
        assert time.monotonic() - began_s < PATIENCE_S
    motors.stop()
    motors.stop()  # twice is once
    status = ended(motors)
    held_um = status.readback_um[first]
    assert not status.reached or abs(held_um - 600) <= TOLERANCE_UM
    assert ended(motors).readback_um[first] == held_um, "stopped means standing"
    if first not in status.certain_axes:
        motors.declare_position({first: held_um})
