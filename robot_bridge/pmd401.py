"""The driver of PMD401/PMD301 controllers: several axes, on one bus or on ports of their own.

One plain class. `open`, `stop` and `declare_position` do their work before they return; `move_to`,
`home` and `park` begin it, and `poll` carries it on in slices of a few milliseconds. Nothing here
knows limits of phases or arming: that is the bridge's. Written from the manuals and public
drivers, not tried on hardware yet: it says so whenever it starts.
"""

import logging
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import serial

from robot_bridge import pmd_protocol
from robot_bridge.capture import CaptureWriter, CapturingPort
from robot_bridge.config import AxisConfig
from robot_bridge.motors import MotorError, MotorStatus
from robot_bridge.pmd_axis import AxisFaultError, PmdAxis
from robot_bridge.pmd_line import PmdLine, Port, Procedure, Task
from robot_bridge.pmd_protocol import PmdEchoError, PmdError, PmdTimeoutError

log = logging.getLogger(__name__)

UNTRIED = "PMD401/PMD301 driver: not tried on hardware; do the first-unit checks of bring_up.md"
READ_WAIT_S = 0.002
POLL_BUDGET_S = 0.02
STOP_DEADLINE_S = 0.25
STOP_ANSWER_TIMEOUT_S = 0.04
INITIALISE_DEADLINE_S = 10.0
DECLARE_DEADLINE_S = 2.0

# Faults at rest that mean that a motor may move.
NEEDS_STOP = frozenset({"damaged_command", "moving_by_itself"})

OpenPort = Callable[[str], Port]


class SerialPort:
    """A device, a pseudo-terminal or any other pyserial URL. Every failure is an OSError."""

    def __init__(self, url: str, baud: int) -> None:
        self._port = serial.serial_for_url(
            url, baudrate=baud, timeout=READ_WAIT_S, write_timeout=0.1
        )

    def read(self, size: int = 1, /) -> bytes:
        data: bytes = self._port.read(size)
        return data

    def write(self, data: bytes, /) -> int | None:
        written: int | None = self._port.write(data)
        return written

    def reset_input_buffer(self) -> None:
        try:
            self._port.reset_input_buffer()
        except termios.error as error:  # pyserial lets this one through
            raise OSError(*error.args) from error

    def close(self) -> None:
        self._port.close()


class PmdMotors:
    """Implements `robot_bridge.motors.Motors`."""

    def __init__(
        self,
        axes: Sequence[AxisConfig],
        *,
        baud: int = 115200,
        timeout_s: float = 0.1,
        park_after_move: bool = False,
        capture_file: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
        open_port: OpenPort | None = None,
    ) -> None:
        self._axes = {config.name: PmdAxis(config, clock) for config in axes}
        self._timeout_s, self._clock = timeout_s, clock
        self._park_after_move = park_after_move
        self._capture_file = capture_file
        self._capture: CaptureWriter | None = None
        self._open_port = open_port or (lambda url: SerialPort(url, baud))
        self._lines: dict[str, PmdLine] = {}
        self._ports: list[Port] = []
        self._motion: dict[str, Task] = {}
        self._other: dict[str, Task] = {}  # refreshing, parking
        self._setpoints_um: dict[str, int] = {}
        self._reached = False
        self._fault: tuple[str, str] | None = None
        self._initialised = False

    # Opening and closing

    def open(self) -> MotorStatus:
        log.warning(UNTRIED)
        self._connect()
        deadline_s = self._clock() + INITIALISE_DEADLINE_S
        for axis in self._axes.values():
            self._run(axis, axis.initialise(), "initialisation", deadline_s)
            log.info("axis %s: %s", axis.config.name, axis.identity)
        self._initialised = True
        return self._status()

    def _connect(self) -> None:
        for axis in self._axes.values():
            url = axis.config.controller
            if url in self._lines:
                continue
            try:
                port = self._captured(self._open_port(url), url)
                # Whatever half line the controllers hold is cancelled.
                port.write(b"\x1b;")
            except (OSError, ValueError) as error:
                raise MotorError("no_port", f"controller port {url}: {error}") from error
            self._ports.append(port)
            self._lines[url] = PmdLine(port, self._timeout_s, self._clock)

    def _captured(self, port: Port, url: str) -> Port:
        if self._capture_file is None:
            return port
        if self._capture is None:
            self._capture = CaptureWriter(self._capture_file)
        return CapturingPort(port, url, self._capture)

    def close(self) -> None:
        for line in self._lines.values():
            line.cancel_all()
        for port in self._ports:
            port.close()
        self._lines, self._ports, self._motion, self._other = {}, [], {}, {}
        self._initialised = False
        if self._capture is not None:
            self._capture.close()
            self._capture = None

    def _line_of(self, axis: PmdAxis) -> PmdLine:
        return self._lines[axis.config.controller]

    def _addresses(self) -> dict[str, list[int]]:
        by_url: dict[str, list[int]] = {}
        for axis in self._axes.values():
            by_url.setdefault(axis.config.controller, []).append(axis.address)
        return by_url

    def _run(self, axis: PmdAxis, procedure: Procedure, name: str, deadline_s: float) -> None:
        try:
            self._line_of(axis).run(procedure, f"{name} of axis {axis.config.name}", deadline_s)
        except PmdError as error:
            raise self._motor_error(axis, error) from error
        except OSError as error:
            raise MotorError("port_failed", f"{axis.config.controller}: {error}") from error

    def _motor_error(self, axis: PmdAxis, error: PmdError) -> MotorError:
        code, text = _code_and_text(axis, error)
        return MotorError(code, text)

    # Beginning something

    def move_to(self, setpoints_um: Mapping[str, int]) -> None:
        self._require_ready()
        axes = {name: self._axis(name) for name in setpoints_um}
        for name, axis in axes.items():
            _check_setpoint(axis.config, setpoints_um[name])
        self._begin()
        self._setpoints_um = dict(setpoints_um)
        for name, axis in axes.items():
            procedure = axis.move(setpoints_um[name], self._park_after_move)
            self._motion[name] = self._line_of(axis).start(procedure, f"move of {name}")

    def home(self) -> None:
        self._require_ready()
        homes = {name: axis.config.home_um for name, axis in self._axes.items()}
        for name, home_um in homes.items():
            if home_um is None:
                raise MotorError("no_home", f"axis {name}: home_mm is not in the configuration")
        self._begin()
        self._setpoints_um = {name: um for name, um in homes.items() if um is not None}
        for name, home_um in self._setpoints_um.items():
            axis = self._axes[name]
            self._motion[name] = self._line_of(axis).start(axis.home(home_um), f"home of {name}")

    def park(self) -> None:
        self._require_ready()
        for name, axis in self._axes.items():
            self._other[name] = self._line_of(axis).start(axis.park(), f"parking of {name}")

    def run_steps(self, name: str, steps: int) -> None:
        """Begin an open-loop run of waveform steps, forward positive, of one axis (calibration).

        For an engineer at the controller: the bridge never calls it, it moves in setpoints alone.
        Raises MotorError if the run could leave the travel even with steps twice as long as set.
        """
        self._require_ready()
        axis = self._axis(name)
        _check_run(axis, steps)
        self._begin()
        self._setpoints_um = {}
        procedure = axis.run_steps(steps)
        self._motion[name] = self._line_of(axis).start(procedure, f"run of {name}")

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
                raise MotorError("bad_position", f"axis {name}: {position_um!r} um is no integer")
        self._begin()
        deadline_s = self._clock() + DECLARE_DEADLINE_S
        for name, axis in axes.items():
            self._run(axis, axis.declare(positions_um[name]), "declaration", deadline_s)

    def _begin(self) -> None:
        """Give up refreshing and parking (the next procedure finds out how far that came)."""
        for line in self._lines.values():
            line.cancel_all()
        self._motion, self._other = {}, {}
        self._fault, self._reached = None, False

    def _require_ready(self) -> None:
        if not self._initialised:
            raise MotorError("not_open", "the controllers are not initialised")
        if self._motion:
            raise MotorError("moving", "a motion is under way")
        for axis in self._axes.values():
            if axis.fault is not None:
                raise MotorError(*axis.fault)

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
                self._fail("port_failed", f"controller port: {error}")
        return self._status()

    def _carry_on(self) -> None:
        if not self._motion and not self._other:
            for name, axis in self._axes.items():
                task = self._line_of(axis).start(axis.refresh(), f"status of {name}")
                self._other[name] = task
        share_s = POLL_BUDGET_S / len(self._lines)
        for line in self._lines.values():
            line.step(share_s)
        failed_at_rest = self._collect(self._other)
        failed = self._collect(self._motion)
        if failed_at_rest and failed_at_rest[0] in NEEDS_STOP:
            failed = failed_at_rest
        if failed:
            self._fail(*failed)
        elif self._motion and all(task.done for task in self._motion.values()):
            self._motion = {}
            self._reached = self._all_reached()

    def _collect(self, tasks: dict[str, Task]) -> tuple[str, str] | None:
        """Note the errors of tasks that ended; a motion stays listed until all axes ended."""
        failed = None
        for name, task in list(tasks.items()):
            if not task.done:
                continue
            if task.error is not None:
                axis = self._axes[name]
                axis.fault = failed = _code_and_text(axis, task.error)
                if isinstance(task.error, PmdEchoError):
                    axis.certain = False
                log.warning("%s", axis.fault[1])
            if tasks is self._other:
                del tasks[name]
        return failed

    def _fail(self, code: str, text: str) -> None:
        """A fault ends the motion of all axes; the confirmation follows with the next polls."""
        self._fault, self._reached = (code, text), False
        self._motion, self._other = {}, {}
        for url, addresses in self._addresses().items():
            try:
                self._lines[url].write_now(pmd_protocol.emergency_stop_bytes(addresses))
            except OSError as error:
                log.error("controller port %s: stop not sent: %s", url, error)
        for name, axis in self._axes.items():
            task = self._line_of(axis).start(axis.confirm_stop(), f"stop of {name}")
            self._other[name] = task

    def _all_reached(self) -> bool:
        return all(
            abs(self._axes[name].readback_um() - setpoint_um)
            <= self._axes[name].config.tolerance_um
            for name, setpoint_um in self._setpoints_um.items()
        )

    def _status(self) -> MotorStatus:
        fault = self._fault or next((a.fault for a in self._axes.values() if a.fault), None)
        return MotorStatus(
            moving=bool(self._motion),
            reached=self._reached,
            readback_um={name: axis.readback_um() for name, axis in self._axes.items()},
            certain=self._initialised and all(axis.certain for axis in self._axes.values()),
            parked=all(axis.parked for axis in self._axes.values()),
            fault=fault[0] if fault else None,
            fault_text=fault[1] if fault else "",
            warnings=(UNTRIED, *self._park_warnings()),
        )

    def _park_warnings(self) -> list[str]:
        return [
            f"axis {name}: parking moved it by {axis.park_shift_um:+.0f} um"
            for name, axis in self._axes.items()
            if axis.park_shift_um is not None and abs(axis.park_shift_um) > axis.config.tolerance_um
        ]

    # Stopping

    def stop(self) -> None:
        """First the bytes that stop everything, to all buses; then each axis has to confirm."""
        failures = [] if self._lines else self._connect_for_stop()
        self._motion, self._other, self._fault, self._reached = {}, {}, None, False
        for url, addresses in self._addresses().items():
            if url not in self._lines:
                continue
            try:
                self._lines[url].write_now(pmd_protocol.emergency_stop_bytes(addresses))
            except OSError as error:
                failures.append(f"{url}: {error}")
        failures += self._confirm_stops()
        if failures:
            raise MotorError("stop_unconfirmed", "; ".join(failures))

    def _connect_for_stop(self) -> list[str]:
        try:
            self._connect()
        except MotorError as error:
            return [error.text]
        return []

    def _confirm_stops(self) -> list[str]:
        deadline_s = self._clock() + STOP_DEADLINE_S
        lines = list(self._lines.values())
        for line in lines:
            line.timeout_s = min(self._timeout_s, STOP_ANSWER_TIMEOUT_S)
        tasks = {
            name: self._line_of(axis).start(self._stop_stubbornly(axis), f"stop of {name}")
            for name, axis in self._axes.items()
            if axis.config.controller in self._lines
        }
        failures: set[str] = set()
        while not all(t.done for t in tasks.values()) and self._clock() < deadline_s:
            for line in lines:
                try:
                    line.step(0.01)
                except OSError as error:
                    line.cancel_all()
                    failures.add(f"controller port: {error}")
        unconfirmed = [name for name, task in tasks.items() if not task.done or task.error]
        for line in lines:
            line.cancel_all()
            line.timeout_s = self._timeout_s
        return [*failures, *(f"axis {name} did not confirm the stop" for name in unconfirmed)]

    def _stop_stubbornly(self, axis: PmdAxis) -> Procedure:
        """Lost answers do not end it; the caller's deadline does."""
        while True:
            try:
                yield from axis.confirm_stop()
            except PmdTimeoutError:
                continue
            return


def _check_setpoint(axis: AxisConfig, setpoint_um: int) -> None:
    if not isinstance(setpoint_um, int) or (
        not axis.travel_min_um <= setpoint_um <= axis.travel_max_um
    ):
        raise MotorError(
            "beyond_travel",
            f"axis {axis.name}: setpoint {setpoint_um!r} um is outside "
            f"{axis.travel_min_um}..{axis.travel_max_um} um",
        )


def _check_run(axis: PmdAxis, steps: int) -> None:
    """An open-loop axis whose position nobody declared has none to check: the engineer looks."""
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


def _code_and_text(axis: PmdAxis, error: PmdError) -> tuple[str, str]:
    if isinstance(error, AxisFaultError):
        return error.code, str(error)
    code = next((c for kind, c in _CODES.items() if isinstance(error, kind)), "protocol")
    return code, f"axis {axis.config.name}: {error}"


_CODES: dict[type[PmdError], str] = {
    PmdTimeoutError: "no_answer",
    PmdEchoError: "damaged_command",
}
