"""What the axes tell together, as the bridge's status of the motors has it; pure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd.axis import PmdAxis

Axes = Mapping[str, PmdAxis]


def told_by_axis(axes: Axes, *, known: bool) -> dict[str, Any]:
    """The fields of a MotorStatus that are by axis. known: the controllers were initialised."""
    return {
        "readback_um": {name: axis.readback_um() for name, axis in axes.items()},
        "certain_axes": frozenset(name for name, axis in axes.items() if known and axis.certain),
        "within_um": {
            name: math.ceil(axis.within_um)
            for name, axis in axes.items()
            if axis.within_um is not None
        },
        "parked": all(axis.parked for axis in axes.values()),
        "setting_up": any(axis.needs_setup for axis in axes.values()),
        "boards": {name: axis.board for name, axis in axes.items()},
        "supply": {
            name: {"volts_48": axis.supply.volts_48, "board_celsius": axis.supply.board_celsius}
            for name, axis in axes.items()
            if axis.supply is not None
        },
    }


def warnings_of(axes: Axes) -> list[str]:
    """What the boards do not answer, are not told apart by, and what parking did."""
    doubts = [
        f"axis {name}: no answer to '{what}': {text}"
        for name, axis in axes.items()
        for what, text in axis.doubts.items()
    ]
    shifts = [
        f"axis {name}: parking moved it by {axis.park_shift_um:+.0f} um"
        for name, axis in axes.items()
        if axis.park_shift_um is not None and abs(axis.park_shift_um) > axis.config.tolerance_um
    ]
    return doubts + same_addresses([axis.config for axis in axes.values()]) + shifts


def same_addresses(axes: Sequence[AxisConfig]) -> list[str]:
    """Boards that only their serial numbers tell apart, if their ports' names change places."""
    said = []
    for number, axis in enumerate(axes):
        for other in axes[number + 1 :]:
            alike = axis.address == other.address and axis.controller != other.controller
            if alike and None in (axis.serial_number, other.serial_number):
                said.append(
                    f"axes {axis.name} and {other.name} have the same address {axis.address} on "
                    "two ports: give each its serial_number and name the ports by /dev/serial/by-id"
                )
    return said
