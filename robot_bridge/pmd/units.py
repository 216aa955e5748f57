"""From the axis's micrometres to what a controller counts, and back. No state.

An axis grows with the controller's forward direction if its sign is +1, shrinks with it if -1.
Step lengths are those of the *controller's* directions (forward, reverse), because the asymmetry
belongs to the motor. Encoder counts grow with the controller's forward direction; zero micrometres
is zero counts.
"""

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd.protocol import I32_MAX, I32_MIN, MICROSTEPS_PER_STEP

MAX_SPEED_PARAMETER = 2**32 - 1


def microsteps_from_um(axis: AxisConfig, distance_um: float) -> int:
    """Signed microsteps (forward positive) for a signed distance of the axis."""
    forward_um = axis.sign * distance_um
    step_um = axis.step_um_forward if forward_um > 0 else axis.step_um_reverse
    return round(forward_um / step_um * MICROSTEPS_PER_STEP)


def um_from_microsteps(axis: AxisConfig, microsteps: float) -> float:
    """The axis's signed distance for signed microsteps."""
    step_um = axis.step_um_forward if microsteps > 0 else axis.step_um_reverse
    return axis.sign * microsteps / MICROSTEPS_PER_STEP * step_um


def count_from_um(axis: AxisConfig, position_um: float) -> int:
    return round(axis.sign * position_um * axis.counts_per_mm / 1000.0)


def um_from_count(axis: AxisConfig, count: int) -> float:
    return axis.sign * count * 1000.0 / axis.counts_per_mm


def um_per_count(axis: AxisConfig) -> float:
    return 1000.0 / axis.counts_per_mm


def speed_parameter(axis: AxisConfig) -> int:
    """Y11: 65536 x 4 / counts a waveform step, at the mean step length of the two directions."""
    step_um = (axis.step_um_forward + axis.step_um_reverse) / 2
    counts_per_step = step_um * axis.counts_per_mm / 1000.0
    return max(1, min(MAX_SPEED_PARAMETER, round(65536 * 4 / counts_per_step)))


def count_limits(axis: AxisConfig) -> tuple[int, int]:
    """Y3 and Y4: the travel with room for the stop range, so that both ends can be reached."""
    ends = (count_from_um(axis, axis.travel_min_um), count_from_um(axis, axis.travel_max_um))
    room = 2 * axis.tolerance_counts
    return max(I32_MIN, min(ends) - room), min(I32_MAX, max(ends) + room)


def legs_um(axis: AxisConfig, from_um: float, setpoint_um: int) -> tuple[int, ...]:
    """The setpoints to pass so that the last leg always runs in the axis's positive direction.

    A move that would arrive from above goes `approach_um` below the setpoint first, as far as the
    travel allows; so backlash and the asymmetry of steps act the same way in every move.
    """
    if axis.approach_um == 0 or from_um <= setpoint_um - axis.approach_um:
        return (setpoint_um,)
    return (max(axis.travel_min_um, setpoint_um - axis.approach_um), setpoint_um)
