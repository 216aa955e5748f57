"""What the bridge asks of motors: the seam between the daemon and a driver.

Positions are absolute integer micrometres by axis name. Every call is bounded in time, bus faults
included: `poll` returns within POLL_BOUND_S and `stop` within STOP_BOUND_S, because the loop that
calls them also listens for STOP.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Protocol

POLL_BOUND_S = 0.05
STOP_BOUND_S = 0.3


class MotorError(Exception):
    """The motors could not do it; `code` is a short word, `text` names axis, number and unit."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text


@dataclass(frozen=True)
class MotorStatus:
    """What the motors said last.

    moving: a motion begun by `move_to` or `home` has not ended (legs of one motion count as one),
        or was stopped and nobody has asked yet where its axes stand.
    reached: the last motion ended at its setpoints within the driver's tolerance.
    readback_um: by axis; for an open-loop axis the position that the step count implies.
    certain_axes: an axis is not among them from power-up, controller reset, stall or an unexpected
        motion until its own `home` or `declare_position`; its readback says nothing then.
    within_um: of an axis whose last motion was cut short: how far from its readback it may have
        ended.
    fault: a short code while something is wrong (a fault ends the motion), else None.
    boards: the serial number of each axis's controller, "" if it tells none.
    locating: nothing moves but what was stopped, and where that stands is being asked.
    setting_up: controllers are being initialised (again); poll as often as during a motion.
    supply: by axis what the controller measures of itself: volts and degrees Celsius.
    """

    moving: bool
    reached: bool
    readback_um: Mapping[str, int]
    certain_axes: frozenset[str]
    parked: bool = False
    within_um: Mapping[str, int] = field(default_factory=dict)
    fault: str | None = None
    fault_text: str = ""
    warnings: tuple[str, ...] = ()
    setting_up: bool = False
    locating: bool = False
    boards: Mapping[str, str] = field(default_factory=dict)
    supply: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def certain(self) -> bool:
        """Every axis."""
        return self.certain_axes >= self.readback_um.keys()


class Motors(Protocol):
    def know_boards(self, boards: Mapping[str, str]) -> None:
        """The boards that drove the axes before, by serial number: another one is an error."""

    def open(self) -> MotorStatus:
        """Connect, identify and initialise the controllers; nothing moves. Raises MotorError."""

    def move_to(self, setpoints_um: Mapping[str, int]) -> None:
        """Begin one motion of the named axes to absolute setpoints (unparks if needed).

        An axis that stands where it is asked to be, within its tolerance, is not commanded.
        Raises MotorError, and then nothing moves. Never called while `poll` says moving.
        """

    def home(self, axes: Collection[str] = ()) -> None:
        """Begin the search for the reference of these axes (none named: all); progress by `poll`.

        Raises MotorError.
        """

    def poll(self) -> MotorStatus:
        """Advance and read. Called about every 20 ms during a motion, every 200 ms otherwise.

        Faults are reported in the status, never raised.
        """

    def stop(self) -> None:
        """Stop all axes now. Idempotent, allowed at any time, also before `open` and after errors.

        Raises MotorError when a controller did not confirm; the stop bytes were sent to all.
        """

    def park(self) -> None:
        """Take the power off; the motors hold by friction. Progress by `poll`: `parked`."""

    def unpark(self) -> None:
        """Put the power on (a move does that by itself). Progress by `poll`: `parked`."""

    def declare_position(self, positions_um: Mapping[str, int]) -> None:
        """The named axes, and no others, stand at these positions. Raises MotorError."""

    def close(self) -> None:
        """Release the ports. Idempotent; stops nothing by itself."""
