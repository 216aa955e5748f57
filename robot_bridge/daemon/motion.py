"""One motion, and how it goes on: decided from the motors' status and the time, nothing else."""

from dataclasses import dataclass

from robot_bridge.daemon.journal import CommandRecord
from robot_bridge.daemon.motors import MotorStatus
from robot_bridge.protocol.messages import Code, CommandState

STANDSTILL_BOUND_S = 3.0


@dataclass(frozen=True)
class Ending:
    state: CommandState
    code: Code
    text: str


@dataclass
class Motion:
    """A motion in flight. `ending`: decided, waiting for standstill."""

    record: CommandRecord
    accepted_s: float
    started: bool = False
    ending: Ending | None = None
    ending_s: float = 0.0

    @property
    def homing(self) -> bool:
        return self.record.what == "home"

    def decide_end(self, ending: Ending, now_s: float) -> None:
        """The first one wins."""
        if self.ending is None:
            self.ending, self.ending_s = ending, now_s


@dataclass(frozen=True)
class Runs:
    """The motors move towards the setpoints."""


@dataclass(frozen=True)
class RunsOut:
    """Its end is decided, but the motors still move."""


@dataclass(frozen=True)
class Faulty:
    """The motors report a fault: everything has to stop, and the stop is latched."""

    ending: Ending


@dataclass(frozen=True)
class Overdue:
    """It has to be stopped."""

    ending: Ending


@dataclass(frozen=True)
class Over:
    """The motors stand, or will not: there is nothing to wait for any more."""

    ending: Ending


Progress = Runs | RunsOut | Faulty | Overdue | Over


def progress(motion: Motion, status: MotorStatus, now_s: float, timeout_s: float) -> Progress:
    """How a motion that was started goes on. `timeout_s`: counted from its acceptance."""
    if motion.ending is not None:
        return _running_out(motion.ending, status, now_s - motion.ending_s)
    if status.fault is not None:
        text = f"{status.fault}: {status.fault_text}"
        return Faulty(Ending(CommandState.FAILED, Code.MOTOR_FAULT, text))
    if now_s - motion.accepted_s > timeout_s:
        text = f"did not arrive within {timeout_s:g} s"
        return Overdue(Ending(CommandState.FAILED, Code.MOTION_TIMEOUT, text))
    if status.moving:
        return Runs()
    if not status.reached:
        text = f"the motors stopped at {_short(status)} without reaching the setpoints"
        return Over(Ending(CommandState.FAILED, Code.NOT_REACHED, text))
    return Over(Ending(CommandState.DONE, Code.OK, ""))


def _running_out(ending: Ending, status: MotorStatus, waited_s: float) -> Progress:
    if not status.moving:
        return Over(ending)
    if waited_s > STANDSTILL_BOUND_S:
        text = "the motors are not stopping"
        return Over(Ending(CommandState.FAILED, Code.MOTOR_FAULT, text))
    return RunsOut()


def _short(status: MotorStatus) -> str:
    return ", ".join(f"{axis} {value} um" for axis, value in status.readback_um.items())
