"""The bridge itself: it alone owns the phase, the arming, the lock and the one motion in flight.

Bytes go in by `receive`, come out by `take_output`, and `tick` does what is due; the daemon's loop
calls them. A motion begins only in `tick`, after everything that was received has been looked at,
so a STOP that came with or after a MOVE is known before a motor turns.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from robot_bridge import rules
from robot_bridge.bridge_end import (
    BridgeEnd,
    HeartbeatReceived,
    MalformedReceived,
    RequestReceived,
    SessionOpened,
    StopReceived,
)
from robot_bridge.journal import CommandRecord, Journal, JournalError, LatchedStop
from robot_bridge.messages import (
    PROTOCOL_VERSION,
    SCHEMA,
    TEXT_MAX,
    Answer,
    Arm,
    AxisTravel,
    Code,
    CommandState,
    DeclarePosition,
    Disarm,
    Hello,
    Home,
    Message,
    Move,
    Rearm,
    SetInsertionLock,
    SetPhase,
    Status,
)
from robot_bridge.motor_watch import MotorWatch
from robot_bridge.motors import MotorError, Motors, MotorStatus
from robot_bridge.phases import ALLOWED, WorkPhase

IDLE_POLL_S = 0.2
STANDSTILL_BOUND_S = 3.0


@dataclass(frozen=True)
class BridgeSettings:
    axes: tuple[AxisTravel, ...]
    deadman_s: float = 1.0
    motion_timeout_s: float = 60.0
    motion_poll_s: float = 0.02
    software: str = ""


@dataclass
class _Motion:
    """The one motion in flight. `ending`: decided, waiting for standstill."""

    record: CommandRecord
    accepted_s: float
    started: bool = False
    ending: tuple[CommandState, str, str] | None = None
    ending_s: float = 0.0


class Bridge:
    """All that the bridge decides, over real motors and a real journal; no line, no threads."""

    def __init__(
        self,
        settings: BridgeSettings,
        motors: Motors,
        journal: Journal,
        *,
        boot_id: str,
        new_session: Callable[[], int],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        self.settings = settings
        self.boot_id = boot_id
        self.end = BridgeEnd(boot_id, new_session)
        self.phase = WorkPhase.START_UP
        self.armed = False
        self.stopped = journal.stop.latched
        self.stop_reason = journal.stop.code if journal.stop.latched else ""
        self.stop_count = journal.stop.number
        if self.stopped:  # a restart is no re-arm
            self.phase = WorkPhase.EMERGENCY if journal.stop.emergency else WorkPhase.STOP
        self.refused: Counter[str] = Counter()
        self.commands_done: Counter[str] = Counter()
        self.last_motion = f"boot:{boot_id}"
        self.motors = MotorWatch(motors, clock)
        self._journal = journal
        self._clock = clock
        self._wall_clock = wall_clock
        self._booted_s = clock()
        self._certain = False
        self._declared = 0
        self._motion: _Motion | None = None
        self._last_command: CommandRecord | None = None
        self._last_stop_nonce: int | None = None
        self._fresh_s = clock()
        self._ticked_s = clock()
        self._close_old_commands()

    # --- what others may ask ------------------------------------------------------------------

    @property
    def moving(self) -> bool:
        return self._motion is not None

    @property
    def certain(self) -> bool:
        return self._certain and self.motors.status.certain

    @property
    def insertion_locked(self) -> bool:
        return self._journal.insertion_locked

    @property
    def heard_s_ago(self) -> float:
        return self._clock() - self._fresh_s

    def take_output(self) -> bytes:
        return self.end.take_output()

    def status(self) -> Status:
        motors, command = self.motors.status, self._last_command
        return Status(
            now_ms=self._now_ms(),
            boot_id=self.boot_id,
            phase=self.phase.value,
            armed=self.armed,
            stopped=self.stopped,
            stop_reason=self.stop_reason,
            stop_count=self.stop_count,
            insertion_locked=self.insertion_locked,
            moving=self.moving or motors.moving,
            parked=motors.parked,
            positions_um=dict(motors.readback_um),
            position_certain=self.certain,
            last_motion=self.last_motion,
            fault=motors.fault,
            command_id=command.command_id if command else None,
            command_state=command.state.value if command else None,
            command_code=str(command.code) if command else "",
            command_text=command.text if command else "",
            command_readback_um=dict(command.readback_um) if command else {},
            frames_bad=self.end.counters.bad,
            refused=self.refused.total(),
        )

    # --- what arrives -------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Act on what `data` completes; STOPs first."""
        for event in self.end.receive(data):
            match event:
                case StopReceived():
                    self._receive_stop(event)
                case SessionOpened():
                    self._open_session(event)
                case HeartbeatReceived():
                    self._freshen(event.heartbeat.seen_ms)
                    self.end.send_status(event.sequence, self.status())
                case MalformedReceived():
                    answer = self._refuse(Code.MALFORMED, event.text)
                    self.end.answer(event.sequence, answer)
                case RequestReceived():
                    self.end.answer(event.sequence, self._answer(event.request))

    def _receive_stop(self, stop: StopReceived) -> None:
        known = self.stopped and stop.nonce == self._last_stop_nonce
        if known and stop.emergency:
            known = self.phase is WorkPhase.EMERGENCY
        if not known or self.motors.stop_unconfirmed:
            self.motors.stop()
        self.end.acknowledge_stop(stop)
        if known:
            return
        self._last_stop_nonce = stop.nonce
        code = Code.EMERGENCY_STOP if stop.emergency else Code.OPERATOR_STOP
        self._latch(code, "STOP was received", emergency=stop.emergency)

    def _open_session(self, event: SessionOpened) -> None:
        self._end_motion(CommandState.STOPPED, Code.SESSION_ENDED, "another session was opened")
        self.armed = False
        self._fresh_s = self._clock()
        self.end.open_session(event, self._hello(event.request.nonce))
        self._note("session", name=event.request.name, session=self.end.session)

    def _hello(self, nonce: int) -> Callable[[int], Hello]:
        return lambda session: Hello(
            nonce=nonce,
            code=Code.OK,
            text="",
            protocol=PROTOCOL_VERSION,
            schema=SCHEMA,
            software=self.settings.software,
            session=session,
            boot_id=self.boot_id,
            now_ms=self._now_ms(),
            axes=self.settings.axes,
            position_certain=self.certain,
            last_motion=self.last_motion,
        )

    def _freshen(self, seen_ms: int) -> None:
        """The control loop is alive and hears us: only that feeds the deadman."""
        if rules.is_fresh(self._now_ms(), seen_ms, self._stale_after_ms()):
            self._fresh_s = self._clock()

    def _answer(self, request: Message) -> Answer:
        seen_ms = getattr(request, "seen_ms", None)
        if seen_ms is not None:
            self._freshen(seen_ms)
        if isinstance(request, Move | Home):
            return self._answer_command(request)
        if isinstance(request, Rearm):
            self.motors.clear_fault()
        broken = rules.refusal(self._standing(request), request)
        if broken is not None:
            self._note("refused", request=type(request).__name__, code=broken[0].value)
            return self._refuse(*broken)
        try:
            _DO[type(request)](self, request)
        except JournalError as error:
            return self._refuse(Code.JOURNAL, str(error))
        except MotorError as error:
            return self._refuse(Code.MOTOR_FAULT, str(error))
        return Answer(Code.OK, "", None, {})

    def _refuse(self, code: Code, text: str) -> Answer:
        self.refused[code.value] += 1
        return Answer(code, text[:TEXT_MAX], None, {})

    def _standing(self, request: Message) -> rules.Standing:
        measurement = getattr(request, "measurement_id", None)
        return rules.Standing(
            phase=self.phase,
            armed=self.armed,
            stopped=self.stopped,
            stop_reason=self.stop_reason,
            stop_count=self.stop_count,
            insertion_locked=self.insertion_locked,
            in_flight=self._motion.record.command_id if self._motion else None,
            certain=self.certain,
            fault=self.motors.status.fault,
            last_motion=self.last_motion,
            measurement_used=measurement in self._journal.measurements_used,
            now_ms=self._now_ms(),
            stale_after_ms=self._stale_after_ms(),
            axes=self.settings.axes,
        )

    # --- requests that are no motion ----------------------------------------------------------

    def _arm(self, request: Arm) -> None:
        self.armed = True
        self._note("arm", by=request.by)

    def _disarm(self, request: Disarm) -> None:
        self._end_motion(CommandState.STOPPED, Code.DISARMED, "disarmed")
        self.armed = False
        self._note("disarm", by=request.by)

    def _rearm(self, request: Rearm) -> None:
        next_phase = ALLOWED[self.phase].after_rearm
        assert next_phase is not None
        self._journal.rearm(request.by, self._wall_clock())
        self.stopped = False
        self.stop_reason = ""
        self.phase = next_phase
        self.armed = True

    def _set_phase(self, request: SetPhase) -> None:
        self.phase = WorkPhase(request.phase)
        self._note("phase", phase=request.phase, by=request.by)

    def _set_lock(self, request: SetInsertionLock) -> None:
        if request.locked:
            text = "the insertion lock was set in motion"
            self._end_motion(CommandState.STOPPED, Code.LOCKED_IN_MOTION, text)
        self._journal.lock(request.locked, request.by, self._wall_clock())

    def _declare(self, request: DeclarePosition) -> None:
        self.motors.motors.declare_position(request.positions_um)
        self._certain = True
        self._declared += 1
        self.last_motion = f"declared:{self.boot_id}:{self._declared}"
        self.motors.poll()
        self._note("declare", positions_um=request.positions_um, by=request.by)

    # --- commands -----------------------------------------------------------------------------

    def _answer_command(self, request: Move | Home) -> Answer:
        record = _record_of(request)
        known = self._journal.commands.get(record.command_id)
        if known is not None:
            return self._answer_known(record, known)
        broken = rules.refusal(self._standing(request), request)
        try:
            if broken is not None:
                return self._refuse_command(record, *broken)
            self._journal.begin(record, self._wall_clock())
        except JournalError as error:
            return replace(self._refuse(Code.JOURNAL, str(error)), state=CommandState.REFUSED.value)
        self._motion = _Motion(record, self._clock())
        self._last_command = record
        return _answer_of(record)

    def _answer_known(self, record: CommandRecord, known: CommandRecord) -> Answer:
        if known.asks_the_same(record):
            in_flight = self._motion.record if self._motion else known
            return _answer_of(known if known.state.final else in_flight)
        text = f"command {record.command_id[:60]!r} was another command before"
        answer = self._refuse(Code.COMMAND_ID_REUSED, text)
        return replace(answer, state=CommandState.REFUSED.value)

    def _refuse_command(self, record: CommandRecord, code: Code, text: str) -> Answer:
        self.refused[code.value] += 1
        text = text[:TEXT_MAX]
        refused = replace(record, state=CommandState.REFUSED, code=code.value, text=text)
        if code is not Code.MALFORMED:  # a malformed id is no id
            self._journal.refuse(refused, self._wall_clock())
        return _answer_of(refused)

    # --- what is due --------------------------------------------------------------------------

    def tick(self) -> None:
        """Deadman, begin of an accepted motion, progress of a running one. Call often."""
        now_s = self._clock()
        stalled_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.armed or self.moving:
            if stalled_s > self.settings.deadman_s:
                self.stop_for(Code.LOOP_STALLED, f"the bridge stood still for {stalled_s:.1f} s")
            elif now_s - self._fresh_s > self.settings.deadman_s:
                text = f"nothing heard from the service for {now_s - self._fresh_s:.2f} s"
                self.stop_for(Code.LINK_LOST, text)
        self._begin_motion()
        self._follow_motors(now_s)

    def stop_for(self, code: Code, text: str) -> None:
        """Stop and latch for a reason of our own (deadman, guardian, line, motors)."""
        self.motors.stop()
        self._latch(code, text)

    def _begin_motion(self) -> None:
        motion = self._motion
        if motion is None or motion.started:
            return
        if motion.ending is not None:
            self._finish(*motion.ending)
            return
        motion.started = True
        motion.record = replace(motion.record, state=CommandState.RUNNING)
        self._last_command = motion.record
        self.last_motion = motion.record.command_id
        self.motors.begun()
        try:
            if motion.record.what == "home":
                self.motors.motors.home()
            else:
                self.motors.motors.move_to(motion.record.setpoints_um)
        except MotorError as error:
            self.motors.stop()
            self._finish(CommandState.FAILED, Code.MOTOR_FAULT, str(error))

    def _follow_motors(self, now_s: float) -> None:
        period_s = IDLE_POLL_S if self._motion is None else self.settings.motion_poll_s
        if not self.motors.poll_if_due(period_s):
            return
        homing = self._motion is not None and self._motion.record.what == "home"
        if not self.motors.status.certain and not homing:
            self._certain = False
        if self._motion is not None:
            self._follow_motion(self._motion, now_s)
        else:
            self._follow_idle_motors()
        if self.motors.stop_unconfirmed:
            self.motors.stop_again_if_due()

    def _follow_idle_motors(self) -> None:
        if self.motors.status.moving:
            self._stop_stray_motion()
        elif self.motors.status.fault is not None and self.armed:
            self.stop_for(Code.MOTOR_FAULT, self.motors.status.fault_text)
        elif self.phase is WorkPhase.EMERGENCY:
            self.motors.park_again_if_due()

    def _stop_stray_motion(self) -> None:
        if self.stopped:
            self.motors.stop()
        else:
            self.stop_for(Code.MOTOR_FAULT, "an axis moves without a command")

    def _follow_motion(self, motion: _Motion, now_s: float) -> None:
        status = self.motors.status
        if motion.ending is not None:
            self._await_standstill(motion, now_s)
        elif status.fault is not None:
            text = f"{status.fault}: {status.fault_text}"
            self.stop_for(Code.MOTOR_FAULT, text)
            motion.ending = (CommandState.FAILED, Code.MOTOR_FAULT, text)
        elif now_s - motion.accepted_s > self.settings.motion_timeout_s:
            text = f"not there after {self.settings.motion_timeout_s:g} s"
            self._end_motion(CommandState.FAILED, Code.MOTION_TIMEOUT, text)
        elif status.moving:
            return
        elif not status.reached:
            text = f"the motors ended at {_short(status)} without reaching the setpoints"
            self._finish(CommandState.FAILED, Code.NOT_REACHED, text)
        else:
            self._finish(CommandState.DONE, Code.OK, "")

    def _await_standstill(self, motion: _Motion, now_s: float) -> None:
        assert motion.ending is not None
        if not self.motors.status.moving:
            self._finish(*motion.ending)
        elif now_s - motion.ending_s > STANDSTILL_BOUND_S:
            self._finish(CommandState.FAILED, Code.MOTOR_FAULT, "the motors do not stop")
        else:
            self.motors.stop_again_if_due()

    # --- ends ---------------------------------------------------------------------------------

    def _end_motion(self, state: CommandState, code: Code, text: str) -> None:
        """Stop the motion in flight, if any, and decide how it will have ended (first one wins)."""
        if self._motion is None:
            return
        self.motors.stop()
        self._decide_end(state, code, text)

    def _decide_end(self, state: CommandState, code: Code, text: str) -> None:
        if self._motion is not None and self._motion.ending is None:
            self._motion.ending = (state, code, text)
            self._motion.ending_s = self._clock()

    def _latch(self, code: Code, text: str, *, emergency: bool = False) -> None:
        self._decide_end(CommandState.STOPPED, code, text)
        self.armed = False
        self.stopped = True
        self.stop_reason = code.value
        self.stop_count += 1
        emergency = emergency or self.phase is WorkPhase.EMERGENCY
        self.phase = WorkPhase.EMERGENCY if emergency else WorkPhase.STOP
        if emergency and (problem := self.motors.park()) is not None:
            self._note("park_failed", text=problem)
        latched = LatchedStop(self.stop_count, code.value, emergency, True)
        try:
            self._journal.latch_stop(latched, text, self._wall_clock())
        except JournalError:
            self.refused[Code.JOURNAL.value] += 1  # it is latched all the same, until a restart

    def _finish(self, state: CommandState, code: str, text: str) -> None:
        assert self._motion is not None
        motion, self._motion = self._motion, None
        record = replace(
            motion.record,
            state=state,
            code=str(code),
            text=text[:TEXT_MAX],
            readback_um=dict(self.motors.status.readback_um),
        )
        if state is CommandState.DONE and record.what == "home":
            self._certain = True
        try:
            self._journal.end(record, self._wall_clock())
        except JournalError as error:
            # After a restart the journal would say FAILED; so it has failed, now and then.
            record = replace(
                record, state=CommandState.FAILED, code=Code.JOURNAL, text=str(error)[:TEXT_MAX]
            )
            self._journal.commands[record.command_id] = record
            self.stop_for(Code.JOURNAL, str(error))
        self._last_command = record
        self.commands_done[record.state.value] += 1

    def _close_old_commands(self) -> None:
        """What the last run left unfinished will never be done: say so, for ever."""
        for record in self._journal.unfinished():
            text = "the bridge restarted before the command ended; the position is uncertain"
            ended = replace(
                record, state=CommandState.FAILED, code=Code.BRIDGE_RESTARTED.value, text=text
            )
            self._journal.end(ended, self._wall_clock())

    def shut_down(self) -> None:
        """Stop and give the command in flight its end. Idempotent; each step on its own."""
        self.armed = False
        self.motors.stop()
        self._decide_end(CommandState.STOPPED, Code.SHUTTING_DOWN, "the bridge shut down")

    # --- small things -------------------------------------------------------------------------

    def _now_ms(self) -> int:
        return round((self._clock() - self._booted_s) * 1000)

    def _stale_after_ms(self) -> int:
        return round(self.settings.deadman_s * 1000)

    def _note(self, what: str, **details: object) -> None:
        # A note that cannot be written must not keep a stop from happening.
        try:
            self._journal.note(what, self._wall_clock(), **details)
        except JournalError:
            self.refused[Code.JOURNAL.value] += 1


_DO: dict[type[Message], Callable] = {
    Arm: Bridge._arm,
    Disarm: Bridge._disarm,
    Rearm: Bridge._rearm,
    SetPhase: Bridge._set_phase,
    SetInsertionLock: Bridge._set_lock,
    DeclarePosition: Bridge._declare,
}


def _record_of(request: Move | Home) -> CommandRecord:
    if isinstance(request, Home):
        return CommandRecord(request.command_id, "home", {}, None, "")
    return CommandRecord(
        request.command_id,
        "move",
        request.setpoints_um,
        request.measurement_id,
        request.based_on_motion,
    )


def _answer_of(record: CommandRecord) -> Answer:
    return Answer(str(record.code), record.text, record.state.value, dict(record.readback_um))


def _short(status: MotorStatus) -> str:
    return ", ".join(f"{axis} {value} um" for axis, value in status.readback_um.items())
