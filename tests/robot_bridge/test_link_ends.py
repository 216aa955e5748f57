"""The two ends of the protocol, case by case (test_two_sides explores them at random)."""

import itertools

import pytest

from robot_bridge.protocol import framing
from robot_bridge.protocol.bridge_end import (
    BridgeEnd,
    MalformedReceived,
    RequestReceived,
    SessionOpened,
)
from robot_bridge.protocol.framing import Deframer, Frame, FrameCounters
from robot_bridge.protocol.messages import (
    PROTOCOL_VERSION,
    Answer,
    Disarm,
    Hello,
    HelloRequest,
)
from robot_bridge.protocol.packing import SCHEMA, pack
from robot_bridge.protocol.service_end import TRIES_MAX, Answered, GaveUp, ServiceEnd, SessionLost


def hello_of(nonce: int):
    return lambda session: Hello(
        nonce=nonce, code="ok", text="", protocol=PROTOCOL_VERSION, schema=SCHEMA, software="",
        session=session, boot_id="boot", now_ms=0, axes=(), position_certain=False, last_motion="",
    )  # fmt: skip


class Pair:
    def __init__(self) -> None:
        numbers = itertools.count(7)
        self.bridge = BridgeEnd("boot", lambda: next(numbers))
        self.service = ServiceEnd()
        self.executed: list[str] = []

    def to_bridge(self, data: bytes) -> bytes:
        for event in self.bridge.receive(data):
            match event:
                case SessionOpened():
                    self.bridge.open_session(event, hello_of(event.request.nonce))
                case RequestReceived():
                    assert isinstance(event.request, Disarm)
                    self.executed.append(event.request.by)
                    answer = Answer("ok", event.request.by, None, {})
                    self.bridge.answer(event.sequence, answer)
                case MalformedReceived():
                    self.bridge.answer(event.sequence, Answer("malformed", event.text, None, {}))
        return self.bridge.take_output()

    def hello(self, nonce: int) -> bytes:
        """Returns the frame, after both sides have seen it and its answer."""
        self.service.say_hello(nonce, "test", 0.0)
        frame = self.service.take_output()
        self.service.receive(self.to_bridge(frame), 0.0)
        assert self.service.session == self.bridge.session
        return frame

    def request(self, by: str, now_s: float = 0.0) -> bytes:
        self.service.send_request(Disarm(by=by), now_s)
        return self.service.take_output()


def test_an_old_hello_that_comes_again_ends_no_session():
    pair = Pair()
    old = pair.hello(1)
    pair.hello(2)
    session = pair.bridge.session
    assert pair.to_bridge(old) == b""
    assert pair.bridge.session == session
    assert pair.bridge.counters.stale == 1


def test_a_hello_repeated_in_the_same_read_opens_one_session():
    pair = Pair()
    pair.service.say_hello(1, "test", 0.0)
    frame = pair.service.take_output()
    answers = Deframer(FrameCounters()).feed(pair.to_bridge(frame + frame))
    assert len(answers) == 2
    assert answers[0] == answers[1]
    assert pair.bridge.session == 7


def test_a_repeated_request_gets_the_recorded_answer_byte_for_byte():
    pair = Pair()
    pair.hello(1)
    frame = pair.request("a")
    first = pair.to_bridge(frame)
    assert pair.to_bridge(frame) == first
    assert pair.executed == ["a"]
    assert pair.bridge.counters.repeated == 1


def test_an_older_request_is_dropped_without_an_answer():
    pair = Pair()
    pair.hello(1)
    old = pair.request("a")
    pair.service.receive(pair.to_bridge(old), 0.0)
    pair.service.receive(pair.to_bridge(pair.request("b")), 0.0)
    assert pair.to_bridge(old) == b""
    assert pair.executed == ["a", "b"]


def test_the_same_sequence_number_with_other_content_is_dropped():
    pair = Pair()
    pair.hello(1)
    pair.to_bridge(pair.request("a"))
    forged = Frame(Disarm.KIND, 7, 1, pack(Disarm(by="b")))
    assert pair.to_bridge(framing.encode(forged)) == b""
    assert pair.executed == ["a"]


def test_a_late_answer_to_an_earlier_request_is_not_taken_for_the_answer():
    pair = Pair()
    pair.hello(1)
    late = pair.to_bridge(pair.request("a"))
    pair.service.abandon_request()
    right = pair.to_bridge(pair.request("b"))
    assert pair.service.receive(late, 0.0) == []
    assert pair.service.counters.stale == 1
    (event,) = pair.service.receive(right, 0.0)
    assert isinstance(event, Answered)
    assert event.answer.text == "b"


def test_the_same_bytes_are_sent_again_with_doubling_pauses_and_then_given_up():
    service = Pair()
    service.hello(1)
    end = service.service
    frame = service.request("a", now_s=0.0)
    sent_s, now_s, events = [0.0], 0.0, []
    while not events:
        now_s += 0.001
        events = end.tick(now_s)
        output = end.take_output()
        if output:
            assert output == frame
            sent_s.append(now_s)
    assert isinstance(events[0], GaveUp)
    assert len(sent_s) == TRIES_MAX
    pauses = [b - a for a, b in itertools.pairwise(sent_s)]
    assert all(b >= a - 0.002 for a, b in itertools.pairwise(pauses))
    assert pauses[1] == pytest.approx(2 * pauses[0], abs=0.003)
    assert now_s < 4.0


def test_the_first_timeout_is_four_smoothed_round_trips():
    pair = Pair()
    pair.hello(1)
    for number in range(30):
        frame = pair.request(f"{number}", now_s=float(number))
        pair.service.receive(pair.to_bridge(frame), number + 0.030)
    assert pair.service.round_trip.smoothed_s == pytest.approx(0.030, abs=0.002)
    assert pair.service.round_trip.timeout_s == pytest.approx(0.120, abs=0.008)


def test_another_session_is_told_so_and_its_request_is_not_executed():
    pair = Pair()
    pair.hello(1)
    pair.to_bridge(framing.encode(Frame(1, 0, 0, _hello_payload(2))))  # another service
    events = pair.service.receive(pair.to_bridge(pair.request("a")), 0.0)
    assert isinstance(events[0], SessionLost)
    assert pair.executed == []
    assert pair.service.session is None


def _hello_payload(nonce: int) -> bytes:
    return pack(HelloRequest(nonce, "other", PROTOCOL_VERSION, SCHEMA))


def test_a_request_that_is_no_message_is_answered_malformed():
    pair = Pair()
    pair.hello(1)
    frame = Frame(Disarm.KIND, 7, 1, b"\x81\x07")
    (answer,) = Deframer(FrameCounters()).feed(pair.to_bridge(framing.encode(frame)))
    assert b"malformed" in answer.payload
    unknown = Frame(0x77, 7, 2, b"\x80")
    (answer,) = Deframer(FrameCounters()).feed(pair.to_bridge(framing.encode(unknown)))
    assert b"0x77 is not known" in answer.payload


def test_each_side_drops_and_counts_its_own_echo():
    pair = Pair()
    pair.hello(1)
    frame = pair.request("a")
    answer = pair.to_bridge(frame)
    assert pair.to_bridge(answer) == b""
    assert pair.service.receive(frame, 0.0) == []
    assert pair.bridge.counters.own_echoes == 1
    assert pair.service.counters.own_echoes == 1
