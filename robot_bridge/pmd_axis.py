"""One motor on a PMD401/PMD301: what is known of it, and its procedures (see pmd_line).

Closed loop: absolute targets in encoder counts (`T`), which may be sent twice. Open loop: relative
runs in microsteps (`J`), which may not; the position is then what the host has counted. After
every motion the controller is told to leave target mode, so that nothing regulates during imaging.
"""

import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import TypeVar

from robot_bridge import pmd_protocol, pmd_units
from robot_bridge.config import AxisConfig
from robot_bridge.pmd_line import Pause, Procedure
from robot_bridge.pmd_protocol import (
    MICROSTEPS_PER_STEP,
    Command,
    PmdError,
    PmdRefusedError,
    PmdReplyError,
    PmdTimeoutError,
    Reply,
)
from robot_bridge.pmd_status import ERRORS, Status, names, parse_drive, parse_status, parse_supply

T = TypeVar("T")
Steps = Generator[Command | Pause, Reply | None, T]

MODELS = {"PMD401": 1500, "PMD301": 2500}  # highest drive frequency, Hz
POWER_CHANGE_DEADLINE_S = 1.5
# The controller's state settles some milliseconds after a command (25 ms in public drivers).
SETTLE_S = 0.025
POLL_PAUSE_S = 0.01
MIN_SPEED_HZ = 10
RAMP_DOWN_HZ_PER_MS = 10
AVOID_OVERSHOOT = 3
NO_ENCODER = 0
STALL_WINDOW_S = 0.5
RUNAWAY_MARGIN_UM = 100.0
# The response delay (Y44) returns to 20 us at every power-on and is not kept in flash: other
# values tell that the controller has not lost its supply since we wrote them.
POWER_ON_DELAY_US, INITIALISED_DELAY_US, DECLARED_DELAY_US = 20, 21, 22


class AxisFaultError(PmdError):
    """A motion failed, or the controller reported an error."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass
class _Run:
    """An open-loop run under way."""

    from_um: float
    microsteps: int
    speed_hz: int
    begun_s: float

    @property
    def duration_s(self) -> float:
        return abs(self.microsteps) / MICROSTEPS_PER_STEP / self.speed_hz


class PmdAxis:
    def __init__(self, config: AxisConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self.config = config
        self._clock = clock
        self.status = Status(0)
        self.certain = False
        self.position_um = 0.0
        self.speed_cap_hz = 1
        self.identity = ""
        self.fault: tuple[str, str] | None = None  # lasts as long as its cause
        self.park_shift_um: float | None = None
        self._run: _Run | None = None
        self._at_rest_um: float | None = None
        self._expected_parked: bool | None = None
        # One wrong bit makes `T0` (go to zero) of `U0`, but a harmless question of a bare `U`.
        self._status_body = "U"

    @property
    def address(self) -> int:
        return self.config.address

    @property
    def closed_loop(self) -> bool:
        return self.config.drive == "closed_loop"

    @property
    def parked(self) -> bool:
        return bool(self.status & Status.PARKED)

    @property
    def speed_hz(self) -> int:
        return max(1, min(self.config.speed_hz, self.speed_cap_hz))

    def readback_um(self) -> int:
        """Closed loop: the encoder's; open loop: what was counted, interpolated during a run."""
        if self._run is not None:
            return round(self._estimate_um(self._run))
        return round(self.position_um)

    def _named(self, text: str) -> str:
        return f"axis {self.config.name} (controller {self.address}): {text}"

    def _error(self, code: str, text: str) -> AxisFaultError:
        return AxisFaultError(code, self._named(text))

    # Reading

    def _ask(self, name: str) -> Steps[Reply]:
        reply = yield pmd_protocol.read(self.address, name)
        assert reply is not None  # the line answers every command
        return reply

    def _set_all(self, values: Mapping[int, int]) -> Steps[None]:
        """Write settings, and believe the readback alone.

        Read only when all are written: a damaged command may have changed another one.
        """
        for number, value in values.items():
            yield pmd_protocol.set_parameter(self.address, number, value)
        for number, value in values.items():
            got = (yield from self._ask(f"Y{number}")).integer()
            if got != value:
                raise self._error("setting", f"Y{number} reads {got} after it was set to {value}")

    def _read_status(self) -> Steps[Status]:
        reply = yield from self._ask(self._status_body)
        self.status = parse_status(reply.value)
        if reply.retried and (yield from self._ask("Y44")).integer() == POWER_ON_DELAY_US:
            self.status |= Status.RESET  # the answer that told it was lost
        return self.status

    def _read_position(self) -> Steps[None]:
        if self.closed_loop:
            count = (yield from self._ask("E")).integer()
            self.position_um = pmd_units.um_from_count(self.config, count)

    def _read_position_surely(self) -> Steps[None]:
        """The line has no checksum: two readings that agree, or the third decides."""
        yield from self._read_position()
        first_um = self.position_um
        yield from self._read_position()
        if abs(self.position_um - first_um) > self._arrival_um:
            yield from self._read_position()

    def _check_status(self) -> Steps[None]:
        """Raise AxisFaultError for whatever the status says is wrong."""
        status = self.status
        if status & Status.RESET or (self.parked and self._expected_parked is False):
            self.certain = False
            self._expected_parked = None
            raise self._error("controller_reset", "the controller restarted; position uncertain")
        if status & Status.OVERHEAT:
            raise self._error("overheat", "the controller reports overheating")
        if status & Status.VOLTAGE_ERROR:
            supply = parse_supply((yield from self._ask("U2")).value)
            raise self._error(
                "voltage",
                f"supply or motor fault: 48 V reads {supply.volts_48} V, "
                f"motor test {supply.motor_test}",
            )
        if status & ERRORS:
            raise self._error("controller_error", names(status & ERRORS))
        if status & Status.EXTERNAL_LIMIT:
            raise self._error("external_limit", "a limit switch stopped the motor")

    def refresh(self) -> Procedure:
        """Status and position while nothing of ours moves."""
        yield from self._read_status()
        yield from self._read_position()
        yield from self._check_status()
        self._note_drift()
        self.fault = None

    def _note_drift(self) -> None:
        if self.status & (Status.RUNNING | Status.TARGET_MODE):
            self.certain = False
            raise self._error("moving_by_itself", "the controller moves without a command")
        moved_um = 0.0 if self._at_rest_um is None else self.position_um - self._at_rest_um
        if abs(moved_um) > self.config.tolerance_um:
            self.certain = False
            self._at_rest_um = self.position_um
            raise self._error("moved_by_itself", f"moved {moved_um:+.0f} um without a command")

    # Setting up

    def initialise(self) -> Procedure:
        """Identify, stop, set limits and speeds (memory, not flash). Nothing moves."""
        self.identity = (yield from self._ask("?")).value
        model = self.identity.partition(" ")[0]
        if model not in MODELS:
            raise self._error("unknown_controller", f"identifies as '{self.identity}'")
        yield pmd_protocol.stop(self.address)
        first = yield from self._first_status()
        yield from self._read_status()  # what was latched is cleared now
        mark = (yield from self._ask("Y44")).integer()
        declared = mark == DECLARED_DELAY_US and not first & Status.RESET
        yield from self._apply_settings(MODELS[model])
        yield from self._read_position()
        self.certain = declared and self.closed_loop
        if not self.certain:
            yield from self._set_all({44: INITIALISED_DELAY_US})
        self._expected_parked = self.parked
        self._at_rest_um = self.position_um
        yield from self._check_status()

    def _first_status(self) -> Steps[Status]:
        """Find out which form of the question the controller understands."""
        self._status_body = "U"
        try:
            return (yield from self._read_status())
        except PmdError:
            self._status_body = "U0"
        return (yield from self._read_status())

    def _apply_settings(self, model_max_hz: int) -> Steps[None]:
        if self.closed_loop:
            low, high = pmd_units.count_limits(self.config)
            yield from self._set_all(
                {
                    13: self.config.encoder_type,
                    3: low,
                    4: high,
                    5: self.config.tolerance_counts,
                    7: MIN_SPEED_HZ,
                    10: RAMP_DOWN_HZ_PER_MS,
                    11: pmd_units.speed_parameter(self.config),
                    12: AVOID_OVERSHOOT,
                }
            )
        else:
            # No encoder, at count 0 between limits at 0: no target command, meant or made of
            # another one by a wrong bit, can move the motor.
            yield from self._set_all({13: NO_ENCODER})
            yield Command(self.address, "E0", reads=False)
            yield from self._set_all({3: 0, 4: 0})
        yield from self._read_speed_cap(model_max_hz)

    def _read_speed_cap(self, model_max_hz: int) -> Steps[None]:
        drive = parse_drive((yield from self._ask("U3")).value)
        self.speed_cap_hz = min(model_max_hz, drive.max_frequency_hz)

    # Power

    def unpark(self) -> Steps[None]:
        yield from self._read_status()
        yield from self._check_status()
        if self.parked:
            yield pmd_protocol.unpark(self.address)
            yield from self._await_parked(False)
            # The controller measures the motor's capacitance while it unparks.
            yield from self._read_speed_cap(MODELS[self.identity.partition(" ")[0]])
        self._expected_parked = False

    def park(self) -> Procedure:
        """Leave target mode first: a regulated target would move the motor at the next unpark."""
        yield pmd_protocol.stop(self.address)
        yield from self._read_position()
        before_um = self.position_um
        self._expected_parked = None
        yield pmd_protocol.park(self.address)
        yield from self._await_parked(True)
        yield from self._read_position()
        self._expected_parked = True
        self._at_rest_um = self.position_um
        self.park_shift_um = self.position_um - before_um if self.closed_loop else None

    def _await_parked(self, parked: bool) -> Steps[None]:
        deadline_s = self._clock() + POWER_CHANGE_DEADLINE_S
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self._read_status()
            if bool(status & Status.PARKED) == parked:
                return
            if status & (Status.RESET | Status.VOLTAGE_ERROR | Status.OVERHEAT):
                yield from self._check_status()
            if self._clock() > deadline_s:
                wanted = "parked" if parked else "unparked"
                raise self._error("power", f"not {wanted} after {POWER_CHANGE_DEADLINE_S} s")

    # Moving

    def move(self, setpoint_um: int, park_afterwards: bool) -> Procedure:
        self.fault = None
        try:
            yield from self.unpark()
            yield from self._read_position()
            self._note_drift()
            for leg_um in pmd_units.legs_um(self.config, self.position_um, setpoint_um):
                if self.closed_loop:
                    yield from self._closed_leg(leg_um)
                else:
                    yield from self._open_leg(leg_um)
            self._at_rest_um = self.position_um
            if park_afterwards:
                yield from self.park()
        except PmdRefusedError as error:
            raise self._error("refused", str(error)) from error

    def _closed_leg(self, setpoint_um: int) -> Steps[None]:
        self._at_rest_um = None
        target = pmd_units.count_from_um(self.config, setpoint_um)
        go = pmd_protocol.move_to_count(self.address, target, self.speed_hz)
        yield pmd_protocol.store(go)
        yield pmd_protocol.run_stored(go)
        watch = _ProgressWatch(self, abs(setpoint_um - self.position_um), self._clock())
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self._read_status()
            yield from self._read_position()
            yield from self._check_status()
            error_um = abs(self.position_um - setpoint_um)
            arrived = Status.TARGET_MODE | Status.TARGET_REACHED
            if status & arrived == arrived and error_um <= self._arrival_um:
                break
            if status & Status.TARGET_LIMIT:
                raise self._error("target_limit", f"stopped at a limit, {error_um:.0f} um short")
            if not status & Status.TARGET_MODE:
                raise self._error("stopped", f"left target mode {error_um:.0f} um short")
            watch.check(error_um, self._clock())
        yield pmd_protocol.stop(self.address)
        yield pmd_protocol.overwrite_stored(self.address)
        yield from self._read_position_surely()

    @property
    def _arrival_um(self) -> float:
        counts_um = (self.config.tolerance_counts + 1) * pmd_units.um_per_count(self.config)
        return max(counts_um, float(self.config.tolerance_um))

    def _open_leg(self, setpoint_um: float) -> Steps[None]:
        microsteps = pmd_units.microsteps_from_um(self.config, setpoint_um - self.position_um)
        if microsteps == 0:
            return
        yield from self.run_open_loop(microsteps)

    def run_open_loop(self, microsteps: int) -> Steps[None]:
        """One relative run, counted by the host. If it cannot be accounted for, say uncertain."""
        phase = yield from self._microstep_phase()
        expected_phase = (phase + microsteps) % MICROSTEPS_PER_STEP
        run = _Run(self.position_um, microsteps, self.speed_hz, self._clock())
        self._run = run
        try:
            yield from self._begin_run(run, phase, expected_phase)
            yield from self._await_run_end(run)
            ended_at = yield from self._microstep_phase()
            if ended_at != expected_phase:
                raise self._error(
                    "run_incomplete",
                    f"microstep counter reads {ended_at}, expected {expected_phase}",
                )
            self.position_um = run.from_um + pmd_units.um_from_microsteps(self.config, microsteps)
            self._run = None
            yield pmd_protocol.overwrite_stored(self.address)
        finally:
            if self._run is not None:  # stopped, failed or given up
                self.position_um = self._estimate_um(run)
                self.certain = False
                self._run = None

    def run_steps(self, steps: int) -> Procedure:
        """A run of whole waveform steps whatever they amount to; the encoder, if any, tells."""
        self.fault = None
        yield from self.unpark()
        yield from self.run_open_loop(steps * MICROSTEPS_PER_STEP)
        yield from self._read_position()
        self._at_rest_um = self.position_um

    def measure(self) -> Procedure:
        yield from self._read_position_surely()

    def _begin_run(self, run: _Run, phase: int, expected_phase: int) -> Steps[None]:
        """Start the run once. If that answer is lost, find out; never start it again.

        Even a microstep counter that did not change is no proof that nothing moved (a unit may
        count otherwise than the manual says), so only a proof of motion lets us go on.
        """
        go = pmd_protocol.run_microsteps(self.address, run.microsteps, run.speed_hz)
        yield pmd_protocol.store(go)
        try:
            yield pmd_protocol.run_stored(go)
        except PmdTimeoutError:
            status = yield from self._read_status()
            now_at = yield from self._microstep_phase()
            finished = now_at == expected_phase != phase
            if not (status & Status.RUNNING or finished):
                raise self._error(
                    "run_unconfirmed", "the answer to a run was lost; position uncertain"
                ) from None

    def _await_run_end(self, run: _Run) -> Steps[None]:
        deadline_s = run.begun_s + 1.5 * run.duration_s + 2.0
        yield Pause(SETTLE_S)
        while True:
            status = yield from self._read_status()
            yield from self._check_status()
            # `J` reads 0 after a run; during one it reads 1 or +-222, depending on the unit.
            if not status & Status.RUNNING and (yield from self._ask("J")).integer() == 0:
                return
            if self._clock() > deadline_s:
                raise self._error("motion_timeout", f"runs longer than {run.duration_s:.1f} s")
            yield Pause(POLL_PAUSE_S)

    def _microstep_phase(self) -> Steps[int]:
        values = (yield from self._ask("Y0")).integers()
        if len(values) != 2 or not 0 <= values[1] < MICROSTEPS_PER_STEP:
            raise PmdReplyError(self._named(f"microstep counter reads {values}"))
        return values[1]

    def _estimate_um(self, run: _Run) -> float:
        part = min(1.0, (self._clock() - run.begun_s) / max(run.duration_s, 1e-6))
        return run.from_um + part * pmd_units.um_from_microsteps(self.config, run.microsteps)

    # Reference

    def home(self, home_um: int) -> Procedure:
        """Run against the hard stop nearest to `home_um`, and call that place `home_um`."""
        self.fault = None
        yield from self.unpark()
        self.certain = False
        travel_um = self.config.travel_max_um - self.config.travel_min_um
        to_low_end = home_um - self.config.travel_min_um <= self.config.travel_max_um - home_um
        distance_um = (-1.2 if to_low_end else 1.2) * travel_um
        yield from self.run_open_loop(pmd_units.microsteps_from_um(self.config, distance_um))
        yield from self.declare(home_um)

    def declare(self, position_um: int) -> Procedure:
        """The axis stands at `position_um`. Out of target mode, or setting E would move it."""
        if self.closed_loop:
            yield pmd_protocol.stop(self.address)
            count = pmd_units.count_from_um(self.config, position_um)
            yield Command(self.address, f"E{count}", reads=False)
            yield from self._read_position()
            if abs(self.position_um - position_um) > self._arrival_um:
                raise self._error("setting", f"reads {self.position_um:.0f} um after E{count}")
            yield from self._set_all({44: DECLARED_DELAY_US})
        else:
            self.position_um = float(position_um)
        self._at_rest_um = self.position_um
        self.certain = True
        self.fault = None

    # Stopping

    def confirm_stop(self) -> Procedure:
        """Repeat S until the controller says that it stands and regulates nothing."""
        while True:
            yield pmd_protocol.stop(self.address)
            status = yield from self._read_status()
            if not status & (Status.RUNNING | Status.TARGET_MODE):
                break
        if status & Status.RESET:
            self.certain = False
        yield from self._read_position()
        self._at_rest_um = self.position_um
        if not status & (ERRORS | Status.RESET | Status.OVERHEAT | Status.EXTERNAL_LIMIT):
            self.fault = None


class _ProgressWatch:
    """Tells a motor that does not come nearer (stalled, encoder lost) or runs away."""

    def __init__(self, axis: PmdAxis, distance_um: float, now_s: float) -> None:
        self._axis = axis
        self._best_um = distance_um
        self._best_s = now_s
        self._bound_um = distance_um + RUNAWAY_MARGIN_UM
        count_um = pmd_units.um_per_count(axis.config)
        slowest_um_s = MIN_SPEED_HZ * axis.config.step_um_forward
        self._window_s = STALL_WINDOW_S + 3 * count_um / slowest_um_s

    def check(self, error_um: float, now_s: float) -> None:
        """Raises AxisFaultError."""
        if error_um < self._best_um:
            self._best_um, self._best_s = error_um, now_s
        if error_um > self._bound_um:
            raise self._axis._error("runaway", f"moves away, {error_um:.0f} um from the setpoint")
        if now_s - self._best_s > self._window_s:
            self._axis.certain = False
            raise self._axis._error("stalled", f"stands {error_um:.0f} um from the setpoint")
