"""The protocol of both ends, bytes in and events out, without I/O, threads or a clock.

Stop-and-wait: the service has one request in flight and sends the same bytes again until it is
answered; the bridge answers a repeated request with the recorded answer. The bridge speaks only
when it is spoken to, so the line may be half duplex; only STOP is sent regardless.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from robot_bridge import framing
from robot_bridge.framing import Deframer, Frame, FrameCounters, StopAckFrame, StopFrame
from robot_bridge.messages import (
    PROTOCOL_VERSION,
    SCHEMA,
    Answer,
    Code,
    Heartbeat,
    Hello,
    HelloRequest,
    Message,
    MessageError,
    NoSession,
    Status,
    pack,
    unpack,
)


@dataclass(frozen=True)
class StopReceived:
    nonce: int
    emergency: bool


@dataclass(frozen=True)
class SessionOpened:
    """A service said hello: whatever session there was has ended. Answer with `open_session`."""

    request: HelloRequest


@dataclass(frozen=True)
class HeartbeatReceived:
    heartbeat: Heartbeat
    sequence: int


@dataclass(frozen=True)
class RequestReceived:
    """A request seen for the first time: execute it once and answer it."""

    request: Message
    sequence: int


@dataclass(frozen=True)
class MalformedReceived:
    """A frame that passed its checksum but holds no request of ours."""

    text: str
    sequence: int


BridgeEvent = StopReceived | SessionOpened | HeartbeatReceived | RequestReceived | MalformedReceived


class BridgeEnd:
    """The bridge's end. Feed bytes to `receive`, act on the events, send `take_output()`."""

    def __init__(self, boot_id: str, new_session: Callable[[], int]) -> None:
        self.counters = FrameCounters()
        self.session: int | None = None
        self._boot_id = boot_id
        self._new_session = new_session
        self._deframer = Deframer(self.counters)
        self._output = bytearray()
        self._nonce: int | None = None
        self._hello = b""
        self._old_nonces: deque[int] = deque(maxlen=1024)
        self._last_sequence = 0
        self._last_request: bytes | None = None
        self._last_answer = b""

    def take_output(self) -> bytes:
        output = bytes(self._output)
        self._output.clear()
        return output

    def _send(self, encoded: bytes) -> None:
        self.counters.sent += 1
        self._output += encoded

    def receive(self, data: bytes) -> Iterator[BridgeEvent]:
        """What `data` says. Every STOP in it comes first, wherever it stood.

        Act on each event before taking the next one: a frame is judged by the session that stands
        when its turn comes.
        """
        frames = self._deframer.feed(data)
        for frame in frames:
            if isinstance(frame, StopFrame):
                self.counters.stops += 1
                yield StopReceived(frame.nonce, frame.emergency)
        for frame in frames:
            if isinstance(frame, Frame) and not frame.from_bridge:
                yield from self._receive_frame(frame)
            elif not isinstance(frame, StopFrame):
                self.counters.own_echoes += 1

    def _receive_frame(self, frame: Frame) -> list[BridgeEvent]:
        if frame.kind == HelloRequest.KIND:
            return self._receive_hello(frame)
        if self.session is None or frame.session != self.session:
            self.counters.wrong_session += 1
            refusal = Frame(
                NoSession.KIND, frame.session, frame.sequence, pack(NoSession(self._boot_id))
            )
            self._send(framing.encode(refusal))
            return []
        if frame.kind == Heartbeat.KIND:
            return self._receive_heartbeat(frame)
        return self._receive_request(frame)

    def _receive_hello(self, frame: Frame) -> list[BridgeEvent]:
        try:
            request = unpack(frame.kind, frame.payload)
        except MessageError:
            self.counters.malformed += 1
            return []
        assert isinstance(request, HelloRequest)
        if request.nonce == self._nonce:
            self.counters.repeated += 1
            self._send(self._hello)
            return []
        if request.nonce in self._old_nonces:
            self.counters.stale += 1
            return []
        if request.protocol != PROTOCOL_VERSION or request.schema != SCHEMA:
            self._refuse_hello(request)
            return []
        return [SessionOpened(request)]

    def _refuse_hello(self, request: HelloRequest) -> None:
        text = (
            f"bridge speaks protocol {PROTOCOL_VERSION}, schema {SCHEMA}; service protocol "
            f"{request.protocol}, schema {request.schema}"
        )
        hello = Hello(
            nonce=request.nonce, code=Code.SCHEMA_MISMATCH, text=text[:240],
            protocol=PROTOCOL_VERSION, schema=SCHEMA, software="", session=0,
            boot_id=self._boot_id, now_ms=0, axes=(), position_certain=False, last_motion="",
        )  # fmt: skip
        self._send(framing.encode(Frame(Hello.KIND, 0, 0, pack(hello))))

    def _receive_heartbeat(self, frame: Frame) -> list[BridgeEvent]:
        try:
            heartbeat = unpack(frame.kind, frame.payload)
        except MessageError:
            self.counters.malformed += 1
            return []
        assert isinstance(heartbeat, Heartbeat)
        return [HeartbeatReceived(heartbeat, frame.sequence)]

    def _receive_request(self, frame: Frame) -> list[BridgeEvent]:
        identity = bytes([frame.kind]) + frame.payload
        if frame.sequence == self._last_sequence and identity == self._last_request:
            self.counters.repeated += 1
            self._send(self._last_answer)
            return []
        if frame.sequence <= self._last_sequence:
            self.counters.stale += 1
            return []
        self._last_sequence = frame.sequence
        self._last_request = identity
        self._last_answer = b""
        try:
            return [RequestReceived(unpack(frame.kind, frame.payload), frame.sequence)]
        except MessageError as error:
            self.counters.malformed += 1
            return [MalformedReceived(str(error)[:240], frame.sequence)]

    def open_session(self, opened: SessionOpened, hello: Callable[[int], Hello]) -> None:
        """End the old session, begin a new one and answer with `hello(session)`."""
        if opened.request.nonce == self._nonce:  # twice in one read
            self._send(self._hello)
            return
        if self._nonce is not None:
            self._old_nonces.append(self._nonce)
        self.session = self._new_session()
        self._nonce = opened.request.nonce
        self._last_sequence = 0
        self._last_request = None
        self._hello = framing.encode(Frame(Hello.KIND, self.session, 0, pack(hello(self.session))))
        self._send(self._hello)

    def answer(self, sequence: int, answer: Answer) -> None:
        """Answer the request `sequence`, and keep the answer for its repetitions."""
        assert self.session is not None
        self._last_answer = framing.encode(Frame(Answer.KIND, self.session, sequence, pack(answer)))
        self._send(self._last_answer)

    def send_status(self, sequence: int, status: Status) -> None:
        assert self.session is not None
        self._send(framing.encode(Frame(Status.KIND, self.session, sequence, pack(status))))

    def acknowledge_stop(self, stop: StopReceived) -> None:
        self._send(framing.encode_stop_ack(stop.nonce, stop.emergency))


# --- the service's end ------------------------------------------------------------------------


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
