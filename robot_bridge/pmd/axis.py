"""One motor on a PMD401/PMD301: its motions, as procedures (see pmd_line).

Closed loop: absolute targets in encoder counts (`T`), which may be sent twice. Open loop: relative
runs in microsteps (`J`), which may not; the position is then what the host has counted. After
every motion the controller is told to leave target mode, so that nothing regulates during imaging.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.controller import (
    DECLARED_MARK,
    MARK,
    MIN_SPEED_HZ,
    POLL_PAUSE_S,
    POWER_ON_DELAY_US,
    AxisFaultError,
    PmdController,
    Steps,
)
from robot_bridge.pmd.line import Pause, Procedure
from robot_bridge.pmd.protocol import (
    MICROSTEPS_PER_STEP,
    Command,
    PmdRefusedError,
    PmdReplyError,
    PmdTimeoutError,
)
from robot_bridge.pmd.status import ERRORS, Status

# The controller's state settles some milliseconds after a command (25 ms in public drivers).
SETTLE_S = 0.025
STALL_WINDOW_S = 0.5
RUNAWAY_MARGIN_UM = 100.0


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


class PmdAxis(PmdController):
    def __init__(
        self,
        config: AxisConfig,
        clock: Callable[[], float] = time.monotonic,
        *,
        response_delay_us: int = POWER_ON_DELAY_US,
    ) -> None:
        super().__init__(config, clock, response_delay_us=response_delay_us)
        self._run: _Run | None = None

    @property
    def speed_hz(self) -> int:
        return max(1, min(self.config.speed_hz, self.speed_cap_hz))

    def readback_um(self) -> int:
        """Closed loop: the encoder's; open loop: what was counted, interpolated during a run."""
        if self._run is not None:
            return round(self._estimate_um(self._run))
        return round(self.position_um)

    # Moving

    def move(self, setpoint_um: int, park_afterwards: bool) -> Procedure:
        self.fault = None
        try:
            yield from self.unpark()
            yield from self._read_position()
            self._check_rest()
            for leg_um in pmd_units.legs_um(self.config, self.position_um, setpoint_um):
                if self.closed_loop:
                    yield from self._closed_leg(leg_um)
                else:
                    yield from self._open_leg(leg_um)
            self._at_rest_um = self.position_um
            if park_afterwards:
                yield from self.park()
        except PmdRefusedError as error:
            raise self.error("refused", str(error)) from error

    def _check_moving(self) -> Steps[None]:
        """The limit bit tells of the last motion, so it is only looked at while ours lasts."""
        yield from self._check_status()
        if self.status & Status.EXTERNAL_LIMIT:
            raise self.error("external_limit", "a limit switch stopped the motor")

    def _closed_leg(self, setpoint_um: int) -> Steps[None]:
        self._at_rest_um = None
        target = pmd_units.count_from_um(self.config, setpoint_um)
        go = pmd_protocol.move_to_count(self.address, target, self.speed_hz)
        yield pmd_protocol.store(go)
        yield pmd_protocol.run_stored(go)
        told_near = False
        watch = _ProgressWatch(self, abs(setpoint_um - self.position_um), self._clock())
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self._read_status()
            yield from self._read_position()
            yield from self._check_moving()
            error_um = abs(self.position_um - setpoint_um)
            arrived = Status.TARGET_MODE | Status.TARGET_REACHED
            if status & arrived == arrived:
                # Merely near is believed when it is told twice: the line has no checksum.
                near = error_um <= self.config.tolerance_um
                if error_um <= self._jitter_um or (near and told_near):
                    break
                told_near = near
            if status & Status.TARGET_LIMIT:
                raise self.error("target_limit", f"stopped at a limit, {error_um:.0f} um short")
            if not status & Status.TARGET_MODE:
                raise self.error("stopped", f"left target mode {error_um:.0f} um short")
            watch.check(error_um, self._clock())
        yield pmd_protocol.stop(self.address)
        yield pmd_protocol.overwrite_stored(self.address)
        yield from self._read_position_surely()

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
                raise self.error(
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
                raise self.error(
                    "run_unconfirmed", "the answer to a run was lost; position uncertain"
                ) from None

    def _await_run_end(self, run: _Run) -> Steps[None]:
        deadline_s = run.begun_s + 1.5 * run.duration_s + 2.0
        yield Pause(SETTLE_S)
        while True:
            status = yield from self._read_status()
            yield from self._check_moving()
            # `J` reads 0 after a run; during one it reads 1 or +-222, depending on the unit.
            if not status & Status.RUNNING and (yield from self._ask("J")).integer() == 0:
                return
            if self._clock() > deadline_s:
                raise self.error("motion_timeout", f"runs longer than {run.duration_s:.1f} s")
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
        """Run to the hard stop (or limit switch) nearest to `home_um`; that place is `home_um`."""
        self.fault = None
        yield from self.unpark()
        self.certain = False
        travel_um = self.config.travel_max_um - self.config.travel_min_um
        to_low_end = home_um - self.config.travel_min_um <= self.config.travel_max_um - home_um
        distance_um = (-1.2 if to_low_end else 1.2) * travel_um
        try:
            yield from self.run_open_loop(pmd_units.microsteps_from_um(self.config, distance_um))
        except AxisFaultError as error:
            if error.code != "external_limit":  # a switch instead of the stop is as good
                raise
        yield pmd_protocol.stop(self.address)
        yield from self.declare(home_um)

    def declare(self, position_um: int) -> Procedure:
        """The axis stands at `position_um`. Out of target mode, or setting E would move it."""
        self.certain = False
        if self.closed_loop:
            yield pmd_protocol.stop(self.address)
            count = pmd_units.count_from_um(self.config, position_um)
            yield Command(self.address, f"E{count}", reads=False)
            yield from self._read_position()
            if abs(self.position_um - position_um) > self._jitter_um:
                raise self.error("setting", f"reads {self.position_um:.0f} um after E{count}")
            yield from self._set_all({MARK: DECLARED_MARK})
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
        if not status & (ERRORS | Status.RESET | Status.OVERHEAT):
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
            raise self._axis.error("runaway", f"moves away, {error_um:.0f} um from the setpoint")
        if now_s - self._best_s > self._window_s:
            self._axis.certain = False
            raise self._axis.error("stalled", f"stands {error_um:.0f} um from the setpoint")
