"""The session with the bridge: hello, heartbeats, one request at a time, the newest status.

Time passes and bytes move only inside `open`, `pump`, `request` and `refresh`; each of them raises
LinkLostError when the line fails, the bridge is silent for longer than `deadman_s`, or it says that
the session ended. After that only `open` helps.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import NoReturn

from robot_bridge.client.client_values import (
    BridgeIdentity,
    BridgeStatus,
    IncompatibleError,
    LinkCounters,
    LinkLostError,
    hello_of,
    status_of,
)
from robot_bridge.client.heartbeats import Heartbeats
from robot_bridge.client.line import Line
from robot_bridge.client.stopper import Stopper
from robot_bridge.protocol import messages
from robot_bridge.protocol.messages import Code, Heartbeat
from robot_bridge.protocol.service_end import (
    Answered,
    GaveUp,
    HelloReceived,
    ServiceEnd,
    ServiceEvent,
    SessionLost,
    StatusReceived,
    StopAcknowledged,
)
from robot_bridge.protocol.transport import TransportError

HELLO_PAUSE_S = 0.05
LISTEN_S = 0.01


class Session:
    """One session after the other over one line.

    `known_motion`: the last motion that the client knows of; a move rests on it by default.
    """

    def __init__(
        self,
        line: Line,
        stopper: Stopper,
        *,
        name: str,
        heartbeat_s: float,
        deadman_s: float,
        clock: Callable[[], float],
        pause: Callable[[float], None],
        random_bits: Callable[[int], int],
    ) -> None:
        self.known_motion = ""
        self._line = line
        self._stopper = stopper
        self._name = name
        self._heartbeat_s = heartbeat_s
        self._deadman_s = deadman_s
        self._clock = clock
        self._pause = pause
        self._random_bits = random_bits
        self._end = ServiceEnd()
        self._heartbeats = Heartbeats(heartbeat_s)
        self._hello: messages.Hello | None = None
        self._status: messages.Status | None = None
        self._status_s = 0.0
        self._answered_sequence = 0
        self._seen_ms = 0
        self._answer: messages.Answer | None = None
        self._opened = 0

    # --- opening ------------------------------------------------------------------------------

    def open(self, timeout_s: float) -> BridgeIdentity:
        """Raises LinkLostError or IncompatibleError."""
        until_s = self._clock() + timeout_s
        boot_before = self._hello.boot_id if self._hello else None
        hello = self._exchange_hellos(until_s)
        if hello.code != Code.OK:
            raise IncompatibleError(f"{self._line.url}: {hello.text}")
        self._opened += 1
        self._status = None
        self._seen_ms = hello.now_ms
        self.known_motion = hello.last_motion
        self.refresh()
        changed = boot_before is not None and boot_before != hello.boot_id
        return hello_of(hello, changed)

    def _exchange_hellos(self, until_s: float) -> messages.Hello:
        self._hello = None
        while self._hello is None:
            try:
                self._say_hello()
                self._await_hello(until_s)
            except LinkLostError as error:
                self._line.drop()
                if self._clock() >= until_s:
                    text = f"{self._line.url}: no answer from a bridge: {error}"
                    raise LinkLostError(text) from error
                self._pause(HELLO_PAUSE_S)
        return self._hello

    def _say_hello(self) -> None:
        if not self._line.is_open:
            try:
                self._line.open()
            except TransportError as error:
                raise LinkLostError(str(error)) from error
            self._end.forget_input()
        self._heartbeats.heard()  # what the old session waited for will never come
        self._answered_sequence = 0
        self._end.say_hello(self._random_bits(52), self._name, self._clock())
        self._flush()

    def _await_hello(self, until_s: float) -> None:
        while self._hello is None:
            if self._clock() >= until_s:
                raise LinkLostError("no answer to hello")
            self._receive(min(0.02, max(0.0, until_s - self._clock())))

    @property
    def is_open(self) -> bool:
        return self._line.is_open and self._end.session is not None

    @property
    def is_armed(self) -> bool:
        """Whether there is a session, and the bridge last said that it is armed."""
        return self.is_open and self._status is not None and self._status.armed

    # --- what is known ------------------------------------------------------------------------

    @property
    def status(self) -> BridgeStatus:
        """The newest status. Raises LinkLostError before the first `open`."""
        if self._status is None:
            raise LinkLostError(f"{self._line.url}: no status yet; the session is not open")
        return status_of(self._status, self._clock() - self._status_s)

    @property
    def command_readback_um(self) -> Mapping[str, int]:
        """Where the axes stood when the command that `status` tells of had ended."""
        return self._status.command_readback_um if self._status else {}

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
            sessions=self._opened,
            stops_sent=self._stopper.sent,
            round_trip_s=self._end.round_trip.smoothed_s,
        )

    def seen_ms(self) -> int:
        """The newest bridge clock we saw, asked for again if it is not so new any more."""
        self._require_open()
        if self._clock() - self._status_s > min(self._heartbeat_s, self._deadman_s / 4):
            self.refresh()
        return self._seen_ms

    # --- what takes time ----------------------------------------------------------------------

    def pump(self, wait_s: float) -> None:
        """Receive for `wait_s` and send what is due."""
        until_s = self._clock() + wait_s
        while True:
            self._beat_if_due()
            left_s = until_s - self._clock()
            self._receive(min(max(left_s, 0.0), self._heartbeats.period_s / 4))
            if left_s <= 0:
                return

    def request(self, request: messages.Message) -> messages.Answer:
        """Raises MessageError if it cannot be packed."""
        self._require_open()
        self._answer = None
        self._end.send_request(request, self._clock())
        self._heartbeats.wait_from(self._clock())
        self._flush()
        while self._answer is None:
            self._beat_if_due()
            self._receive(LISTEN_S)
        return self._answer

    def refresh(self) -> None:
        """Wait for a status that the bridge made after now."""
        wanted = self._beat()
        while self._answered_sequence < wanted:
            if not self._end.awaits_answer(self._clock()):
                self._beat()
            self._receive(LISTEN_S)

    @contextlib.contextmanager
    def in_haste(self) -> Iterator[None]:
        """With faster heartbeats, to follow a motion."""
        self._heartbeats.hastily = True
        try:
            yield
        finally:
            self._heartbeats.hastily = False

    # --- sending ------------------------------------------------------------------------------

    def _beat_if_due(self) -> None:
        self._require_open()
        now_s = self._clock()
        if self._heartbeats.due(now_s, awaits_answer=self._end.awaits_answer(now_s)):
            self._beat()

    def _beat(self) -> int:
        self._require_open()
        now_s = self._clock()
        self._heartbeats.sent(now_s)
        sequence = self._end.send_heartbeat(Heartbeat(seen_ms=self._seen_ms), now_s)
        self._heartbeats.wait_from(now_s)
        self._flush()
        return sequence

    def _flush(self) -> None:
        try:
            self._line.write(self._end.take_output())
        except TransportError as error:
            self._lose(str(error))

    # --- receiving ----------------------------------------------------------------------------

    def _receive(self, wait_s: float) -> None:
        try:
            data = self._line.read(wait_s)
        except TransportError as error:
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
                self._heartbeats.hurry()  # what the stop changed is wanted soon
            case HelloReceived():
                self._heartbeats.heard()
                self._hello = event.hello
            case StatusReceived():
                self._heartbeats.heard()
                self._answered_sequence = max(self._answered_sequence, event.sequence)
                self._take_status(event.status, now_s)
            case Answered():
                self._heartbeats.heard()
                self._answer = event.answer
            case SessionLost():
                self._lose(
                    "the bridge does not know this session (it has restarted, or another session "
                    "was opened)"
                )
            case GaveUp():
                self._lose(f"no answer after {event.tries} attempts")

    def _take_status(self, status: messages.Status, now_s: float) -> None:
        # A delayed status is older than one already here.
        if self._status is not None and status.now_ms < self._status.now_ms:
            return
        self._status = status
        self._status_s = now_s
        self._seen_ms = max(self._seen_ms, status.now_ms)

    # --- losing it ----------------------------------------------------------------------------

    def _require_open(self) -> None:
        if not self.is_open:
            raise LinkLostError(f"{self._line.url}: the session is not open")

    def _check_heard(self, now_s: float) -> None:
        silent_s = self._heartbeats.silent_s(now_s)
        if self._end.session is not None and silent_s > self._deadman_s:
            self._lose(f"nothing heard from the bridge for {silent_s:.1f} s")

    def _lose(self, text: str) -> NoReturn:
        self._end.session = None
        self._end.abandon_request()
        raise LinkLostError(f"{self._line.url}: {text}")

    def close(self) -> None:
        """Let go of the line. Idempotent."""
        self._line.drop()
