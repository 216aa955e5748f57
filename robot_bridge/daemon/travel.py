"""Travel limits: the check that every setpoint passes before anything else is asked of it."""

from collections.abc import Mapping, Sequence

from robot_bridge.protocol.messages import AxisTravel, Code


def check_setpoints(
    setpoints_um: Mapping[str, object],
    axes: Sequence[AxisTravel],
    readback_um: Mapping[str, int] | None = None,
) -> tuple[Code, str] | None:
    """What is wrong with `setpoints_um`, or None: all axes, no other, whole um, inside travel.

    An axis that stands a little beyond its travel, within its tolerance, may be asked to stay: it
    must not keep the others from moving. readback_um: where the axes stand; None: as asked.
    """
    names = [axis.name for axis in axes]
    for name in setpoints_um:
        if name not in names:
            return Code.UNKNOWN_AXIS, f"axis {str(name)[:40]!r} is not one of {', '.join(names)}"
    for axis in axes:
        if axis.name not in setpoints_um:
            return Code.MISSING_AXIS, f"axis {axis.name!r} has no setpoint; every axis needs one"
        value = setpoints_um[axis.name]
        if type(value) is not int:
            return Code.MALFORMED, f"axis {axis.name!r}: {str(value)[:40]} is not a whole number"
        stays = readback_um is None or abs(value - readback_um[axis.name]) <= axis.tolerance_um
        spare_um = axis.tolerance_um if stays else 0
        if not axis.min_um - spare_um <= value <= axis.max_um + spare_um:
            return Code.BEYOND_TRAVEL, (
                f"axis {axis.name!r}: {value} um is outside its travel "
                f"{axis.min_um} to {axis.max_um} um"
            )
    return None
