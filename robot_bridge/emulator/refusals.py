"""Why an emulated controller does not carry a command out, and how it says so."""

from robot_bridge.emulator.axis import EmulatedController


class NotUnderstoodError(Exception):
    """Answered by `_??_`."""


class NotPossibleError(Exception):
    """Answered by a trailing `!`."""


class NotImplementedHereError(Exception):
    """Answered by `:!`."""


def require_power(c: EmulatedController) -> None:
    """A run while parked is answered by `!`, and unparks instead of moving.

    While it unparks already it waits for that, as drivers written on hardware count on.
    """
    if c.can_run or (c.unparking and c.switches.while_unparking == "wait"):
        return
    if not c.powerless:
        c.unpark()
    raise NotPossibleError


def require_speed(c: EmulatedController, speed_hz: int) -> None:
    if speed_hz == 0 or (
        c.switches.overspeed == "refuse" and abs(speed_hz) > c.motor.max_frequency_hz
    ):
        raise NotPossibleError
