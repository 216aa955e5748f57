"""One motor on a PMD401/PMD301: its motions, as procedures (see pmd.line).

Closed loop: absolute targets in encoder counts (`T`), which may be sent twice. Open loop: relative
runs in microsteps (`J`), which may not; the position is then what the host has counted. After
every motion the controller is told to leave target mode, so that nothing regulates during imaging.
An axis that stands where it is asked to be is not commanded at all.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.controller import (
    DECLARED_MARK,
    POLL_PAUSE_S,
    POWER_ON_DELAY_US,
    PmdController,
    Steps,
)
from robot_bridge.pmd.line import Pause, Procedure
from robot_bridge.pmd.protocol import (
    MICROSTEPS_PER_STEP,
    Command,
    PmdNoValueError,
    PmdRefusedError,
    PmdReplyError,
    PmdTimeoutError,
)
from robot_bridge.pmd.setup import MIN_SPEED_HZ, initialise, verify
from robot_bridge.pmd.status import ERRORS, Status

# The controller's state settles some milliseconds after a command (25 ms in public drivers).
SETTLE_S = 0.025
# An encoder that shows no progress: far from the setpoint, where the motor runs fast, it is missed
# at once; near it the controller may well take its time.
STALL_WINDOW_S, FAR_WINDOW_S = 0.5, 0.15
FAR_TOLERANCES, LOOKS_MIN = 10, 4
STALE_S = 0.12
RUNAWAY_MARGIN_UM = 100.0
# Before its first way an encoder has to follow a short run in open loop.
PROOF_UM = 200.0
# Of the way that the steps should make: load and frequency change a step by a quarter, and a wrong
# scale is most often one of two.
FOLLOWS = 0.6


def agrees(moved_um: float, distance_um: float) -> bool:
    """Whether an encoder's way fits the way that the motor's steps should have made."""
    return FOLLOWS < moved_um / distance_um < 1 / FOLLOWS


def disagreement(moved_um: float, distance_um: float) -> str:
    return (
        f"the motor moved {distance_um:+.0f} um by its steps but {moved_um:+.0f} um by the "
        "encoder: the encoder, its direction, counts_per_mm or the step lengths are wrong"
    )


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


_ARRIVED = Status.TARGET_MODE | Status.TARGET_REACHED


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

    def stands_at(self, setpoint_um: float) -> bool:
        return abs(self.position_um - setpoint_um) <= self.config.tolerance_um

    def set_up(self) -> Procedure:
        """Raises PmdError; afterwards the settings are ours. Nothing moves."""
        yield from initialise(self)

    def move(self, setpoint_um: int, park_afterwards: bool) -> Procedure:
        self.fault = None
        try:
            yield from self.read_status()
            yield from self.check_status()
            yield from self.read_position()
            self.check_rest()
            if self.stands_at(setpoint_um):
                return
            yield from verify(self)
            yield from self.unpark()
            yield from self.read_position()
            self.check_rest()
            yield from self._prove(setpoint_um)
            for leg_um in pmd_units.legs_um(self.config, self.position_um, setpoint_um):
                if self.closed_loop:
                    yield from self._closed_leg(leg_um)
                else:
                    yield from self._open_leg(leg_um)
            self.at_rest_um = self.position_um
            if park_afterwards:
                yield from self.park()
        except PmdRefusedError as error:
            raise self.error("refused", str(error)) from error

    def _prove(self, setpoint_um: int) -> Steps[None]:
        """The encoder has to follow the motor once over a short way, before it is believed."""
        if self.proven or not self.closed_loop:
            return
        if (yield from self._microstep_phase()) is None:
            return  # nothing would tell how far the motor went, so the encoder cannot be blamed
        from_um = self.position_um
        towards = 1 if setpoint_um > from_um else -1
        end_um = self.config.travel_max_um if towards > 0 else self.config.travel_min_um
        if abs(end_um - from_um) < 2 * PROOF_UM:
            towards = -towards
        run_um = towards * PROOF_UM
        try:
            yield from self.run_open_loop(pmd_units.microsteps_from_um(self.config, run_um))
            yield from self.read_position_surely()
            self.at_rest_um = self.position_um
            moved_um = self.position_um - from_um
            if abs(run_um) > 4 * self.jitter_um and not agrees(moved_um, run_um):
                raise self.error("encoder_disagrees", disagreement(moved_um, run_um))
            self.proven = True
        finally:
            if not self.proven:  # refuted, or stopped before it was known
                self.certain = False

    def _check_moving(self) -> Steps[None]:
        """The limit bit tells of the last motion, so it is only looked at while ours lasts."""
        yield from self.check_status()
        if self.status & Status.EXTERNAL_LIMIT:
            self.certain = (
                False  # the travel ends before the switches: the axis is not where it reads
            )
            raise self.error("external_limit", "a limit switch stopped the motor")

    def _go(self, command: Command) -> Steps[None]:
        """A motion in two steps where the board can do it: what was damaged is never run."""
        if not self.can_store:
            yield command
            return
        yield pmd_protocol.store(command)
        yield pmd_protocol.run_stored(command)

    def _forget_stored(self) -> Steps[None]:
        if self.can_store:
            yield pmd_protocol.overwrite_stored(self.address)

    def _closed_leg(self, setpoint_um: int) -> Steps[None]:
        self.at_rest_um = None
        target = pmd_units.count_from_um(self.config, setpoint_um)
        try:
            yield from self._go(pmd_protocol.move_to_count(self.address, target, self.speed_hz))
        except PmdNoValueError:  # no echo: what it does is seen below, and a target is absolute
            self.doubts["T"] = "the echo does not confirm the motion"
        watch = _ProgressWatch(self, abs(setpoint_um - self.position_um), self.clock())
        try:
            yield from self._follow(setpoint_um, watch)
        except GeneratorExit:  # stopped on the way
            if watch.is_stale(self.clock()):
                self.certain = False  # its encoder may just have died
            raise
        yield from self._leave_target_mode()
        yield from self._forget_stored()
        yield from self.read_position_surely()

    def _follow(self, setpoint_um: int, watch: "_ProgressWatch") -> Steps[None]:
        """Until it has arrived. Raises AxisFaultError."""
        told_near = False
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self.read_status()
            yield from self.read_position()
            yield from self._check_moving()
            error_um = abs(self.position_um - setpoint_um)
            if status & _ARRIVED == _ARRIVED:
                # Merely near is believed when it is told twice: the line has no checksum.
                near = error_um <= self.config.tolerance_um
                if error_um <= self.jitter_um or (near and told_near):
                    return
                told_near = near
            if status & Status.TARGET_LIMIT:
                raise self.error("target_limit", f"stopped at a limit, {error_um:.0f} um short")
            if not status & (Status.TARGET_MODE | Status.RUNNING):
                if "T" in self.doubts and error_um <= self.jitter_um:
                    return  # a board that knows no target mode
                raise self.error("stopped", f"left target mode {error_um:.0f} um short")
            if watch.is_away(error_um):  # a count that was reset in between looks the same
                yield from self.read_status()
                yield from self.check_status()
            watch.check(error_um, self.clock())

    def _leave_target_mode(self) -> Steps[None]:
        try:
            yield pmd_protocol.stop(self.address)
        except PmdNoValueError:
            if "S" not in self.doubts:
                raise

    def _open_leg(self, setpoint_um: float) -> Steps[None]:
        microsteps = pmd_units.microsteps_from_um(self.config, setpoint_um - self.position_um)
        if microsteps == 0:
            return
        yield from self.run_open_loop(microsteps)

    def run_open_loop(self, microsteps: int) -> Steps[None]:
        """One relative run, counted by the host. If it cannot be accounted for, say uncertain."""
        go = pmd_protocol.run_microsteps(self.address, microsteps, self.speed_hz)
        yield from self._run_counted(go, microsteps)

    def run_to_index(self, microsteps: int) -> Steps[None]:
        """Until the index is passed, or the run ends; it may end anywhere."""
        go = pmd_protocol.run_to_index(self.address, microsteps, self.speed_hz)
        yield from self._run_counted(go, microsteps, anywhere=True)

    def _run_counted(self, go: Command, microsteps: int, *, anywhere: bool = False) -> Steps[None]:
        phase = yield from self._microstep_phase()
        expected = None if phase is None else (phase + microsteps) % MICROSTEPS_PER_STEP
        run = _Run(self.position_um, microsteps, self.speed_hz, self.clock())
        self._run = run
        self.at_rest_um = None
        try:
            yield from self._begin_run(go, phase, expected)
            yield from self._await_run_end(run)
            ended_at = yield from self._microstep_phase()
            if ended_at != expected and not anywhere:
                raise self.error(
                    "run_incomplete", f"microstep counter reads {ended_at}, expected {expected}"
                )
            self.position_um = run.from_um + pmd_units.um_from_microsteps(self.config, microsteps)
            self._run = None
            yield from self._forget_stored()
        finally:
            if self._run is not None:  # stopped, failed or given up
                if not self.closed_loop:
                    self.position_um = self._estimate_um(run)
                    self.certain = False
                self._run = None

    def run_steps(self, steps: int) -> Procedure:
        """A run of whole waveform steps whatever they amount to; the encoder, if any, tells."""
        self.fault = None
        yield from verify(self)
        yield from self.unpark()
        yield from self.run_open_loop(steps * MICROSTEPS_PER_STEP)
        yield from self.read_position()
        self.at_rest_um = self.position_um

    def measure(self) -> Procedure:
        yield from self.read_position_surely()

    def _begin_run(self, go: Command, phase: int | None, expected: int | None) -> Steps[None]:
        """Start the run once. If that answer is lost, find out; never start it again.

        Even a microstep counter that did not change is no proof that nothing moved (a unit may
        count otherwise than the manual says), so only a proof of motion lets us go on.
        """
        try:
            yield from self._go(go)
        except PmdTimeoutError:
            status = yield from self.read_status()
            now_at = yield from self._microstep_phase()
            finished = now_at is not None and now_at == expected != phase
            if not (status & Status.RUNNING or finished):
                raise self.error(
                    "run_unconfirmed", "the answer to a run was lost; position uncertain"
                ) from None

    def _await_run_end(self, run: _Run) -> Steps[None]:
        deadline_s = run.begun_s + 1.5 * run.duration_s + 2.0
        yield Pause(SETTLE_S)
        while True:
            status = yield from self.read_status()
            yield from self._check_moving()
            # `J` reads 0 after a run; during one it reads 1 or +-222, depending on the unit.
            if not status & Status.RUNNING and (yield from self.ask("J")).integer() == 0:
                return
            if self.clock() > deadline_s:
                raise self.error("motion_timeout", f"still running after {run.duration_s:.1f} s")
            yield Pause(POLL_PAUSE_S)

    def _microstep_phase(self) -> Steps[int | None]:
        """None if the board does not tell; the end of a run is then known by its status alone."""
        reply = yield from self.ask_if_it_can(
            "Y0", "the length of a run cannot be checked afterwards"
        )
        if reply is None:
            return None
        values = reply.integers()
        if len(values) != 2 or not 0 <= values[1] < MICROSTEPS_PER_STEP:
            raise PmdReplyError(self.named(f"microstep counter reads {values}"))
        return values[1]

    def _estimate_um(self, run: _Run) -> float:
        part = min(1.0, (self.clock() - run.begun_s) / max(run.duration_s, 1e-6))
        return run.from_um + part * pmd_units.um_from_microsteps(self.config, run.microsteps)

    # Reference

    def declare(self, position_um: int) -> Procedure:
        """The axis stands at `position_um`. Out of target mode, or setting E would move it."""
        self.certain = False
        if self.needs_setup:
            yield from initialise(self)
            self.certain = False
        if self.closed_loop:
            yield from self._leave_target_mode()
            yield from self.declare_count(pmd_units.count_from_um(self.config, position_um))
            return
        self.position_um = float(position_um)
        self._declared()

    def declare_count(self, count: int) -> Steps[None]:
        wanted_um = pmd_units.um_from_count(self.config, count)
        yield from self.read_position()
        if self.position_um != wanted_um:
            yield Command(self.address, f"E{count}", reads=False)
            yield from self.read_position()
        if abs(self.position_um - wanted_um) > self.jitter_um:
            raise self.error("setting", f"reads {self.position_um:.0f} um after E{count}")
        yield from self.set_mark(DECLARED_MARK)
        self._declared()

    def _declared(self) -> None:
        self.at_rest_um = self.position_um
        self.certain = True
        self.fault = None

    # Stopping

    def confirm_stop(self) -> Procedure:
        """Ask, and repeat S, until the controller says that it stands and regulates nothing."""
        while True:
            status = yield from self.read_status()
            if not status & (Status.RUNNING | Status.TARGET_MODE):
                break
            yield pmd_protocol.stop(self.address)
        if not status & (ERRORS | Status.RESET | Status.OVERHEAT) and not self.needs_setup:
            self.fault = None


class _ProgressWatch:
    """Tells a motor that does not come nearer (stalled, encoder lost) or runs away."""

    def __init__(self, axis: PmdAxis, distance_um: float, now_s: float) -> None:
        self._axis = axis
        self._best_um = distance_um
        self._best_s = now_s
        self._looks = 0
        self._bound_um = distance_um + RUNAWAY_MARGIN_UM
        count_um = pmd_units.um_per_count(axis.config)
        slowest_um_s = MIN_SPEED_HZ * axis.config.step_um_forward
        self._resolution_s = 3 * count_um / slowest_um_s
        self._far_um = FAR_TOLERANCES * axis.config.tolerance_um

    def is_stale(self, now_s: float) -> bool:
        return now_s - self._best_s > STALE_S

    def is_away(self, error_um: float) -> bool:
        return error_um > self._bound_um

    def check(self, error_um: float, now_s: float) -> None:
        """Raises AxisFaultError."""
        self._looks += 1
        if error_um < self._best_um:
            self._best_um, self._best_s, self._looks = error_um, now_s, 0
        if self.is_away(error_um):
            self._axis.certain = False
            raise self._axis.error(
                "runaway", f"is moving away, {error_um:.0f} um from the setpoint"
            )
        far = error_um > self._far_um and self._looks >= LOOKS_MIN
        window_s = (FAR_WINDOW_S if far else STALL_WINDOW_S) + self._resolution_s
        if now_s - self._best_s > window_s:
            self._axis.certain = False
            raise self._axis.error("stalled", f"stalled {error_um:.0f} um from the setpoint")
