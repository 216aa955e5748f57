"""The one motion in flight, from its acceptance to its end, and what is known of the position.

What a motion does next is decided in `motion`; here it is done to the motors and journalled. Only
the bridge's loop calls this, so at most one motion is ever between acceptance and end.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

from robot_bridge.daemon.bridge_journal import BridgeJournal
from robot_bridge.daemon.journal import CommandRecord, JournalError
from robot_bridge.daemon.motion import (
    Ending,
    Faulty,
    Motion,
    Over,
    Overdue,
    Runs,
    RunsOut,
    progress,
)
from robot_bridge.daemon.motor_watch import MotorWatch
from robot_bridge.daemon.motors import MotorError
from robot_bridge.daemon.whereabouts import Stand, Whereabouts
from robot_bridge.protocol.messages import TEXT_MAX, Code, CommandState


class MotionInFlight:
    """`last_motion` names what moved the robot last, or said where it is; `motions` counts what
    moved it, or may have.
    """

    def __init__(
        self,
        motors: MotorWatch,
        journal: BridgeJournal,
        clock: Callable[[], float],
        *,
        boot_id: str,
        timeout_s: float,
        whereabouts: Whereabouts,
        stop_for: Callable[[Code, str], None],
    ) -> None:
        """`stop_for` is the bridge's: it stops and latches."""
        self.last_motion = f"boot:{boot_id}"
        self.last_command: CommandRecord | None = None
        self.commands_done: Counter[str] = Counter()
        self._motors = motors
        self._journal = journal
        self._clock = clock
        self._boot_id = boot_id
        self._timeout_s = timeout_s
        self._stop_for = stop_for
        self._motion: Motion | None = None
        self._certain: frozenset[str] = frozenset()
        self._declared = 0
        self.motions = 0
        self.whereabouts = whereabouts

    @property
    def command(self) -> CommandRecord | None:
        """The command whose motion has not ended."""
        return self._motion.record if self._motion else None

    @property
    def goes_on(self) -> bool:
        """A motion is in flight, and nothing has ended it yet."""
        return self._motion is not None and self._motion.ending is None

    # --- the position -------------------------------------------------------------------------

    @property
    def certain_axes(self) -> frozenset[str]:
        return self._certain & self._motors.status.certain_axes

    @property
    def certain(self) -> bool:
        """Every axis."""
        return self.certain_axes >= self._motors.status.readback_um.keys()

    def heed_uncertainty(self) -> None:
        """What was lost stays lost until homing or a declaration, whatever the motors say later."""
        lost = self._certain - self._motors.status.certain_axes
        if not lost:
            return
        self._certain -= lost
        if self._motion is None:
            self._moved_otherwise(f"lost:{self._boot_id}")
            self.whereabouts.strayed(lost, self._motors.status.readback_um)
            self._journal.keep_lost(self.whereabouts.stands, self.certain_axes)

    def _moved_otherwise(self, what: str) -> None:
        self.motions += 1
        self.last_motion = f"{what}:{self.motions}"

    def note_parking(self) -> None:
        """Parking may shift an axis a little."""
        self._moved_otherwise(f"parked:{self._boot_id}")

    def note_stray(self) -> None:
        """An axis moved, or moves, without a command."""
        self._moved_otherwise(f"stray:{self._boot_id}")

    def set_drives(self, *, on: bool) -> None:
        """Raises MotorError."""
        self.note_parking()
        if on:
            self._motors.motors.unpark()
        else:
            self._motors.motors.park()

    def declare_position(
        self, positions_um: Mapping[str, int], within_um: Mapping[str, int]
    ) -> None:
        """Only what is named is declared. Raises MotorError, JournalError."""
        were_certain = self.certain_axes
        self._motors.motors.declare_position(positions_um)
        self._certain |= frozenset(positions_um)
        self._declared += 1
        self.last_motion = f"declared:{self._boot_id}:{self._declared}"
        self.whereabouts.declared(positions_um, within_um, were_certain)
        self._motors.poll()
        self._journal.keep_stands(self.whereabouts.stands, self.certain_axes)

    def correct_position(
        self, correction_um: Mapping[str, int], within_um: Mapping[str, int]
    ) -> None:
        """Raises JournalError."""
        self.whereabouts.corrected(correction_um, within_um)
        self._journal.keep_stands(self.whereabouts.stands, self.certain_axes)

    # --- begin --------------------------------------------------------------------------------

    def accept(self, record: CommandRecord) -> None:
        """Journal it; the motors begin in the next `begin_if_due`. Raises JournalError."""
        self._journal.begin(record, self._if_nothing_more_is_heard(record))
        self._motion = Motion(record, self._clock())
        self.last_command = record

    def _if_nothing_more_is_heard(self, record: CommandRecord) -> dict[str, Stand]:
        stands = dict(self.whereabouts.stands)
        if record.what == "home":
            axes = record.axes or stands.keys()
            return {axis: stand for axis, stand in stands.items() if axis not in axes}
        return stands | self.whereabouts.going(record.setpoints_um)

    def begin_if_due(self) -> None:
        motion = self._motion
        if motion is None or motion.started:
            return
        if motion.ending is not None:
            self._finish(motion.ending)
            return
        motion.started = True
        motion.record = replace(motion.record, state=CommandState.RUNNING)
        self.last_command = motion.record
        self.last_motion = motion.record.command_id
        self.motions += 1
        self._motors.begun()
        try:
            if motion.homing:
                self._certain -= self._homed_axes(motion.record)
                self._motors.motors.home(motion.record.axes)
            else:
                self._motors.motors.move_to(motion.record.setpoints_um)
        except MotorError as error:
            self._motors.stop()
            self._finish(Ending(CommandState.FAILED, Code.MOTOR_FAULT, str(error)))

    # --- go on --------------------------------------------------------------------------------

    def follow(self, now_s: float) -> None:
        """Act on the motors' newest status."""
        motion = self._motion
        if motion is None:
            return
        match progress(motion, self._motors.status, now_s, self._timeout_s):
            case Runs() | RunsOut():  # a stop that was not confirmed is said again by the bridge
                return
            case Faulty(ending):
                self._stop_for(ending.code, ending.text)
                motion.ending = ending  # the latched stop does not say STOPPED of it
            case Overdue(ending):
                self.stop(ending)
            case Over(ending):
                self._finish(ending)

    # --- end ----------------------------------------------------------------------------------

    def stop(self, ending: Ending) -> None:
        """Stop the motion in flight, if any, and decide how it will have ended (first one wins)."""
        if self._motion is None:
            return
        self._motors.stop()
        self.decide_end(ending)

    def decide_end(self, ending: Ending) -> None:
        if self._motion is not None:
            self._motion.decide_end(ending, self._clock())

    def _homed_axes(self, record: CommandRecord) -> frozenset[str]:
        return frozenset(record.axes or self._motors.status.readback_um)

    def _know_afterwards(self, motion: Motion, ending: Ending) -> None:
        """Where the axes stand now: where they read if they are certain, else somewhere between."""
        if not motion.started:
            return
        status = self._motors.status
        readback_um = status.readback_um
        if motion.homing:
            homed = self._homed_axes(motion.record)
            self.whereabouts.forget(homed)
            if ending.state is CommandState.DONE:
                self._certain |= homed & status.certain_axes
                self.whereabouts.homed({axis: readback_um[axis] for axis in homed})
            return
        going = self.whereabouts.going(motion.record.setpoints_um)
        within_um = {a: status.within_um[a] for a in going.keys() & status.within_um.keys()}
        self.whereabouts.arrived(readback_um, self.certain_axes, within_um)
        lost = {axis: stand for axis, stand in going.items() if axis not in self.certain_axes}
        self.whereabouts.ended_early(lost, readback_um, within_um)
        others = readback_um.keys() - self.certain_axes - going.keys()
        self.whereabouts.strayed(others, readback_um)

    def _finish(self, ending: Ending) -> None:
        assert self._motion is not None
        motion, self._motion = self._motion, None
        record = replace(
            motion.record,
            state=ending.state,
            code=str(ending.code),
            text=ending.text[:TEXT_MAX],
            readback_um=dict(self._motors.status.readback_um),
        )
        self._know_afterwards(motion, ending)
        try:
            self._journal.end(record, self.whereabouts.stands, self.certain_axes)
        except JournalError as error:
            # After a restart the journal would say FAILED; so it has failed, now and then.
            record = replace(
                record, state=CommandState.FAILED, code=Code.JOURNAL, text=str(error)[:TEXT_MAX]
            )
            self._journal.hold_unwritten(record)
            self._stop_for(Code.JOURNAL, str(error))
        self.last_command = record
        self.commands_done[record.state.value] += 1
