"""What a motion of a PMD axis must not do, and what is said when one fails; pure."""

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.daemon.motors import MotorError
from robot_bridge.pmd.axis import PmdAxis
from robot_bridge.pmd.controller import AxisFaultError
from robot_bridge.pmd.protocol import PmdCommandError, PmdEchoError, PmdError, PmdTimeoutError


def check_setpoint(axis: AxisConfig, setpoint_um: int) -> None:
    """Raises MotorError."""
    if not isinstance(setpoint_um, int) or (
        not axis.travel_min_um <= setpoint_um <= axis.travel_max_um
    ):
        raise MotorError(
            "beyond_travel",
            f"axis {axis.name}: setpoint {setpoint_um!r} um is outside "
            f"{axis.travel_min_um}..{axis.travel_max_um} um",
        )


def check_set_up(axis: PmdAxis) -> None:
    """Raises MotorError."""
    if axis.needs_setup:
        raise MotorError(
            "controller_reset", f"axis {axis.config.name}: its controller is not set up (again) yet"
        )


def check_known(axis: PmdAxis, setpoint_um: int) -> None:
    """An axis that has to move must be known to stand where it is said to. Raises MotorError."""
    check_set_up(axis)
    if not axis.certain and not axis.stands_at(setpoint_um):
        raise MotorError(
            "position_uncertain", f"axis {axis.config.name}: home it or declare its position first"
        )


def check_run(axis: PmdAxis, steps: int) -> None:
    """An open-loop axis whose position nobody declared has none to check: the engineer looks.

    Raises MotorError if the run could leave the travel even with steps twice as long as set.
    """
    config = axis.config
    if not isinstance(steps, int) or steps == 0:
        raise MotorError("bad_run", f"axis {config.name}: a run of {steps!r} steps")
    if not (axis.closed_loop or axis.certain):
        return
    reach_um = 2 * abs(steps) * max(config.step_um_forward, config.step_um_reverse)
    direction = config.sign * (1 if steps > 0 else -1)
    end_um = axis.readback_um() + direction * reach_um
    if not config.travel_min_um <= end_um <= config.travel_max_um:
        raise MotorError(
            "beyond_travel",
            f"axis {config.name}: {steps:+d} steps could reach {end_um:.0f} um, outside "
            f"{config.travel_min_um}..{config.travel_max_um} um",
        )


_CODES: dict[type[PmdError], str] = {
    PmdTimeoutError: "no_answer",
    PmdEchoError: "damaged_command",
    PmdCommandError: "bad_command",
}


def code_and_text(axis: PmdAxis, error: PmdError) -> tuple[str, str]:
    if isinstance(error, AxisFaultError):
        return error.code, str(error)
    code = next((c for kind, c in _CODES.items() if isinstance(error, kind)), "protocol")
    return code, f"axis {axis.config.name}: {error}"
