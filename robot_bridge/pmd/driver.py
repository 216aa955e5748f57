"""The driver of PMD401/PMD301 controllers: several axes, on one bus or on ports of their own.

One plain class. `open`, `stop` and `declare_position` do their work before they return; `move_to`,
`home` and `park` begin it, and `poll` carries it on in slices of a few milliseconds. Nothing here
knows limits of phases or arming: that is the bridge's. Written from the manuals and public
drivers, not tried on hardware yet: it says so whenever it starts.
"""

import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.daemon.motors import MotorError, MotorStatus
from robot_bridge.pmd.axis import PmdAxis
from robot_bridge.pmd.checks import (
    check_known,
    check_run,
    check_set_up,
    check_setpoint,
    code_and_text,
)
from robot_bridge.pmd.controller import POWER_ON_DELAY_US
from robot_bridge.pmd.encoder_script import EncoderFound, find_encoder
from robot_bridge.pmd.homing import home
from robot_bridge.pmd.line import PmdLine, Procedure, Task
from robot_bridge.pmd.ports import OpenPort, PmdPorts, SerialPort
from robot_bridge.pmd.protocol import PmdEchoError, PmdError, PmdTimeoutError
from robot_bridge.pmd.report import told_by_axis, warnings_of
from robot_bridge.pmd.stop import confirm_stops

log = logging.getLogger(__name__)

UNTRIED = "PMD401/PMD301 driver: never tested on hardware; do the first-unit checks in bring_up.md"
POLL_BUDGET_S = 0.02
INITIALISE_DEADLINE_S = 10.0
DECLARE_DEADLINE_S = 2.0
RECONNECT_PAUSE_S = 1.0
# Faults at rest that mean that a motor may move.
NEEDS_STOP = frozenset({"damaged_command", "moving_by_itself", "estop"})


class PmdMotors:
    """Implements `robot_bridge.daemon.motors.Motors`."""

    def __init__(
        self,
        axes: Sequence[AxisConfig],
        *,
        baud: int = 115200,
        timeout_s: float = 0.1,
        response_delay_us: int = POWER_ON_DELAY_US,
        park_after_move: bool = False,
        capture_file: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
        open_port: OpenPort | None = None,
        exclusive: bool = True,
    ) -> None:
        """exclusive: nobody else may have the ports; only a stop asks for less."""
        self._axes = {
            config.name: PmdAxis(config, clock, response_delay_us=response_delay_us)
            for config in axes
        }
        self._ports = PmdPorts(
            _addresses_by_url(axes),
            timeout_s=timeout_s,
            capture_file=capture_file,
            clock=clock,
            open_port=open_port or (lambda url: SerialPort(url, baud, exclusive=exclusive)),
        )
        self._timeout_s, self._clock = timeout_s, clock
        self._park_after_move = park_after_move
        self._motion: dict[str, Task] = {}
        self._other: dict[str, Task] = {}  # refreshing, parking, confirming a stop
        self._setpoints_um: dict[str, int] = {}
        self._reached = False
        self._fault: tuple[str, str] | None = None  # of the last motion, until the next command
        self._initialised = False
        self._reconnect_s: float | None = None  # when to try again; set while a port is lost

    # Opening and closing

    def know_boards(self, boards: Mapping[str, str]) -> None:
        for name, board in boards.items():
            if name in self._axes:
                self._axes[name].board = board

    def open(self) -> MotorStatus:
        log.warning(UNTRIED)
        self._ports.connect()
        for axis in self._axes.values():
            deadline_s = self._clock() + INITIALISE_DEADLINE_S
            self._run(axis, axis.set_up(), "initialisation", deadline_s)
            log.info("axis %s: %s", axis.config.name, axis.identity)
        self._initialised = True
        return self._status()

    def close(self) -> None:
        self._ports.close()
        self._motion, self._other = {}, {}
        self._initialised = False
        self._reconnect_s = None

    def _line_of(self, axis: PmdAxis) -> PmdLine:
        return self._ports.lines[axis.config.controller]

    def _run(self, axis: PmdAxis, procedure: Procedure, name: str, deadline_s: float) -> None:
        try:
            self._line_of(axis).run(procedure, f"{name} of axis {axis.config.name}", deadline_s)
        except PmdError as error:
            raise MotorError(*self._note_error(axis, error)) from error
        except OSError as error:
            raise MotorError("port_failed", f"{axis.config.controller}: {error}") from error

    # Beginning something

    def move_to(self, setpoints_um: Mapping[str, int]) -> None:
        self._require_ready()
        axes = {name: self._axis(name) for name in setpoints_um}
        for name, axis in axes.items():
            check_setpoint(axis.config, setpoints_um[name])
        for axis in self._axes.values():
            if axis.fault is not None:
                raise MotorError(*axis.fault)
        for name, axis in axes.items():
            check_known(axis, setpoints_um[name])
        self._begin(setpoints_um)
        for name, axis in axes.items():
            self._start(name, axis.move(setpoints_um[name], self._park_after_move), "move")

    def home(self, axes: Collection[str] = ()) -> None:
        self._require_ready()
        homes_um = {}
        for name in axes or self._axes:
            axis = self._axis(name)
            if axis.config.home_um is None:
                raise MotorError("no_home", f"axis {name}: home_mm is not in the configuration")
            check_set_up(axis)
            homes_um[name] = axis.config.home_um
        self._begin({})  # where it ends is not where the reference is
        for name, home_um in homes_um.items():
            self._start(name, home(self._axes[name], home_um), "home")

    def run_steps(self, name: str, steps: int) -> None:
        """Begin an open-loop run of waveform steps, forward positive, of one axis (calibration).

        For an engineer at the controller: the bridge never calls it, it moves in setpoints alone.
        Raises MotorError if the run could leave the travel even with steps twice as long as set.
        """
        self._require_ready()
        axis = self._axis(name)
        check_set_up(axis)
        check_run(axis, steps)
        self._begin({})
        self._start(name, axis.run_steps(steps), "run")

    def park(self) -> None:
        self._require_ready()
        self._give_up_tasks()
        for name, axis in self._axes.items():
            self._other[name] = self._line_of(axis).start(axis.park(), f"parking of {name}")

    def unpark(self) -> None:
        """Power on, before imaging or a measurement that needs it; a move does it by itself."""
        self._require_ready()
        self._give_up_tasks()
        for name, axis in self._axes.items():
            check_set_up(axis)
            self._other[name] = self._line_of(axis).start(axis.unpark(), f"unparking of {name}")

    def park_now(self) -> None:
        """Stop, then take the power off, opened or not. Raises MotorError if unconfirmed."""
        self.stop()
        deadline_s = self._clock() + DECLARE_DEADLINE_S
        for axis in self._axes.values():
            self._run(axis, axis.park(), "parking", deadline_s)

    def find_encoder(self, name: str) -> EncoderFound:
        """Let the controller's script find the encoder; the axis runs some 70 um to and fro.

        For an engineer at the controller. Blocks. Raises MotorError.
        """
        self._require_ready()
        axis = self._axis(name)
        check_set_up(axis)
        if not axis.closed_loop:
            raise MotorError("no_encoder", f"axis {name} runs in open loop")
        self._begin({})
        found: list[EncoderFound] = []

        def script() -> Procedure:
            found.append((yield from find_encoder(axis)))

        self._run(axis, script(), "encoder script", self._clock() + INITIALISE_DEADLINE_S)
        self._run(axis, axis.set_up(), "initialisation", self._clock() + INITIALISE_DEADLINE_S)
        return found[0]

    def measure_um(self, name: str) -> float:
        """The encoder's position, asked for now. Raises MotorError."""
        self._require_ready()
        axis = self._axis(name)
        if not axis.closed_loop:
            raise MotorError("no_encoder", f"axis {name} runs in open loop")
        self._run(axis, axis.measure(), "measurement", self._clock() + DECLARE_DEADLINE_S)
        return axis.position_um

    def declare_position(self, positions_um: Mapping[str, int]) -> None:
        self._require_ready()
        axes = {name: self._axis(name) for name in positions_um}
        for name, position_um in positions_um.items():
            if not isinstance(position_um, int):
                raise MotorError(
                    "bad_position", f"axis {name}: {position_um!r} um is not an integer"
                )
        self._begin({})
        deadline_s = self._clock() + DECLARE_DEADLINE_S
        for name, axis in axes.items():
            self._run(axis, axis.declare(positions_um[name]), "declaration", deadline_s)

    def _begin(self, setpoints_um: Mapping[str, int]) -> None:
        self._give_up_tasks()
        self._fault, self._reached = None, False
        self._setpoints_um = dict(setpoints_um)

    def _start(self, name: str, procedure: Procedure, what: str) -> None:
        line = self._line_of(self._axes[name])
        self._motion[name] = line.start(procedure, f"{what} of {name}")

    def _give_up_tasks(self) -> None:
        """Refreshing and parking; the next procedure finds out how far that came."""
        self._ports.give_up_tasks()
        self._motion, self._other = {}, {}

    def _require_ready(self) -> None:
        if not self._initialised:
            raise MotorError("not_open", "the controllers are not initialised")
        if self._reconnect_s is not None:
            raise MotorError(*(self._fault or ("port_failed", "a controller port is lost")))
        if self._motion:
            raise MotorError("moving", "a motion is in progress")

    def _axis(self, name: str) -> PmdAxis:
        if name not in self._axes:
            raise MotorError("unknown_axis", f"there is no axis {name!r}")
        return self._axes[name]

    # Going on

    def poll(self) -> MotorStatus:
        if self._initialised:
            try:
                self._carry_on()
            except OSError as error:
                self._lose_port(f"controller port: {error}")
        return self._status()

    def _carry_on(self) -> None:
        if self._reconnect_s is not None and not self._ports.lines:
            self._try_to_reconnect()
            return
        if not self._motion and not self._other:
            self._for_each_axis(_look_after, "status")
        share_s = POLL_BUDGET_S / len(self._ports.lines)
        for line in self._ports.lines.values():
            line.step(share_s)
        failed_at_rest, failed = self._collect(self._other), self._collect(self._motion)
        if self._reconnect_s is not None:
            self._finish_reconnecting(failed_at_rest)
        elif failed or (failed_at_rest and failed_at_rest[0] in NEEDS_STOP):
            self._fail(*(failed or failed_at_rest or ("", "")))
        elif self._motion and all(task.done for task in self._motion.values()):
            self._motion = {}
            self._reached = self._all_reached()

    def _for_each_axis(self, make: Callable[[PmdAxis], Procedure], what: str) -> None:
        for name, axis in self._axes.items():
            self._other[name] = self._line_of(axis).start(make(axis), f"{what} of {name}")

    def _collect(self, tasks: dict[str, Task]) -> tuple[str, str] | None:
        """Note the errors of tasks that ended; a motion stays listed until all axes ended."""
        failed = None
        for name, task in list(tasks.items()):
            if task.done and task.error is not None:
                failed = self._note_error(self._axes[name], task.error)
                if tasks is self._motion and isinstance(task.error, PmdTimeoutError):
                    self._axes[name].lose_position()  # nobody saw where it stopped
            if task.done and tasks is self._other:
                del tasks[name]
        return failed

    def _note_error(self, axis: PmdAxis, error: PmdError) -> tuple[str, str]:
        failed = code_and_text(axis, error)
        if failed != axis.fault:
            log.warning("%s", failed[1])
        axis.fault = failed
        axis.proven = False  # a stall in the run that proves a wrong scale looks like a right one
        if isinstance(error, PmdEchoError):
            axis.lose_position()
        return failed

    def _fail(self, code: str, text: str) -> None:
        """A fault ends the motion of all axes; the confirmation follows with the next polls."""
        self._fault, self._reached = (code, text), False
        self._motion, self._other = {}, {}
        if failures := self._ports.send_stop():
            self._lose_port("; ".join(failures))
            return
        self._for_each_axis(_stand_still, "stop")

    def _all_reached(self) -> bool:
        return all(
            abs(self._axes[name].readback_um() - setpoint_um)
            <= self._axes[name].config.tolerance_um
            for name, setpoint_um in self._setpoints_um.items()
        )

    def _status(self) -> MotorStatus:
        fault = self._fault or next((a.fault for a in self._axes.values() if a.fault), None)
        unread = {name for name, axis in self._axes.items() if axis.unread}
        return MotorStatus(
            moving=bool(self._motion or unread),
            locating=not self._motion and bool(unread) and unread <= self._other.keys(),
            reached=self._reached,
            fault=fault[0] if fault else None,
            fault_text=fault[1] if fault else "",
            warnings=(UNTRIED, *warnings_of(self._axes)),
            **told_by_axis(self._axes, known=self._initialised),
        )

    # A port that goes away and comes back (a plug, a converter)

    def _lose_port(self, text: str, code: str = "port_failed") -> None:
        """Stop what can still be reached, and begin again from opening. Positions are lost."""
        if self._reconnect_s is None:
            log.error("%s", text)
        self._ports.send_stop()
        self._ports.close()
        for name in self._motion:
            self._axes[name].lose_position()
        self._motion, self._other = {}, {}
        self._fault, self._reached = (code, text), False
        for axis in self._axes.values():
            axis.certain = axis.unread = False
            axis.needs_setup = True
        self._reconnect_s = self._clock() + RECONNECT_PAUSE_S

    def _try_to_reconnect(self) -> None:
        if self._reconnect_s is None or self._clock() < self._reconnect_s:
            return
        self._reconnect_s = self._clock() + RECONNECT_PAUSE_S
        try:
            self._ports.connect()
        except MotorError as error:
            self._ports.close()
            self._fault = (error.code, error.text)
            return
        self._for_each_axis(lambda axis: axis.set_up(), "initialisation")

    def _finish_reconnecting(self, failed: tuple[str, str] | None) -> None:
        if failed:
            self._lose_port(failed[1], failed[0])
        elif not self._other:
            log.warning("the controllers answer again; declare the position or home")
            for axis in self._axes.values():
                axis.fault = None
            self._fault, self._reconnect_s = None, None

    # Stopping

    def stop(self) -> None:
        """First the bytes that stop everything, to all buses; then each axis has to confirm."""
        failures = []
        if not self._ports.lines:
            try:
                self._ports.connect()
            except MotorError as error:
                failures.append(error.text)
        self._motion, self._other, self._reached = {}, {}, False
        if self._reconnect_s is None:
            self._fault = None
        failures += self._ports.send_stop()
        failures += confirm_stops(
            list(self._axes.values()),
            self._ports.lines,
            self._clock,
            timeout_s=self._timeout_s,
        )
        if self._reconnect_s is not None:
            self._ports.close()  # initialised again from the start, by `poll`
        for name, axis in self._axes.items():
            if axis.unread and axis.config.controller in self._ports.lines:
                self._other[name] = self._line_of(axis).start(axis.locate(), f"place of {name}")
        if failures:
            raise MotorError("stop_unconfirmed", "; ".join(failures))


def _stand_still(axis: PmdAxis) -> Procedure:
    yield from axis.confirm_stop()
    yield from axis.withdraw_mark()
    if axis.unread:
        yield from axis.locate()


def _look_after(axis: PmdAxis) -> Procedure:
    """What an axis needs while nothing moves."""
    if not axis.needs_setup:
        yield from axis.withdraw_mark()
        yield from axis.refresh()
        return
    yield from axis.set_up()
    axis.fault = None


def _addresses_by_url(axes: Sequence[AxisConfig]) -> dict[str, list[int]]:
    by_url: dict[str, list[int]] = {}
    for axis in axes:
        by_url.setdefault(axis.controller, []).append(axis.address)
    return by_url
