"""The bridge's end of the protocol: bytes in, events out, without I/O, threads or a clock.

It speaks only when it is spoken to, so the line may be half duplex. (An answer that took long may
meet the request's repetition there; both are sent again.) A request that is repeated is
answered with the recorded answer, never executed again.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from robot_bridge.protocol import framing
from robot_bridge.protocol.framing import Deframer, Frame, FrameCounters, StopFrame
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
