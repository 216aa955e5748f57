"""The bridge itself: what arrives and what is due, in one loop that alone changes anything.

Bytes go in by `receive`, come out by `take_output`, and `tick` does what is due; the daemon's loop
calls them. A motion begins only in `tick`, after everything that was received has been looked at,
so a STOP that came with or after a MOVE is known before a motor turns.

The parts: `permission` (phase, arming, latched stop), `motion_in_flight`, `declaring`,
`bridge_journal`, `motor_watch`; `requests` answers from them, `bridge_view` tells how they stand.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from robot_bridge.daemon import rules
from robot_bridge.daemon.arming import Arming
from robot_bridge.daemon.bridge_journal import BridgeJournal
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.bridge_view import BridgeView
from robot_bridge.daemon.declaring import Declaring
from robot_bridge.daemon.journal import Journal
from robot_bridge.daemon.motion import Ending
from robot_bridge.daemon.motion_in_flight import MotionInFlight
from robot_bridge.daemon.motor_watch import MotorWatch
from robot_bridge.daemon.motors import Motors
from robot_bridge.daemon.requests import Requests
from robot_bridge.daemon.whereabouts import Whereabouts
from robot_bridge.protocol.bridge_end import (
    BridgeEnd,
    HeartbeatReceived,
    MalformedReceived,
    RequestReceived,
    SessionOpened,
    StopReceived,
)
from robot_bridge.protocol.messages import Answer, Code, CommandState, Hello, Message, Status
from robot_bridge.protocol.phases import WorkPhase

IDLE_POLL_S = 0.2


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
        self.refused: Counter[str] = Counter()
        self.motors = MotorWatch(motors, clock)
        self._clock = clock
        self._booted_s = self._fresh_s = self._ticked_s = clock()
        self._last_stop_nonce: int | None = None
        self._journal = BridgeJournal(journal, wall_clock, self.refused)
        self._permission = Arming(journal.stop)
        self._motion = MotionInFlight(
            self.motors, self._journal, clock,
            boot_id=boot_id, timeout_s=settings.motion_timeout_s,
            whereabouts=self._whereabouts(settings, journal), stop_for=self.stop_for,
        )  # fmt: skip
        self._declaring = Declaring(self._motion, self.motors, self._journal, clock)
        self._declared_for = 0  # the request's sequence number
        self._view = BridgeView(
            settings, boot_id, self._permission, self._motion, self.motors, self._journal,
            self._declaring, self.end.counters, self.refused, self._now_ms,
        )  # fmt: skip
        self._requests = Requests(
            self._view, self._permission, self._motion, self.motors, self._journal,
            self._declaring, self.refused,
        )  # fmt: skip
        self._journal.close_old_commands()
        self._journal.tie_boards(self.motors.status.boards)

    def _whereabouts(self, settings: BridgeSettings, journal: Journal) -> Whereabouts:
        """An axis whose encoder kept its count through our restart stands where it reads."""
        status, stands = self.motors.status, dict(journal.stands)
        for axis in status.certain_axes & journal.settled.keys():
            stands[axis] = replace(journal.settled[axis], at_um=status.readback_um[axis])
        return Whereabouts(settings.growth, stands)

    # --- what others may ask ------------------------------------------------------------------

    @property
    def phase(self) -> WorkPhase:
        return self._permission.phase

    @property
    def armed(self) -> bool:
        return self._permission.armed

    @property
    def stopped(self) -> bool:
        return self._permission.stopped

    @property
    def stop_reason(self) -> str:
        return self._permission.stop_reason

    @property
    def stop_count(self) -> int:
        return self._permission.stop_count

    @property
    def moving(self) -> bool:
        return self._motion.command is not None

    @property
    def certain(self) -> bool:
        return self._motion.certain

    @property
    def last_motion(self) -> str:
        return self._motion.last_motion

    @property
    def commands_done(self) -> Counter[str]:
        return self._motion.commands_done

    @property
    def insertion_locked(self) -> bool:
        return self._journal.insertion_locked

    @property
    def heard_s_ago(self) -> float:
        return self._clock() - self._fresh_s

    def status(self) -> Status:
        return self._view.status()

    def take_output(self) -> bytes:
        return self.end.take_output()

    def _now_ms(self) -> int:
        return round((self._clock() - self._booted_s) * 1000)

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
                    refused = self._requests.refuse(Code.MALFORMED, event.text)
                    self.end.answer(event.sequence, refused)
                case RequestReceived():
                    answer = self._answer(event.request)
                    if answer is None:
                        self._declared_for = event.sequence
                    else:
                        self.end.answer(event.sequence, answer)

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
        text = "another session was opened"
        self._motion.stop(Ending(CommandState.STOPPED, Code.SESSION_ENDED, text))
        self._declaring.give_up()
        self._permission.armed = False
        self._fresh_s = self._clock()
        self.end.open_session(event, self._hello(event.request.nonce))
        self._journal.note("session", name=event.request.name, session=self.end.session)

    def _hello(self, nonce: int) -> Callable[[int], Hello]:
        return lambda session: self._view.hello(nonce, session)

    def _answer(self, request: Message) -> Answer | None:
        seen_ms = getattr(request, "seen_ms", None)
        if seen_ms is not None:
            self._freshen(seen_ms)
        return self._requests.answer(request)

    def _freshen(self, seen_ms: int) -> None:
        """The control loop is alive and hears us: only that feeds the deadman."""
        if rules.is_fresh(self._now_ms(), seen_ms, self._view.stale_after_ms):
            self._fresh_s = self._clock()

    # --- what is due --------------------------------------------------------------------------

    def tick(self) -> None:
        """Deadman, begin of an accepted motion, progress of a running one. Call often."""
        now_s = self._clock()
        stalled_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self.armed or self._motion.goes_on:
            if stalled_s > self.settings.deadman_s:
                self.stop_for(Code.LOOP_STALLED, f"the bridge stalled for {stalled_s:.1f} s")
            elif now_s - self._fresh_s > self.settings.deadman_s:
                text = f"nothing heard from the service for {now_s - self._fresh_s:.2f} s"
                self.stop_for(Code.LINK_LOST, text)
        self._motion.begin_if_due()
        if self._declaring.under_way and not self._declaring.just_begun:
            self._answer_late(self._requests.go_on_declaring())
        self._declaring.just_begun = False
        self._follow_motors(now_s)

    def _answer_late(self, answer: Answer | None) -> None:
        if answer is not None:
            self.end.answer(self._declared_for, answer)

    def _follow_motors(self, now_s: float) -> None:
        status = self.motors.status
        in_haste = self.moving or status.setting_up or status.locating
        period_s = self.settings.motion_poll_s if in_haste else IDLE_POLL_S
        if not self.motors.poll_if_due(period_s):
            return
        self._motion.heed_uncertainty()
        if self.moving:
            self._motion.follow(now_s)
        else:
            self._follow_idle_motors()
        if self.motors.stop_unconfirmed:
            self.motors.stop_again_if_due()

    def _follow_idle_motors(self) -> None:
        status = self.motors.status
        if status.locating:
            return  # a stop would end the question where it stands, again and again
        if status.moving:
            self._stop_stray_motion()
        elif status.fault is not None and self.armed:
            self.stop_for(Code.MOTOR_FAULT, status.fault_text)
        elif self.phase is WorkPhase.EMERGENCY:
            self.motors.park_again_if_due()

    def _stop_stray_motion(self) -> None:
        self._motion.note_stray()
        if self.stopped:
            self.motors.stop()
        else:
            self.stop_for(Code.MOTOR_FAULT, "an axis moves without a command")

    # --- stops --------------------------------------------------------------------------------

    def stop_for(self, code: Code, text: str) -> None:
        """Stop and latch for a reason of our own (deadman, guardian, line, motors)."""
        self.motors.stop()
        self._latch(code, text)

    def _latch(self, code: Code, text: str, *, emergency: bool = False) -> None:
        self._motion.decide_end(Ending(CommandState.STOPPED, code, text))
        if self._declaring.under_way:
            self._answer_late(self._requests.give_up_declaring())
        stop = self._permission.latch(code, emergency=emergency)
        if stop.emergency:
            self._motion.note_parking()
            if (problem := self.motors.park()) is not None:
                self._journal.note("park_failed", text=problem)
        self._journal.latch_stop(stop, text)

    def shut_down(self) -> None:
        """Stop and give the command in flight its end. Idempotent; each step on its own."""
        self._permission.armed = False
        self.motors.stop()
        text = "the bridge shut down"
        self._motion.decide_end(Ending(CommandState.STOPPED, Code.SHUTTING_DOWN, text))
