"""The service's end of the protocol: bytes in, events out, without I/O, threads or a clock.

Stop-and-wait: one request in flight; the same bytes are sent again until it is answered, or it is
given up. STOP does not pass through here: it needs no session and no turn.
"""

from dataclasses import dataclass

from robot_bridge.protocol import framing
from robot_bridge.protocol.framing import Deframer, Frame, FrameCounters, StopAckFrame, StopFrame
from robot_bridge.protocol.messages import (
    PROTOCOL_VERSION,
    Answer,
    Code,
    Heartbeat,
    Hello,
    HelloRequest,
    Message,
    NoSession,
    Status,
)
from robot_bridge.protocol.packing import SCHEMA, MessageError, pack, unpack


@dataclass(frozen=True)
class HelloReceived:
    hello: Hello


@dataclass(frozen=True)
class Answered:
    answer: Answer


@dataclass(frozen=True)
class StatusReceived:
    """`sequence` is that of the heartbeat which it answers."""

    status: Status
    sequence: int


@dataclass(frozen=True)
class SessionLost:
    """The bridge does not know our session (it restarted, or another service said hello)."""

    boot_id: str


@dataclass(frozen=True)
class GaveUp:
    """The request in flight was sent as often as allowed and never answered."""

    tries: int


@dataclass(frozen=True)
class StopAcknowledged:
    nonce: int


ServiceEvent = HelloReceived | Answered | StatusReceived | SessionLost | GaveUp | StopAcknowledged

FIRST_TIMEOUT_S = 0.15
TIMEOUT_MIN_S = 0.02
TIMEOUT_MAX_S = 0.4
TRIES_MAX = 8


@dataclass
class _InFlight:
    encoded: bytes
    kind: int
    sequence: int
    sent_s: float
    tries: int
    timeout_s: float


class RoundTrip:
    """Smoothed round trip (RFC 6298's weights); repeated frames give no sample (Karn)."""

    def __init__(self) -> None:
        self.smoothed_s: float | None = None

    def sample(self, seconds: float) -> None:
        if self.smoothed_s is None:
            self.smoothed_s = seconds
        self.smoothed_s += (seconds - self.smoothed_s) / 8

    @property
    def timeout_s(self) -> float:
        if self.smoothed_s is None:
            return FIRST_TIMEOUT_S
        return min(max(4 * self.smoothed_s, TIMEOUT_MIN_S), TIMEOUT_MAX_S)


class ServiceEnd:
    """The service's end. `now_s` is the caller's monotonic clock."""

    def __init__(self) -> None:
        self.counters = FrameCounters()
        self.round_trip = RoundTrip()
        self.session: int | None = None
        self._deframer = Deframer(self.counters)
        self._output = bytearray()
        self._sequence = 0
        self._nonce: int | None = None
        self._request: _InFlight | None = None
        self._heartbeat: _InFlight | None = None
        self._heartbeat_sequence = 0

    @property
    def busy(self) -> bool:
        """Whether a request is in flight."""
        return self._request is not None

    def awaits_answer(self, now_s: float) -> bool:
        """Whether the bridge may be about to speak: on a half-duplex line, better be silent."""
        waiting = [flight for flight in (self._request, self._heartbeat) if flight]
        return any(now_s < flight.sent_s + flight.timeout_s for flight in waiting)

    def take_output(self) -> bytes:
        output = bytes(self._output)
        self._output.clear()
        return output

    def _send(self, encoded: bytes) -> None:
        self.counters.sent += 1
        self._output += encoded

    def forget_input(self) -> None:
        """After the port was opened anew: half a frame of the old one is no beginning."""
        self._deframer = Deframer(self.counters)

    def say_hello(self, nonce: int, name: str, now_s: float) -> None:
        """Begin a new session; the old one and its request are forgotten."""
        self.session = None
        self._nonce = nonce
        self._sequence = 0
        self._heartbeat = None
        hello = HelloRequest(nonce=nonce, name=name, protocol=PROTOCOL_VERSION, schema=SCHEMA)
        encoded = framing.encode(Frame(HelloRequest.KIND, 0, 0, pack(hello)))
        self._put_in_flight(encoded, HelloRequest.KIND, 0, now_s)

    def send_request(self, request: Message, now_s: float) -> None:
        """Put `request` in flight. Only one may be."""
        assert self.session is not None
        assert self._request is None
        self._sequence += 1
        frame = Frame(request.KIND, self.session, self._sequence, pack(request))
        self._put_in_flight(framing.encode(frame), request.KIND, self._sequence, now_s)

    def _put_in_flight(self, encoded: bytes, kind: int, sequence: int, now_s: float) -> None:
        self._request = _InFlight(encoded, kind, sequence, now_s, 1, self.round_trip.timeout_s)
        self._send(encoded)

    def abandon_request(self) -> None:
        self._request = None

    def send_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> int:
        """Ask for a status; the returned sequence number comes back with it."""
        assert self.session is not None
        self._heartbeat_sequence += 1
        frame = Frame(Heartbeat.KIND, self.session, self._heartbeat_sequence, pack(heartbeat))
        encoded = framing.encode(frame)
        self._heartbeat = _InFlight(
            encoded, Heartbeat.KIND, self._heartbeat_sequence, now_s, 1, self.round_trip.timeout_s
        )
        self._send(encoded)
        return self._heartbeat_sequence

    def tick(self, now_s: float) -> list[ServiceEvent]:
        """Send again what was not answered in time."""
        flight = self._request
        if flight is None or now_s < flight.sent_s + flight.timeout_s:
            return []
        if flight.tries >= TRIES_MAX:
            self._request = None
            return [GaveUp(flight.tries)]
        flight.tries += 1
        flight.sent_s = now_s
        flight.timeout_s = min(2 * flight.timeout_s, TIMEOUT_MAX_S)
        self.counters.resent += 1
        self._send(flight.encoded)
        return []

    def receive(self, data: bytes, now_s: float) -> list[ServiceEvent]:
        events: list[ServiceEvent] = []
        for frame in self._deframer.feed(data):
            if isinstance(frame, StopAckFrame):
                events.append(StopAcknowledged(frame.nonce))
            elif isinstance(frame, StopFrame) or not frame.from_bridge:
                self.counters.own_echoes += 1
            else:
                events.extend(self._receive_frame(frame, now_s))
        return events

    def _receive_frame(self, frame: Frame, now_s: float) -> list[ServiceEvent]:
        try:
            message = unpack(frame.kind, frame.payload)
        except MessageError:
            self.counters.malformed += 1
            return []
        if isinstance(message, Hello):
            return self._receive_hello(message, now_s)
        if self.session is None or frame.session != self.session:
            self.counters.wrong_session += 1
            return []
        if isinstance(message, NoSession):
            self.session = None
            self._request = None
            return [SessionLost(message.boot_id)]
        if isinstance(message, Status):
            self._land(self._heartbeat, frame.sequence, now_s)
            return [StatusReceived(message, frame.sequence)]
        if isinstance(message, Answer):
            return self._receive_answer(frame, message, now_s)
        return []

    def _receive_hello(self, hello: Hello, now_s: float) -> list[ServiceEvent]:
        flight = self._request
        if hello.nonce != self._nonce or flight is None or flight.kind != HelloRequest.KIND:
            self.counters.stale += 1
            return []
        self._land(flight, 0, now_s)
        self._request = None
        if hello.code == Code.OK:
            self.session = hello.session
        return [HelloReceived(hello)]

    def _receive_answer(self, frame: Frame, answer: Answer, now_s: float) -> list[ServiceEvent]:
        flight = self._request
        if flight is None or frame.sequence != flight.sequence:
            self.counters.stale += 1
            return []
        self._land(flight, frame.sequence, now_s)
        self._request = None
        return [Answered(answer)]

    def _land(self, flight: _InFlight | None, sequence: int, now_s: float) -> None:
        if flight is None or sequence != flight.sequence:
            return
        if flight.tries == 1:
            self.round_trip.sample(now_s - flight.sent_s)
        if flight is self._heartbeat:
            self._heartbeat = None
