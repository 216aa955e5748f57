"""One motor on a PMD401/PMD301: its motions, as procedures (see pmd.line).

Closed loop: absolute targets in encoder counts (`T`), which may be sent twice. Open loop: relative
runs in microsteps (`J`), which may not; the position is then what the host has counted. After
every motion the controller is told to leave target mode, so that nothing regulates during imaging.
An axis that stands where it is asked to be is not commanded at all.
"""

import time
from collections.abc import Callable
from dataclasses import replace

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
from robot_bridge.pmd.progress import CutLeg, ProgressWatch, agrees, disagreement
from robot_bridge.pmd.protocol import (
    MICROSTEPS_PER_STEP,
    Command,
    PmdError,
    PmdNoValueError,
    PmdRefusedError,
    PmdReplyError,
    PmdTimeoutError,
)
from robot_bridge.pmd.runs import SETTLE_S, Pace, Run
from robot_bridge.pmd.setup import initialise, verify
from robot_bridge.pmd.status import ERRORS, Status

# Before its first way an encoder has to follow a short run in open loop.
PROOF_UM = 200.0

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
        self._run: Run | None = None
        self._cut: Run | None = None  # a run that did not come to its end
        self._pace = Pace()
        self._holds_motion = False  # a motion is stored on the board
        self._begun_s = 0.0  # when what moves it was sent
        self.unread = False  # it was stopped on its way, and nobody has asked yet where it stands
        self._cut_leg: CutLeg | None = None
        self.within_um: float | None = None  # after a run that was cut short: of its readback

    @property
    def speed_hz(self) -> int:
        return max(1, min(self.config.speed_hz, self.speed_cap_hz))

    def readback_um(self) -> int:
        """Closed loop: the encoder's; open loop: what was counted, interpolated during a run."""
        if self._run is not None:
            return round(self._estimate_um(self._run))
        return round(self.position_um)

    # Moving

    def read_status(self) -> Steps[Status]:
        asked_s = self.clock()
        status = yield from super().read_status()
        if self._cut_leg is not None and not status & (Status.RUNNING | Status.TARGET_MODE):
            self._cut_leg.stood_s = min(self._cut_leg.stood_s, self.clock())
        run = self._run or self._cut
        if run is not None:
            run.saw(bool(status & Status.RUNNING), asked_s, self.clock())
            self._place_cut()
        return status

    def _place_cut(self) -> None:
        """A run that was cut short ended somewhere between two places."""
        if self._cut is None:
            return
        ends_um = [
            self._cut.from_um + pmd_units.um_from_microsteps(self.config, microsteps)
            for microsteps in self._pace.microsteps_gone(self._cut)
        ]
        self.position_um = sum(ends_um) / 2
        self.within_um = abs(ends_um[1] - ends_um[0]) / 2

    def locate(self) -> Procedure:
        """Where an axis stands that was stopped on its way."""
        try:
            yield from self.read_position_surely()
            yield from self.read_status()  # a count that a reset has put to zero is no place
        except PmdError:
            self.lose_position()
            self.unread = False
            raise
        self.at_rest_um = self.position_um
        self._was_read()

    def _was_read(self) -> None:
        """The encoder may have died before the stop; one not seen to follow for long must have
        gone on.
        """
        self.unread = False
        if self._cut_leg is None:
            return
        leg, self._cut_leg = self._cut_leg, None
        self.within_um = leg.unsure_um(self.position_um)
        if leg.stale and leg.gone_um(self.position_um) <= self.jitter_um:
            self.lose_position()

    def refresh(self) -> Procedure:
        yield from self._forget_stored()  # of a motion that was stopped
        yield from super().refresh()
        self._was_read()

    def stands_at(self, setpoint_um: float) -> bool:
        return self._is_near(self.position_um, setpoint_um)

    def set_up(self) -> Procedure:
        """Raises PmdError; afterwards the settings are ours. Nothing moves."""
        yield from initialise(self)

    def move(self, setpoint_um: int, park_afterwards: bool) -> Procedure:
        self.fault = None
        try:
            yield from self.look_at_rest()
            self._was_read()
            if self.stands_at(setpoint_um):
                return
            if not self.certain:
                raise self.error("position_uncertain", "it was not seen where it was stopped")
            self.within_um = None  # the bridge has taken it into account
            yield from verify(self)
            yield from self.unpark()
            yield from self.look_at_rest()
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
                self.lose_position()

    def _check_moving(self) -> Steps[None]:
        """The limit bit tells of the last motion, so it is only looked at while ours lasts."""
        yield from self.check_status()
        if self.status & Status.EXTERNAL_LIMIT:
            # The travel ends before the switches: the axis is not where it reads.
            self.lose_position()
            raise self.error("external_limit", "a limit switch stopped the motor")

    def _go(self, command: Command) -> Steps[None]:
        """A motion in two steps where the board can do it: what was damaged is never run."""
        self._begun_s = self.clock()
        if not self.can_store:
            yield command
            return
        self._holds_motion = True
        yield pmd_protocol.store(command)
        self._begun_s = self.clock()
        yield pmd_protocol.run_stored(command)

    def _forget_stored(self) -> Steps[None]:
        if self.can_store and self._holds_motion:
            yield pmd_protocol.overwrite_stored(self.address)
        self._holds_motion = False

    def _closed_leg(self, setpoint_um: int) -> Steps[None]:
        self.at_rest_um = None
        self.unread = True
        target = pmd_units.count_from_um(self.config, setpoint_um)
        try:
            yield from self._go(pmd_protocol.move_to_count(self.address, target, self.speed_hz))
        except PmdNoValueError:  # no echo: what it does is seen below, and a target is absolute
            self.doubts["T"] = "the echo does not confirm the motion"
        watch = ProgressWatch(self.config, abs(setpoint_um - self.position_um), self.clock())
        try:
            yield from self._follow(setpoint_um, watch)
        except GeneratorExit:  # stopped on the way
            self._cut_leg = CutLeg(
                self.position_um,
                watch.last_look_s,
                setpoint_um - self.position_um,
                watch.fastest_um_s,
                watch.is_stale(self.clock()),
            )
            raise
        yield from self._leave_target_mode()
        yield from self._forget_stored()
        yield from self.read_position_surely()
        yield from self.check_no_reset()
        self.unread = False

    def _follow(self, setpoint_um: int, watch: ProgressWatch) -> Steps[None]:
        """Until it has arrived. Raises AxisFaultError."""
        told_near = False
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self.read_status()
            asked_s = self.clock()
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
                self.lose_position()  # as an armed index would stop it, and reset the count
                raise self.error("stopped", f"left target mode {error_um:.0f} um short")
            if watch.is_away(error_um):  # a count that was reset in between looks the same
                yield from self.read_status()
                yield from self.check_status()
            if wrong := watch.what_is_wrong(error_um, asked_s, self.clock()):
                self.lose_position()
                raise self.error(*wrong)

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
        run = Run(self.position_um, microsteps, self.speed_hz, self.clock())
        self._run, self._cut = run, None
        self.at_rest_um = None
        self.unread = self.closed_loop
        try:
            yield from self._begin_run(run, go, phase, expected)
            yield from self._await_run_end(run)
            ended_at = yield from self._microstep_phase()
            if ended_at != expected and not anywhere:
                raise self.error(
                    "run_incomplete", f"microstep counter reads {ended_at}, expected {expected}"
                )
            self.position_um = run.from_um + pmd_units.um_from_microsteps(self.config, microsteps)
            self._run = None
            if not anywhere:
                self._pace.learn(run)
            yield from self._forget_stored()
        finally:
            if self._run is not None:  # stopped, failed or given up
                self._run = None
                if not self.closed_loop:
                    self.lose_position()
                    self._cut = run
                    self._place_cut()

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

    def _begin_run(
        self, run: Run, go: Command, phase: int | None, expected: int | None
    ) -> Steps[None]:
        """Start the run once. If that answer is lost, find out; never start it again.

        Even a microstep counter that did not change is no proof that nothing moved (a unit may
        count otherwise than the manual says), so only a proof of motion lets us go on.
        """
        try:
            yield from self._go(go)
            run.sent_s, run.begun_by_s = self._begun_s, self.clock()
        except PmdTimeoutError:
            run.sent_s = self._begun_s
            status = yield from self.read_status()
            now_at = yield from self._microstep_phase()
            finished = now_at is not None and now_at == expected != phase
            if not (status & Status.RUNNING or finished):
                raise self.error(
                    "run_unconfirmed", "the answer to a run was lost; position uncertain"
                ) from None

    def _await_run_end(self, run: Run) -> Steps[None]:
        deadline_s = run.sent_s + 1.5 * run.duration_s + 2.0
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

    def _estimate_um(self, run: Run) -> float:
        part = min(1.0, (self.clock() - run.sent_s) / max(run.duration_s, 1e-6))
        return run.from_um + part * pmd_units.um_from_microsteps(self.config, run.microsteps)

    # Reference

    def declare(self, position_um: int) -> Procedure:
        """The axis stands at `position_um`. Out of target mode, or setting E would move it."""
        self.lose_position()
        if self.needs_setup:
            yield from initialise(self)
        if self.closed_loop:
            yield from self._leave_target_mode()
            yield from self.declare_count(pmd_units.count_from_um(self.config, position_um))
            return
        self.position_um = float(position_um)
        self._declared()

    def declare_count(self, count: int) -> Steps[None]:
        wanted_um = pmd_units.um_from_count(self.config, count)
        yield Command(self.address, f"E{count}", reads=False)
        yield from self.read_position()
        if abs(self.position_um - wanted_um) > self.jitter_um:
            raise self.error("setting", f"reads {self.position_um:.0f} um after E{count}")
        yield from self.set_mark(DECLARED_MARK)
        self._declared()

    def _declared(self) -> None:
        self.at_rest_um = self.position_um
        self.certain = self.believes_mark = True
        self._cut = self._cut_leg = self.within_um = None
        self.fault = None

    # Stopping

    def confirm_stop(self) -> Procedure:
        """Ask, and repeat S, until the controller says that it stands and regulates nothing."""
        while True:
            status = yield from self.read_status()
            if not status & (Status.RUNNING | Status.TARGET_MODE):
                break
            if "S" in self.doubts:
                yield from self._hold_here()
            else:
                yield pmd_protocol.stop(self.address)
        if not status & (ERRORS | Status.RESET | Status.OVERHEAT) and not self.needs_setup:
            self.fault = None

    def _hold_here(self) -> Steps[None]:
        """In place of a stop that a board was not seen to understand: its target is where it is."""
        try:
            count = (yield from self.ask("E")).integer()
            target = pmd_protocol.move_to_count(self.address, count, self.speed_hz)
            yield replace(target, repeatable=False)
        except PmdError:
            return  # whether it stands is asked again
