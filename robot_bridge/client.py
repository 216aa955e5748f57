"""The service's end of the line to the bridge, pumped by one control thread.

The control loop that calls `pump` is what the bridge's deadman listens to: heartbeats leave only
from inside `pump` and the calls that block (`open`, `move`, ...), never from a thread of their own.
`request_stop` alone may be called from any thread.
"""

import contextlib
import secrets
import time
from collections.abc import Callable, Mapping

from robot_bridge import messages
from robot_bridge.client_values import (
    BridgeError,
    BridgeStatus,
    Hello,
    IncompatibleError,
    LinkCounters,
    LinkLostError,
    MoveOutcome,
    RefusedError,
    hello_of,
    status_of,
)
from robot_bridge.messages import (
    SETPOINT_MAX_UM,
    Code,
    CommandState,
    Heartbeat,
    MessageError,
)
from robot_bridge.phases import WorkPhase
from robot_bridge.service_end import (
    Answered,
    GaveUp,
    HelloReceived,
    ServiceEnd,
    ServiceEvent,
    SessionLost,
    StatusReceived,
    StopAcknowledged,
)
from robot_bridge.stopper import STOP_REPEAT_S, Stopper
from robot_bridge.transport import SerialTransport, Transport, TransportError

__all__ = [
    "BridgeClient",
    "BridgeError",
    "BridgeStatus",
    "Hello",
    "IncompatibleError",
    "LinkCounters",
    "LinkLostError",
    "MoveOutcome",
    "RefusedError",
]

MOTION_HEARTBEAT_S = 0.05
HELLO_PAUSE_S = 0.05
CLOSE_WAIT_S = 1.0


class BridgeClient:
    """One session after the other over one line. Not thread-safe except `request_stop`."""

    def __init__(
        self,
        url: str,
        *,
        name: str = "service",
        baud: int = 115200,
        heartbeat_s: float = 0.2,
        deadman_s: float = 1.0,
        open_transport: Callable[[], Transport] | None = None,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
        random_bits: Callable[[int], int] = secrets.randbits,
        stop_thread: bool = True,
    ) -> None:
        """The last five replace line, time and chance, for a client that lives in virtual time."""
        self._url = url
        self._name = name
        self._heartbeat_s = heartbeat_s
        self._deadman_s = deadman_s
        self._open_transport = open_transport or (lambda: SerialTransport(url, baud))
        # STOP goes out even if another program has the line.
        self._open_for_stop = open_transport or (
            lambda: SerialTransport(url, baud, exclusive=False)
        )
        self._clock = clock
        self._pause = pause
        self._end = ServiceEnd()
        self._transport: Transport | None = None
        self._hello: messages.Hello | None = None
        self._status: messages.Status | None = None
        self._status_s = 0.0
        self._answered_sequence = 0
        self._waiting_since_s: float | None = None
        self._beat_s = 0.0
        self._hastily = False
        self._seen_ms = 0
        self._known_motion = ""
        self._answer: messages.Answer | None = None
        self._sessions = 0
        self._random_bits = random_bits
        self._stopper = Stopper(self._write_stop, clock, random_bits, threaded=stop_thread)

    # --- session ------------------------------------------------------------------------------

    def open(self, timeout_s: float = 5.0) -> Hello:
        """Open the port and a session (again). Raises LinkLostError or IncompatibleError.

        A session begins disarmed. Opening one ends any other and stops its motion.
        """
        until_s = self._clock() + timeout_s
        boot_before = self._hello.boot_id if self._hello else None
        self._hello = None
        while self._hello is None:
            try:
                self._say_hello()
                self._await_hello(until_s)
            except LinkLostError as error:
                self._drop_transport()
                if self._clock() >= until_s:
                    raise LinkLostError(f"{self._url}: no bridge answers: {error}") from error
                self._pause(HELLO_PAUSE_S)
        hello = self._hello
        if hello.code != Code.OK:
            raise IncompatibleError(f"{self._url}: {hello.text}")
        self._sessions += 1
        self._status = None
        self._seen_ms = hello.now_ms
        self._known_motion = hello.last_motion
        self._refresh()
        changed = boot_before is not None and boot_before != hello.boot_id
        return hello_of(hello, changed)

    def _say_hello(self) -> None:
        if self._transport is None:
            try:
                self._transport = self._open_transport()
            except TransportError as error:
                raise LinkLostError(str(error)) from error
            self._end.forget_input()
        self._waiting_since_s = None
        self._answered_sequence = 0
        self._end.say_hello(self._random_bits(52), self._name, self._clock())
        self._flush()

    def _await_hello(self, until_s: float) -> None:
        while self._hello is None:
            if self._clock() >= until_s:
                raise LinkLostError("no answer to hello in time")
            self._receive(min(0.02, max(0.0, until_s - self._clock())))

    @property
    def is_open(self) -> bool:
        return self._transport is not None and self._end.session is not None

    def close(self) -> None:
        """See a STOP through, disarm if possible, release the port. Idempotent."""
        try:
            until_s = self._clock() + CLOSE_WAIT_S
            while self.is_open and self._stopper.pending and self._clock() < until_s:
                self.pump(STOP_REPEAT_S)
            if self.is_open and self._status is not None and self._status.armed:
                self._request(messages.Disarm(by=self._name))
        except BridgeError:
            pass  # the bridge's deadman does what the disarming would have done
        finally:
            self._stopper.close()
            self._drop_transport()

    # --- what the control loop calls ----------------------------------------------------------

    def pump(self, wait_s: float = 0.0) -> None:
        """Receive for `wait_s` and send what is due. Raises LinkLostError when the bridge is silent
        for longer than `deadman_s`, or says that the session ended.
        """
        until_s = self._clock() + wait_s
        while True:
            self._beat_if_due()
            left_s = until_s - self._clock()
            self._receive(min(max(left_s, 0.0), self._period_s() / 4))
            if left_s <= 0:
                return

    @property
    def status(self) -> BridgeStatus:
        """The newest status. Raises LinkLostError before the first `open`."""
        if self._status is None:
            raise LinkLostError(f"{self._url}: no status yet; the session is not open")
        return status_of(self._status, self._clock() - self._status_s)

    @property
    def counters(self) -> LinkCounters:
        here, there = self._end.counters, self._status
        return LinkCounters(
            frames_sent=here.sent,
            frames_received=here.received,
            frames_bad=here.bad + here.malformed,
            frames_resent=here.resent,
            frames_stale=here.stale + here.wrong_session,
            own_echoes=here.own_echoes,
            bridge_frames_bad=there.frames_bad if there else 0,
            bridge_refused=there.refused if there else 0,
            sessions=self._sessions,
            stops_sent=self._stopper.sent,
            round_trip_s=self._end.round_trip.smoothed_s,
        )

    # --- requests -----------------------------------------------------------------------------

    def arm(self, by: str) -> None:
        """Allow motion. Refused while a stop is latched (then `rearm`) or a fault stands."""
        self._refuse_while_stopping()
        seen_ms, stop_count = self._seen(), self.status.stop_count
        self._ask(messages.Arm(by=by, stop_count=stop_count, seen_ms=seen_ms))

    def disarm(self, by: str) -> None:
        """Forbid motion; a running one is stopped. Always accepted."""
        self._ask(messages.Disarm(by=by))

    def rearm(self, by: str) -> None:
        """Operator only: clear the latched stop that `status` shows, and arm. Phase: START_UP."""
        self._refuse_while_stopping()
        seen_ms, stop_count = self._seen(), self.status.stop_count
        self._ask(messages.Rearm(by=by, stop_count=stop_count, seen_ms=seen_ms))

    def set_phase(self, phase: WorkPhase, by: str) -> None:
        """Change the work phase as phases.ALLOWED allows; refused during a motion."""
        self._ask(messages.SetPhase(phase=str(phase), by=by, seen_ms=self._seen()))

    def set_insertion_lock(self, locked: bool, by: str) -> None:
        """Lock before READY, unlock when the needle is out. Locking stops a running motion."""
        self._ask(messages.SetInsertionLock(locked=locked, by=by, seen_ms=self._seen()))

    def declare_position(self, positions_um: Mapping[str, int], by: str) -> None:
        """The robot stands at these positions (measured); positions are certain afterwards."""
        positions = _checked_um(positions_um)
        self._ask(messages.DeclarePosition(positions_um=positions, by=by, seen_ms=self._seen()))
        self._known_motion = self.status.last_motion

    def move(
        self,
        command_id: str,
        setpoints_um: Mapping[str, int],
        measurement_id: str | None,
        on_state: Callable[[CommandState, BridgeStatus], None] | None = None,
        *,
        based_on_motion: str | None = None,
    ) -> MoveOutcome:
        """Move all axes to absolute setpoints; block, pumping, until the command has ended.

        command_id is unique for ever: asking again for one that the bridge knows answers from its
        journal and moves nothing. measurement_id: the measurement that the plan rests on (None for
        moves that rest on none); a measurement is outdated once a motion rested on it.
        based_on_motion: `last_motion` as it stood when that measurement was taken (default: the
        last motion this client knows of); the bridge refuses the move if anything moved since.

        Returns the final outcome, refusals included. Raises LinkLostError if the link is lost
        first: open() again, then ask for the same command_id.
        """
        try:
            setpoints = _checked_um(setpoints_um)
        except RefusedError as error:
            return MoveOutcome(command_id, CommandState.REFUSED, error.code, error.text, {})
        based_on = self._known_motion if based_on_motion is None else based_on_motion
        request = messages.Move(
            command_id=command_id,
            setpoints_um=setpoints,
            measurement_id=measurement_id,
            based_on_motion=based_on,
            seen_ms=self._seen(),
        )
        return self._command(request, command_id, on_state)

    def home(self, command_id: str, by: str) -> MoveOutcome:
        """Search the axes' references; afterwards positions are certain. Blocks like `move`."""
        request = messages.Home(command_id=command_id, by=by, seen_ms=self._seen())
        return self._command(request, command_id, None)

    # --- STOP ---------------------------------------------------------------------------------

    def request_stop(self, *, emergency: bool = False) -> None:
        """From any thread, with or without a session: send STOP now and repeat it until the bridge
        acknowledged it. EMERGENCY also parks the drives. Returns at once.
        """
        self._stopper.request(emergency)

    @property
    def stop_acknowledged(self) -> bool:
        """Whether every stop that was requested has been acknowledged."""
        return not self._stopper.pending

    def _write_stop(self, encoded: bytes) -> None:
        """Called by the stopper's threads; must not touch anything but the transport."""
        transport = self._transport
        if transport is not None:
            transport.write(encoded)
            return
        transport = self._open_for_stop()
        try:
            transport.write(encoded)
        finally:
            transport.close()

    def _refuse_while_stopping(self) -> None:
        if self._stopper.pending:
            raise RefusedError(Code.STOP_LATCHED, "a STOP is under way; re-arm after it arrived")

    # --- inside -------------------------------------------------------------------------------

    def _command(
        self,
        request: messages.Move | messages.Home,
        command_id: str,
        on_state: Callable[[CommandState, BridgeStatus], None] | None,
    ) -> MoveOutcome:
        try:
            answer = self._request(request)
        except MessageError as error:
            return MoveOutcome(command_id, CommandState.REFUSED, Code.MALFORMED, str(error), {})
        state = CommandState(answer.state) if answer.state else CommandState.REFUSED
        code, text = answer.code, answer.text
        readback: Mapping[str, int] = answer.readback_um
        self._hastily = True
        try:
            self._refresh()
            while not state.final:
                before = state
                state, code, text, readback = self._progress(command_id, state)
                if on_state is not None and state != before:
                    on_state(state, self.status)
        finally:
            self._hastily = False
        if self.status.last_motion == command_id:
            self._known_motion = command_id
        return MoveOutcome(command_id, state, code, text, readback)

    def _progress(
        self, command_id: str, state: CommandState
    ) -> tuple[CommandState, str, str, Mapping[str, int]]:
        """How the command stands after a little more pumping."""
        self.pump(0.01)
        status = self.status
        if status.command_id != command_id or status.command_state is None:
            return state, Code.OK, "", {}
        raw = self._status
        readback = raw.command_readback_um if raw else {}
        return status.command_state, status.command_code, status.command_text, readback

    def _ask(self, request: messages.Message) -> None:
        """A request that is done or refused at once; afterwards `status` shows its effect."""
        try:
            answer = self._request(request)
        except MessageError as error:
            raise RefusedError(Code.MALFORMED, str(error)) from error
        self._refresh()
        if answer.code != Code.OK:
            raise RefusedError(answer.code, answer.text)

    def _request(self, request: messages.Message) -> messages.Answer:
        self._check_session()
        self._answer = None
        self._end.send_request(request, self._clock())
        self._wait_from_now()
        self._flush()
        while self._answer is None:
            self._beat_if_due()
            self._receive(0.01)
        return self._answer

    def _refresh(self) -> None:
        """Wait for a status that the bridge made after now."""
        wanted = self._beat()
        while self._answered_sequence < wanted:
            if not self._end.awaits_answer(self._clock()):
                self._beat()
            self._receive(0.01)

    def _seen(self) -> int:
        """The newest bridge clock we saw, asked for again if it is not so new any more."""
        self._check_session()
        if self._clock() - self._status_s > min(self._heartbeat_s, self._deadman_s / 4):
            self._refresh()
        return self._seen_ms

    def _check_session(self) -> None:
        if not self.is_open:
            raise LinkLostError(f"{self._url}: the session is not open")

    def _check_heard(self, now_s: float) -> None:
        if self._waiting_since_s is None or self._end.session is None:
            return
        silent_s = now_s - self._waiting_since_s
        if silent_s > self._deadman_s:
            self._lose(f"nothing heard from the bridge for {silent_s:.1f} s")

    def _wait_from_now(self) -> None:
        if self._waiting_since_s is None:
            self._waiting_since_s = self._clock()

    def _lose(self, text: str) -> None:
        self._end.session = None
        self._end.abandon_request()
        raise LinkLostError(f"{self._url}: {text}")

    def _period_s(self) -> float:
        return min(self._heartbeat_s, MOTION_HEARTBEAT_S) if self._hastily else self._heartbeat_s

    def _beat_if_due(self) -> None:
        self._check_session()
        now_s = self._clock()
        since_s, period_s = now_s - self._beat_s, self._period_s()
        # While the bridge may be speaking, wait; but not for ever, it must hear from us.
        patience_s = 2 * self._heartbeat_s if self._end.awaits_answer(now_s) else period_s
        if since_s >= patience_s:
            self._beat()

    def _beat(self) -> int:
        self._check_session()
        self._beat_s = self._clock()
        sequence = self._end.send_heartbeat(Heartbeat(seen_ms=self._seen_ms), self._beat_s)
        self._wait_from_now()
        self._flush()
        return sequence

    def _flush(self) -> None:
        data = self._end.take_output()
        if not data or self._transport is None:
            return
        try:
            self._transport.write(data)
        except TransportError as error:
            self._drop_transport()
            self._lose(str(error))

    def _receive(self, wait_s: float) -> None:
        assert self._transport is not None
        try:
            data = self._transport.read(wait_s)
        except TransportError as error:
            self._drop_transport()
            self._lose(str(error))
        now_s = self._clock()
        for event in [*self._end.receive(data, now_s), *self._end.tick(now_s)]:
            self._act(event, now_s)
        self._flush()
        self._stopper.repeat_if_due()
        self._check_heard(now_s)

    def _act(self, event: ServiceEvent, now_s: float) -> None:
        match event:
            case StopAcknowledged():
                self._stopper.acknowledged(event.nonce)
                self._beat_s = -1e9  # what the stop changed is wanted soon
            case HelloReceived():
                self._waiting_since_s = None
                self._hello = event.hello
            case StatusReceived():
                self._waiting_since_s = None
                self._answered_sequence = max(self._answered_sequence, event.sequence)
                self._take_status(event.status, now_s)
            case Answered():
                self._waiting_since_s = None
                self._answer = event.answer
            case SessionLost():
                self._lose(
                    "the bridge does not know this session (it restarted, or another opened)"
                )
            case GaveUp():
                self._lose(f"no answer after {event.tries} tries")

    def _take_status(self, status: messages.Status, now_s: float) -> None:
        # A delayed status is older than one already here.
        if self._status is not None and status.now_ms < self._status.now_ms:
            return
        self._status = status
        self._status_s = now_s
        self._seen_ms = max(self._seen_ms, status.now_ms)

    def _drop_transport(self) -> None:
        transport, self._transport = self._transport, None
        if transport is not None:
            # It may be gone already; then nothing is left to release.
            with contextlib.suppress(TransportError):
                transport.close()


def _checked_um(positions_um: Mapping[str, int]) -> dict[str, int]:
    """Whole micrometres that fit the wire. Raises RefusedError (NaN, floats, huge numbers)."""
    for axis, value in positions_um.items():
        if type(value) is not int or not abs(value) <= SETPOINT_MAX_UM:
            text = (
                f"axis {str(axis)[:40]!r}: {str(value)[:40]} is not a whole number of um in range"
            )
            raise RefusedError(Code.MALFORMED, text)
    return dict(positions_um)
