"""Relative runs of microsteps of a PMD401/PMD301 (`J`, `I`), counted by the host.

Never sent twice. If one cannot be accounted for, an axis without encoder is uncertain: between
which bounds is told by the time that it was seen to run (see pmd.runs).
"""

import time
from collections.abc import Callable

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.controller import (
    MICROSTEP_PHASE,
    POLL_PAUSE_S,
    POWER_ON_DELAY_US,
    PmdController,
    Steps,
)
from robot_bridge.pmd.line import Pause
from robot_bridge.pmd.progress import StandWatch
from robot_bridge.pmd.protocol import (
    MICROSTEPS_PER_STEP,
    Command,
    PmdReplyError,
    PmdTimeoutError,
)
from robot_bridge.pmd.runs import SETTLE_S, Pace, Run
from robot_bridge.pmd.status import Status


class PmdRunner(PmdController):
    """`within_um`: how far from its readback a motion that was cut short may have ended.

    `unread`: it was stopped on its way, and nobody has asked yet where it stands.
    """

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
        self.unread = False
        self.within_um: float | None = None

    @property
    def speed_hz(self) -> int:
        return max(1, min(self.config.speed_hz, self.speed_cap_hz))

    def readback_um(self) -> int:
        """Closed loop: the encoder's; open loop: what was counted, interpolated during a run."""
        if self._run is not None:
            return round(self._estimate_um(self._run))
        return round(self.position_um)

    # Seeing

    def read_status(self) -> Steps[Status]:
        asked_s = self.clock()
        status = yield from super().read_status()
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

    # Running

    def run_open_loop(self, microsteps: int, speed_hz: int | None = None) -> Steps[None]:
        """One relative run, counted by the host. If it cannot be accounted for, say uncertain."""
        run = Run(self.position_um, microsteps, speed_hz or self.speed_hz, self.clock())
        go = pmd_protocol.run_microsteps(self.address, microsteps, run.speed_hz)
        yield from self._run_counted(go, run)

    def run_while_followed(
        self, microsteps: int, speed_hz: int | None = None, *, to_index: bool = False
    ) -> Steps[bool]:
        """It ends early if the encoder, if there is one, stands (returns True), or at its index."""
        run = Run(self.position_um, microsteps, speed_hz or self.speed_hz, self.clock())
        command = pmd_protocol.run_to_index if to_index else pmd_protocol.run_microsteps
        go = command(self.address, microsteps, run.speed_hz)
        if not self.closed_loop:
            yield from self._run_counted(go, run)
            return False
        speed_um_s = abs(pmd_units.um_from_microsteps(self.config, microsteps)) / run.duration_s
        watch = StandWatch(speed_um_s, self.jitter_um)
        return (yield from self._run_counted(go, run, watch))

    def _run_counted(self, go: Command, run: Run, watch: StandWatch | None = None) -> Steps[bool]:
        """watch: it may end anywhere. Returns whether it was ended because the encoder stands."""
        microsteps = run.microsteps
        phase = yield from self._microstep_phase()
        expected = None if phase is None else (phase + microsteps) % MICROSTEPS_PER_STEP
        self._run, self._cut = run, None
        self.at_rest_um = None
        self.unread = self.closed_loop
        try:
            yield from self._begin_run(run, go, phase, expected)
            stood = yield from self._await_run_end(run, watch)
            ended_at = yield from self._microstep_phase()
            if ended_at != expected and watch is None:
                raise self.error(
                    "run_incomplete", f"microstep counter reads {ended_at}, expected {expected}"
                )
            self._run = None
            if watch is None:
                way_um = pmd_units.um_from_microsteps(self.config, microsteps)
                self.position_um = run.from_um + way_um
                self._pace.learn(run)
            yield from self._forget_stored()
            return stood
        finally:
            if self._run is not None:  # stopped, failed or given up
                self._run = None
                if not self.closed_loop:
                    self.lose_position()
                    self._cut = run
                    self._place_cut()

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

    def _await_run_end(self, run: Run, watch: StandWatch | None) -> Steps[bool]:
        deadline_s = run.sent_s + 1.5 * run.duration_s + 2.0
        stood = False
        yield Pause(SETTLE_S)
        while True:
            status = yield from self.read_status()
            yield from self._check_moving()
            # `J` reads 0 after a run; during one it reads 1 or +-222, depending on the unit.
            if not status & Status.RUNNING and (yield from self.ask("J")).integer() == 0:
                return stood
            if self.clock() > deadline_s:
                raise self.error("motion_timeout", f"still running after {run.duration_s:.1f} s")
            if watch is not None:
                yield from self.read_position()
                stood = stood or watch.stands(self.position_um, self.clock())
            if stood:
                yield pmd_protocol.stop(self.address)
            yield Pause(POLL_PAUSE_S)

    def _microstep_phase(self) -> Steps[int | None]:
        """None if the board does not tell; the end of a run is then known by its status alone."""
        reply = yield from self.ask_if_it_can(*MICROSTEP_PHASE)
        if reply is None:
            return None
        values = reply.integers()
        if len(values) != 2 or not 0 <= values[1] < MICROSTEPS_PER_STEP:
            raise PmdReplyError(self.named(f"microstep counter reads {values}"))
        return values[1]

    def _estimate_um(self, run: Run) -> float:
        part = min(1.0, (self.clock() - run.sent_s) / max(run.duration_s, 1e-6))
        return run.from_um + part * pmd_units.um_from_microsteps(self.config, run.microsteps)
