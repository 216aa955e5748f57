"""A driver for another motor: the seam `Motors` in a hundred lines.

These motors are perfect and imaginary (they know no bytes), so that nothing but the seam is left to
read: replace `_stage_um` by your controller. A driver is done when it passes `check_motors` of
`tests/robot_bridge/motors_conformance.py`, which drives it as the daemon does. To use it, return it
from `make_motors` in `robot_bridge/__main__.py`.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping

from robot_bridge.daemon.motors import MotorError, MotorStatus


class PerfectMotors:
    """Axes that move at one speed and never slip.

    travel_um: lowest and highest position of each axis; where they stand at power-up is not known.
    """

    def __init__(self, travel_um: Mapping[str, tuple[int, int]], speed_um_per_s: float = 5000.0):
        self._travel_um = dict(travel_um)
        self._speed = speed_um_per_s
        self._stage_um = {axis: 0.0 for axis in travel_um}
        self._setpoint_um: dict[str, float] = {}
        self._certain: set[str] = set()
        self._homing: set[str] = set()
        self._reached = False
        self._parked = True
        self._open = False
        self._last_s = time.monotonic()

    def know_boards(self, boards: Mapping[str, str]) -> None:
        """There are no boards that could be exchanged."""

    def open(self) -> MotorStatus:
        self._open = True
        return self.poll()

    def move_to(self, setpoints_um: Mapping[str, int]) -> None:
        self._require_open()
        for axis, setpoint_um in setpoints_um.items():
            if axis not in self._stage_um:
                raise MotorError("unknown_axis", f"there is no axis {axis}")
            if axis not in self._certain:
                raise MotorError("uncertain", f"where {axis} stands is not known: home it first")
            low_um, high_um = self._travel_um[axis]
            if not low_um <= setpoint_um <= high_um:
                text = f"{axis} at {setpoint_um} µm is beyond its travel {low_um} to {high_um} µm"
                raise MotorError("travel", text)
        self.poll()
        self._parked = False
        self._setpoint_um = {axis: float(at) for axis, at in setpoints_um.items()}
        self._reached = False

    def home(self, axes: Collection[str] = ()) -> None:
        """Drive to the lower end, which is the reference."""
        self._require_open()
        self.poll()
        chosen = set(axes) or set(self._stage_um)
        self._certain -= chosen
        self._homing = chosen
        self._parked = False
        self._setpoint_um = {axis: float(self._travel_um[axis][0]) for axis in chosen}
        self._reached = False

    def poll(self) -> MotorStatus:
        now_s = time.monotonic()
        reach_um = self._speed * (now_s - self._last_s)
        self._last_s = now_s
        for axis, setpoint_um in self._setpoint_um.items():
            left_um = setpoint_um - self._stage_um[axis]
            self._stage_um[axis] += max(-reach_um, min(reach_um, left_um))
        if self._setpoint_um and all(
            self._stage_um[axis] == at for axis, at in self._setpoint_um.items()
        ):
            self._certain |= self._homing
            self._homing, self._setpoint_um, self._reached = set(), {}, True
        return MotorStatus(
            moving=bool(self._setpoint_um),
            reached=self._reached,
            readback_um={axis: round(at) for axis, at in self._stage_um.items()},
            certain_axes=frozenset(self._certain),
            parked=self._parked,
        )

    def stop(self) -> None:
        self.poll()
        if self._setpoint_um:  # cut short
            self._reached = False
        self._setpoint_um, self._homing = {}, set()

    def park(self) -> None:
        self.stop()
        self._parked = True

    def declare_position(self, positions_um: Mapping[str, int]) -> None:
        for axis in positions_um:
            if axis not in self._stage_um:
                raise MotorError("unknown_axis", f"there is no axis {axis}")
        self._stage_um.update({axis: float(at) for axis, at in positions_um.items()})
        self._certain |= positions_um.keys()

    def close(self) -> None:
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise MotorError("not_open", "the controllers are not open")
