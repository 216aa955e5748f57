"""One motor on a PMD401/PMD301: its motions, as procedures (see pmd.line).

Closed loop: absolute targets in encoder counts (`T`), which may be sent twice. Open loop: relative
runs in microsteps (`J`), which may not; the position is then what the host has counted. After
every motion the controller is told to leave target mode, so that nothing regulates during imaging.
An axis that stands where it is asked to be is not commanded at all.
"""

from dataclasses import replace

from robot_bridge.daemon.config import HOMING_OVERTRAVEL
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.controller import DECLARED_MARK, POLL_PAUSE_S, Steps
from robot_bridge.pmd.line import Pause, Procedure
from robot_bridge.pmd.progress import FOLLOWS, CutLeg, ProgressWatch, agrees, disagreement
from robot_bridge.pmd.protocol import (
    MICROSTEPS_PER_STEP,
    Command,
    PmdError,
    PmdNoValueError,
    PmdRefusedError,
)
from robot_bridge.pmd.runner import PmdRunner
from robot_bridge.pmd.setup import disarm_index, initialise, verify
from robot_bridge.pmd.status import ERRORS, Status

# Before its first way an encoder has to follow a short run in open loop, long enough to judge it.
PROOF_UM, PROOF_JITTERS = 200.0, 4

_ARRIVED = Status.TARGET_MODE | Status.TARGET_REACHED


class PmdAxis(PmdRunner):
    _cut_leg: CutLeg | None = None

    def read_status(self) -> Steps[Status]:
        status = yield from super().read_status()
        if self._cut_leg is not None and not status & (Status.RUNNING | Status.TARGET_MODE):
            self._cut_leg.stood_s = min(self._cut_leg.stood_s, self.clock())
        return status

    # Moving

    def locate(self) -> Procedure:
        """Where an axis stands that was stopped on its way."""
        try:
            yield from self.read_position_surely()
            yield from self.read_status()  # a count that a reset has put to zero is no place
            yield from self.look_for_index()
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
        config = self.config
        most_um = HOMING_OVERTRAVEL * (config.travel_max_um - config.travel_min_um)
        self.within_um = min(leg.unsure_um(self.position_um), most_um)
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
        run_um = self._proof_um(setpoint_um)
        self._cut_leg = CutLeg(from_um, self.clock(), run_um / FOLLOWS, 0.0, refuted=True)
        try:
            yield from self.run_open_loop(pmd_units.microsteps_from_um(self.config, run_um))
            yield from self.read_position_surely()
            self.at_rest_um = self.position_um
            moved_um = self.position_um - from_um
            if not agrees(moved_um, run_um):
                raise self.error("encoder_disagrees", disagreement(moved_um, run_um))
            self.proven = True
            self._cut_leg = None
        finally:
            if not self.proven:  # refuted, or stopped before it was known
                self.lose_position()

    def _proof_um(self, setpoint_um: int) -> float:
        """Towards the setpoint if there is room for it, whatever the steps really amount to."""
        config, at_um = self.config, self.position_um
        wanted_um = max(PROOF_UM, 1.5 * PROOF_JITTERS * self.jitter_um)
        rooms_um = {
            1: FOLLOWS * (config.travel_max_um - at_um),
            -1: FOLLOWS * (at_um - config.travel_min_um),
        }
        towards = 1 if setpoint_um > at_um else -1
        if rooms_um[towards] < wanted_um:
            towards = max(rooms_um, key=lambda direction: rooms_um[direction])
        run_um = min(wanted_um, rooms_um[towards])
        if run_um < PROOF_JITTERS * self.jitter_um:
            raise self.error(
                "encoder_unproven",
                f"the travel has no room for a run that shows whether the encoder follows "
                f"({PROOF_JITTERS * self.jitter_um / FOLLOWS:.0f} um); widen it, or lower "
                "tolerance_counts",
            )
        return towards * run_um

    def _closed_leg(self, setpoint_um: int) -> Steps[None]:
        self.at_rest_um = None
        self.unread = True
        from_um = self.position_um
        target = pmd_units.count_from_um(self.config, setpoint_um)
        try:
            yield from self._go(pmd_protocol.move_to_count(self.address, target, self.speed_hz))
        except PmdNoValueError:  # no echo: what it does is seen below, and a target is absolute
            self.doubts["T"] = "the echo does not confirm the motion"
        watch = ProgressWatch(self.config, abs(setpoint_um - from_um), self.clock())
        try:
            yield from self._follow(setpoint_um, watch)
        except (GeneratorExit, PmdError) as error:  # stopped on the way, or failed
            self._cut_leg = CutLeg(
                self.position_um,
                watch.best_look_s,
                setpoint_um - from_um,
                watch.fastest_um_s,
                stale=watch.is_stale(self.clock()),
                refuted=isinstance(error, PmdError) and not self.certain,
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

    # Reference

    def declare(self, position_um: float) -> Procedure:
        """The axis stands at `position_um`. Out of target mode, or setting E would move it."""
        self.lose_position()
        if self.needs_setup:
            yield from initialise(self)
        if self.closed_loop:
            yield from self._leave_target_mode()
            yield from self.declare_count(pmd_units.count_from_um(self.config, position_um))
            return
        self.position_um = position_um
        self._declared()

    def declare_count(self, count: int) -> Steps[None]:
        wanted_um = pmd_units.um_from_count(self.config, count)
        if self.tells_index and (yield from self.ask("N")).integer() != self.index_at_rest:
            yield from disarm_index(self)  # E does it as well, where it has to be written
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
        self.certain = self.believes_mark = True
        self._cut = self._cut_leg = self.within_um = None
        self.fault, self.unread = None, False

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
