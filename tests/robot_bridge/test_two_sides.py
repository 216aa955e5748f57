"""The protocol's two ends explored together: any order of sends, losses, repeats and restarts.

A machine of rules plays the line: every frame that was ever sent may arrive now, later, twice or
never. Whatever happens, a request is executed at most once, in order, by the session that sent it,
and the answer that the service gets is the answer to its request.
"""

import itertools
from collections import Counter

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from robot_bridge.protocol import framing
from robot_bridge.protocol.bridge_end import (
    BridgeEnd,
    HeartbeatReceived,
    MalformedReceived,
    RequestReceived,
    SessionOpened,
    StopReceived,
)
from robot_bridge.protocol.messages import (
    PROTOCOL_VERSION,
    Answer,
    Disarm,
    Heartbeat,
    Hello,
    Status,
)
from robot_bridge.protocol.packing import SCHEMA
from robot_bridge.protocol.service_end import (
    Answered,
    GaveUp,
    HelloReceived,
    ServiceEnd,
    SessionLost,
    StatusReceived,
    StopAcknowledged,
)


def status(boot_id: str) -> Status:
    return Status(
        now_ms=0, boot_id=boot_id, phase="START_UP", armed=False, stopped=False, stop_reason="",
        stop_count=0, insertion_locked=False, moving=False, parked=False, positions_um={},
        position_certain=False, last_motion="", fault=None, command_id=None, command_state=None,
        command_code="", command_text="", command_readback_um={}, frames_bad=0, refused=0,
    )  # fmt: skip


class TwoSides(RuleBasedStateMachine):
    @initialize()
    def begin(self) -> None:
        self.now_s = 0.0
        self.numbers = itertools.count(1)
        self.sessions = itertools.count(100)
        self.boots = itertools.count(1)
        self.service = ServiceEnd()
        self.to_bridge: list[bytes] = []  # on the way
        self.to_service: list[bytes] = []
        self.ever_to_bridge: list[bytes] = []  # may come again at any time
        self.ever_to_service: list[bytes] = []
        self.executed: Counter[str] = Counter()
        self.executed_in: dict[str, int] = {}
        self.sent_in: dict[str, int] = {}
        self.order: list[int] = []
        self.asked: str | None = None
        self.answered: dict[str, str] = {}
        self.given_up: set[str] = set()
        self.stops_sent: set[int] = set()
        self.stops_heard: set[int] = set()
        self._boot()

    def _boot(self) -> None:
        self.boot_id = f"boot{next(self.boots)}"
        self.bridge = BridgeEnd(self.boot_id, lambda: next(self.sessions))

    # --- the service acts ---------------------------------------------------------------------

    @rule(dice=st.integers(0, 3))
    def say_hello_now_and_then(self, dice: int) -> None:
        if dice == 3:
            self.say_hello()

    def say_hello(self) -> None:
        self.service.say_hello(next(self.numbers), "test", self.now_s)
        self._forget_request()
        self._flush_service()

    @precondition(lambda self: self.service.session is not None and not self.service.busy)
    @rule()
    def send_request(self) -> None:
        self.asked = f"request {next(self.numbers)}"
        assert self.service.session is not None
        self.sent_in[self.asked] = self.service.session
        self.service.send_request(Disarm(by=self.asked), self.now_s)
        self._flush_service()

    @precondition(lambda self: self.service.session is not None)
    @rule()
    def send_heartbeat(self) -> None:
        self.service.send_heartbeat(Heartbeat(seen_ms=0), self.now_s)
        self._flush_service()

    @rule(emergency=st.booleans())
    def send_stop(self, emergency: bool) -> None:
        nonce = next(self.numbers)
        self.stops_sent.add(nonce)
        self._on_its_way(framing.encode_stop(nonce, emergency))

    @rule(seconds=st.sampled_from([0.01, 0.2, 1.0]))
    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        for event in self.service.tick(self.now_s):
            assert isinstance(event, GaveUp)
            self._forget_request()
        self._flush_service()

    @rule(dice=st.integers(0, 3))
    def service_restarts(self, dice: int) -> None:
        if dice != 3:  # often enough, or no session gets old
            return
        self.service = ServiceEnd()
        self._forget_request()

    def _forget_request(self) -> None:
        if self.asked is not None:
            self.given_up.add(self.asked)
        self.asked = None

    def _flush_service(self) -> None:
        output = self.service.take_output()
        if output:
            self._on_its_way(output)

    def _on_its_way(self, frame: bytes) -> None:
        self.to_bridge.append(frame)
        self.ever_to_bridge.append(frame)

    # --- the line acts ------------------------------------------------------------------------

    @rule()
    def everything_arrives(self) -> None:
        self._exchange()

    @rule(requests=st.integers(1, 4))
    def a_while_on_a_good_line(self, requests: int) -> None:
        self._exchange()
        if self.service.session is None:
            self.say_hello()
            self._exchange()
        for _ in range(requests):
            if self.service.session is not None and not self.service.busy:
                self.send_request()
                self._exchange()

    @precondition(lambda self: self.to_bridge)
    @rule(data=st.data(), lost=st.booleans())
    def one_frame_arrives_or_is_lost(self, data: st.DataObject, lost: bool) -> None:
        place = data.draw(st.integers(0, len(self.to_bridge) - 1))
        frame = self.to_bridge.pop(place)
        if not lost:
            self._bridge_receives(frame)

    @precondition(lambda self: self.to_service)
    @rule(data=st.data(), lost=st.booleans())
    def one_answer_arrives_or_is_lost(self, data: st.DataObject, lost: bool) -> None:
        place = data.draw(st.integers(0, len(self.to_service) - 1))
        frame = self.to_service.pop(place)
        if not lost:
            self._service_receives(frame)

    @precondition(lambda self: self.ever_to_bridge)
    @rule(back=st.lists(st.integers(1, 12), min_size=1, max_size=5))
    def old_frames_arrive_again_in_one_read(self, back: list[int]) -> None:
        ever = self.ever_to_bridge
        self._bridge_receives(b"".join(ever[-min(n, len(ever))] for n in back))

    @precondition(lambda self: self.ever_to_service)
    @rule(back=st.integers(1, 12))
    def an_old_answer_arrives_again(self, back: int) -> None:
        ever = self.ever_to_service
        self._service_receives(ever[-min(back, len(ever))])

    @precondition(lambda self: self.to_bridge)
    @rule(data=st.data())
    def damage(self, data: st.DataObject) -> None:
        raw = bytearray(self.to_bridge[data.draw(st.integers(0, len(self.to_bridge) - 1))])
        place = data.draw(st.integers(1, len(raw) - 2))
        raw[place] ^= 1 << data.draw(st.integers(0, 7))
        heard = set(self.stops_heard)
        executed = self.executed.total()
        self._bridge_receives(bytes(raw))
        assert self.stops_heard == heard
        assert self.executed.total() == executed

    @rule(garbage=st.binary(max_size=30))
    def chatter(self, garbage: bytes) -> None:
        self._bridge_receives(garbage + b"\0")
        self._service_receives(garbage + b"\0")

    @rule()
    def own_echo(self) -> None:
        for frame in self.to_service[-3:]:
            self._bridge_receives(frame)
        for frame in self.to_bridge[-3:]:
            self._service_receives(frame)

    # --- the bridge acts ----------------------------------------------------------------------

    @rule(dice=st.integers(0, 3))
    def bridge_restarts(self, dice: int) -> None:
        if dice != 3:
            return
        self._boot()

    def _bridge_receives(self, data: bytes) -> None:
        before_any_other = True
        for event in self.bridge.receive(data):
            match event:
                case StopReceived():
                    assert before_any_other, "a STOP came after something else"
                    assert event.nonce in self.stops_sent
                    self.stops_heard.add(event.nonce)
                    self.bridge.acknowledge_stop(event)
                case SessionOpened():
                    self.bridge.open_session(event, self._hello(event.request.nonce))
                case HeartbeatReceived():
                    self.bridge.send_status(event.sequence, status(self.boot_id))
                case RequestReceived():
                    self._execute(event)
                case MalformedReceived():
                    raise AssertionError(event)
            before_any_other = before_any_other and isinstance(event, StopReceived)
        output = self.bridge.take_output()
        if output:
            self.to_service.append(output)
            self.ever_to_service.append(output)

    def _execute(self, event: RequestReceived) -> None:
        assert isinstance(event.request, Disarm)
        name = event.request.by
        assert self.bridge.session is not None
        self.executed[name] += 1
        self.executed_in[name] = self.bridge.session
        self.order.append(int(name.split()[1]))
        self.bridge.answer(event.sequence, Answer("ok", name, None, {}))

    def _hello(self, nonce: int):
        boot_id = self.boot_id
        return lambda session: Hello(
            nonce=nonce, code="ok", text="", protocol=PROTOCOL_VERSION, schema=SCHEMA,
            software="", session=session, boot_id=boot_id, now_ms=0, axes=(),
            position_certain=False, last_motion="",
        )  # fmt: skip

    def _service_receives(self, data: bytes) -> None:
        for event in self.service.receive(data, self.now_s):
            match event:
                case Answered():
                    assert self.asked is not None
                    assert event.answer.text == self.asked, "an answer to another request"
                    self.answered[self.asked] = event.answer.text
                    self.asked = None
                case SessionLost():
                    self._forget_request()
                case StopAcknowledged():
                    assert event.nonce in self.stops_heard, "acknowledged but never heard"
                case HelloReceived() | StatusReceived() | GaveUp():
                    pass

    # --- what must always hold ----------------------------------------------------------------

    @invariant()
    def every_request_is_executed_at_most_once(self) -> None:
        assert all(count == 1 for count in getattr(self, "executed", {}).values())

    @invariant()
    def what_is_executed_is_executed_in_the_session_that_sent_it(self) -> None:
        for name, session in getattr(self, "executed_in", {}).items():
            assert self.sent_in[name] == session

    @invariant()
    def requests_are_executed_in_the_order_in_which_they_were_sent(self) -> None:
        order = getattr(self, "order", [])
        assert order == sorted(order)

    @invariant()
    def an_answered_request_was_executed(self) -> None:
        assert all(self.executed[name] == 1 for name in getattr(self, "answered", {}))

    def teardown(self) -> None:
        """On a good line everything comes to its end."""
        if not hasattr(self, "service"):
            return
        self.to_bridge.clear()
        self.to_service.clear()
        self.say_hello()
        self._exchange()
        assert self.service.session == self.bridge.session is not None
        self.send_request()
        name = str(self.asked)
        for frame in self.to_bridge:
            self._bridge_receives(frame)
        self.to_bridge.clear()
        self.to_service.clear()  # the answer is lost
        assert name not in self.answered
        self.wait(1.0)
        self._exchange()
        assert self.answered[name] == name
        self.every_request_is_executed_at_most_once()

    def _exchange(self) -> None:
        for frame in [*self.to_bridge]:
            self._bridge_receives(frame)
        self.to_bridge.clear()
        for frame in [*self.to_service]:
            self._service_receives(frame)
        self.to_service.clear()


TwoSides.TestCase.settings = settings(max_examples=120, stateful_step_count=50)
TestTwoSides = TwoSides.TestCase
