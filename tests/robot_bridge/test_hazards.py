"""The hazards of the design, each injected into a real daemon with motors that really run.

H3, H4 also: test_fault_injection, test_two_sides, test_messages_and_framing. H5, H6, H8 also:
test_daemon. H13: the times are measured in benchmarks/link.py.
"""

import os
import random
import threading
import time
from pathlib import Path

import cbor2
import pytest
from bridge_room import AXES, BridgeRoom, bridge_room, wait_for

from robot_bridge.client.client import BridgeClient, LinkLostError, RefusedError
from robot_bridge.protocol import framing
from robot_bridge.protocol.framing import Deframer, Frame, FrameCounters, StopAckFrame
from robot_bridge.protocol.messages import (
    PROTOCOL_VERSION,
    Answer,
    Arm,
    DeclarePosition,
    Heartbeat,
    Hello,
    HelloRequest,
    Message,
    Move,
    NoSession,
    Rearm,
    SetPhase,
    Status,
)
from robot_bridge.protocol.packing import SCHEMA, pack, unpack
from robot_bridge.protocol.phases import WorkPhase
from robot_bridge.protocol.transport import SerialTransport
from simulator.serial_line import LineFaults

FAR = dict.fromkeys(AXES, 14_000)


class RawService:
    """A service that says whatever it likes: bytes on the line, without the client's manners."""

    def __init__(self, room: BridgeRoom) -> None:
        self.line = SerialTransport(room.line.far, 115200)
        room.clients.append(self)
        self.session = 0
        self.sequence = 0
        self._deframer = Deframer(FrameCounters())
        self._hello_s = 0.0

    def say_hello(self) -> Hello:
        nonce = random.getrandbits(50)
        hello = HelloRequest(nonce, "raw", PROTOCOL_VERSION, SCHEMA)
        answer = None
        until_s = time.monotonic() + 60.0
        while answer is None and time.monotonic() < until_s:  # the daemon may be starting
            self.line.write(framing.encode(Frame(hello.KIND, 0, 0, pack(hello))))
            answer = self._receive_or_none(0.3, Hello)
        assert isinstance(answer, Hello)
        self.session, self.boot_id = answer.session, answer.boot_id
        self._hello_s, self._hello_ms = time.monotonic(), answer.now_ms
        return answer

    @property
    def now_ms(self) -> int:
        """The bridge's clock, a little behind."""
        return self._hello_ms + round((time.monotonic() - self._hello_s) * 1000) - 20

    def receive(self, *kinds: type[Message]) -> Message:
        message = self._receive_or_none(60.0, *kinds)
        assert message is not None, f"no {kinds}"
        return message

    def _receive_or_none(self, timeout_s: float, *kinds: type[Message]) -> Message | None:
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            for frame in self._deframer.feed(self.line.read(0.05)):
                if isinstance(frame, Frame) and frame.kind in {kind.KIND for kind in kinds}:
                    return unpack(frame.kind, frame.payload)
        return None

    def acknowledged(self, timeout_s: float) -> bool:
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            frames = self._deframer.feed(self.line.read(0.02))
            if any(isinstance(frame, StopAckFrame) for frame in frames):
                return True
        return False

    def ask(self, request: Message, payload: bytes | None = None) -> Answer:
        self.sequence += 1
        payload = pack(request) if payload is None else payload
        frame = Frame(request.KIND, self.session, self.sequence, payload)
        self.line.write(framing.encode(frame))
        answer = self.receive(Answer)
        assert isinstance(answer, Answer)
        return answer

    def status(self) -> Status:
        beat = Heartbeat(self.now_ms)
        self.line.write(framing.encode(Frame(beat.KIND, self.session, 1, pack(beat))))
        status = self.receive(Status)
        assert isinstance(status, Status)
        return status

    def make_ready(self) -> str:
        """Armed in MANUAL at zero; returns the motion that a move must be based on."""
        stop_count = self.status().stop_count
        if self.status().stopped:
            assert self.ask(Rearm("raw", stop_count, self.now_ms)).code == "ok"
        zero = dict.fromkeys(AXES, 0)
        assert self.ask(DeclarePosition(zero, "raw", self.now_ms)).code == "ok"
        assert self.ask(SetPhase("MANUAL", "raw", self.now_ms)).code == "ok"
        assert self.ask(Arm("raw", stop_count, self.now_ms)).code == "ok"
        return self.status().last_motion

    def close(self) -> None:
        self.line.close()

    def move(self, command_id: str, setpoints_um: dict, based_on: str) -> Answer:
        return self.ask(Move(command_id, setpoints_um, None, based_on, self.now_ms))


def never_moved(room: BridgeRoom, before_um: dict[str, float]) -> bool:
    time.sleep(0.2)
    return not room.controllers.moving and room.controllers.positions_um() == before_um


def test_h3_a_move_frame_repeated_by_the_line_moves_once(tmp_path: Path):
    with bridge_room(tmp_path, LineFaults(duplicate=1.0)) as room:
        room.start_daemon()
        client = room.ready_client()
        for number in range(3):
            assert client.move(f"m{number}", dict.fromkeys(AXES, 300 * number), None).done
        starts = room.controllers.bus.lines_received
        assert client.move("m2", dict.fromkeys(AXES, 600), None).done
        assert room.controllers.positions_um() == pytest.approx(dict.fromkeys(AXES, 600), abs=20)
        assert starts > 0
        journal = (tmp_path / "state" / "bridge_journal.jsonl").read_text()
        assert journal.count('"kind":"begin"') == 3


def test_h4_garbage_chatter_echo_and_half_frames_move_nothing(shared_room: BridgeRoom):
    rng = random.Random(4)
    room = shared_room
    raw = RawService(room)
    raw.say_hello()
    before_um = room.controllers.positions_um()
    move = Move(room.id("evil"), FAR, None, raw.make_ready(), raw.now_ms)
    frame = framing.encode(Frame(Move.KIND, raw.session, raw.sequence + 1, pack(move)))
    for _ in range(200):
        damaged = bytearray(frame)
        place = rng.randrange(1, len(frame) - 1)
        match rng.randrange(4):
            case 0:
                damaged[place] ^= 1 << rng.randrange(8)
            case 1:
                del damaged[place:]  # half a frame
            case 2:
                damaged = bytearray(rng.randbytes(60))  # another device
            case 3:
                damaged = bytearray(b"\0X1T14000,1500\r\0")  # chatter of a motor bus
        raw.line.write(bytes(damaged))
    assert never_moved(room, before_um)
    health = wait_for_health(room, lambda h: int(h["frames"]["bad"]) > 100)
    assert health["moving"] is False


def wait_for_health(room: BridgeRoom, condition) -> dict:
    wait_for(lambda: condition(room.status_file()), 60, "the status file")
    return room.status_file()


def test_h7_a_controller_that_restarts_leaves_the_position_uncertain(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        room.start_daemon()
        client = room.ready_client()
        assert client.move("a", dict.fromkeys(AXES, 500), None).done
        room.controllers.power_cycle()
        wait_for(lambda: client.pump(0.05) or not client.status.position_certain, 60, "uncertain")
        time.sleep(0.5)
        client.pump(0.1)
        assert not client.status.armed
        outcome = client.move("b", dict.fromkeys(AXES, 600), None)
        assert outcome.code in ("stop_latched", "motor_fault", "position_uncertain")
        # until the board is set up again it is a fault, however slow this computer is
        wait_for(lambda: client.pump(0.05) or client.status.fault is None, 60, "set up again")
        client.rearm("test")
        client.set_phase(WorkPhase.MANUAL, "test")
        outcome = client.move("c", dict.fromkeys(AXES, 600), None)
        assert outcome.code == "position_uncertain"


def test_h7_frames_of_an_old_session_are_answered_with_no_session(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon()
        raw = RawService(room)
        boot = raw.say_hello()
        before_um = room.controllers.positions_um()
        old = Move("old", FAR, None, raw.make_ready(), raw.now_ms)
        frame = framing.encode(Frame(Move.KIND, raw.session, raw.sequence + 1, pack(old)))
        daemon.kill()
        daemon.wait()
        room.start_daemon()
        new_boot = raw.say_hello()
        assert new_boot.boot_id != boot.boot_id
        assert not new_boot.position_certain
        raw.line.write(frame)
        answer = raw.receive(NoSession)
        assert isinstance(answer, NoSession)
        assert answer.boot_id == new_boot.boot_id
        assert never_moved(room, before_um)


OUTSIDE = [
    ({**FAR, "xt": 15_001}, "beyond_travel", "'xt': 15001 um is outside its travel"),
    ({**FAR, "yb": -15_001}, "beyond_travel", "'yb': -15001 um"),
    ({**FAR, "yb": 2**31 - 1}, "beyond_travel", "'yb': 2147483647"),
    ({"xt": 0, "yt": 0, "xb": 0}, "missing_axis", "'yb' has no setpoint"),
    ({**FAR, "zz": 0}, "unknown_axis", "'zz' is not one of"),
    ({**FAR, "xt": float("nan")}, "malformed", "Move.setpoints_um: axis xt: nan"),
    ({**FAR, "xt": float("inf")}, "malformed", "inf"),
    ({**FAR, "xt": 1e9}, "malformed", "1000000000.0"),
    ({**FAR, "xt": 2**70}, "malformed", "xt"),
    ({**FAR, "xt": None}, "malformed", "None"),
    ({}, "missing_axis", "'xt' has no setpoint"),
]


def test_h9_nothing_beyond_travel_and_no_nonsense_ever_moves(shared_room: BridgeRoom):
    room = shared_room
    raw = RawService(room)
    raw.say_hello()
    base = raw.make_ready()
    before_um = room.controllers.positions_um()
    for number, (setpoints_um, code, text) in enumerate(OUTSIDE):
        move = Move(room.id(f"h9-{number}"), setpoints_um, None, base, raw.now_ms)
        payload = cbor2.dumps(list(move.__dict__.values()))
        answer = raw.ask(move, payload)
        assert answer.code == code, (setpoints_um, answer)
        assert text in answer.text
    assert never_moved(room, before_um)
    # The line and the session are as good as before.
    assert raw.move(room.id("inside"), dict.fromkeys(AXES, 0), base).state == "ACCEPTED"
    health = wait_for_health(room, lambda h: sum(h["refused"].values()) >= len(OUTSIDE))
    assert health["refused"]["beyond_travel"] == 3


def test_h2_a_move_resting_on_an_outdated_measurement_is_refused(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    measured_after = client.status.last_motion
    assert client.move(room.id("a"), dict.fromkeys(AXES, 300), "m1").done
    by_base = client.move(
        room.id("b"), dict.fromkeys(AXES, 400), "m2", based_on_motion=measured_after
    )
    by_use = client.move(room.id("c"), dict.fromkeys(AXES, 400), "m1")
    assert by_base.code == by_use.code == "outdated_measurement"
    assert "outdated measurement" in by_base.text
    assert room.controllers.positions_um() == pytest.approx(dict.fromkeys(AXES, 300), abs=20)


def test_h13_stop_works_without_a_session_and_from_another_program(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    thread = threading.Thread(target=_move_until_stopped, args=(room, client), daemon=True)
    thread.start()
    wait_for(room.controllers.on_a_long_way, 60, "the motors to turn")
    line = os.open(room.line.far, os.O_RDWR | os.O_NOCTTY)
    os.write(line, framing.encode_stop(1, False))  # thirteen bytes, no session
    os.close(line)
    wait_for(lambda: not room.controllers.moving, 0.5, "standstill")
    thread.join(10)
    assert max(room.controllers.positions_um().values()) < 13_000


def _move_until_stopped(room: BridgeRoom, client: BridgeClient) -> None:
    try:
        client.move(room.id("long"), FAR, None)
    except LinkLostError:
        return


def test_h13_stop_overtakes_a_flood_of_other_frames(shared_room: BridgeRoom):
    room = shared_room
    raw = RawService(room)
    raw.say_hello()
    assert raw.move(room.id("long"), FAR, raw.make_ready()).state == "ACCEPTED"
    wait_for(room.controllers.on_a_long_way, 60, "the motors to turn")
    flood = b"".join(framing.encode(Frame(0x13, raw.session, 100 + n, b"\x80")) for n in range(60))
    raw.line.write(flood + framing.encode_stop(2, False))
    wait_for(lambda: not room.controllers.moving, 0.5, "standstill")
    assert raw.acknowledged(2.0)
    assert max(room.controllers.positions_um().values()) < 13_000


def test_h13_stop_works_while_the_controllers_answer_nothing(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    thread = threading.Thread(target=_move_until_stopped, args=(room, client), daemon=True)
    thread.start()
    wait_for(room.controllers.on_a_long_way, 60, "the motors to turn")
    room.controllers.bus.faults.drop_probability = 1.0
    client.request_stop()
    wait_for(lambda: not room.controllers.moving, 0.5, "standstill")
    thread.join(15)
    assert max(room.controllers.positions_um().values()) < 13_000
    room.controllers.bus.faults.drop_probability = 0.0


def test_h13_a_peer_with_another_schema_can_still_stop(shared_room: BridgeRoom):
    room = shared_room
    raw = RawService(room)
    raw.say_hello()
    hello = HelloRequest(5, "older", PROTOCOL_VERSION, "0" * 16)
    raw.line.write(framing.encode(Frame(hello.KIND, 0, 0, pack(hello))))
    answer = raw.receive(Hello)
    while answer.nonce != 5:  # an earlier hello was said twice
        answer = raw.receive(Hello)
    assert answer.code == "schema_mismatch"
    raw.line.write(framing.encode_stop(3, False))
    assert raw.acknowledged(2.0)
    wait_for_health(room, lambda h: h["stopped"] and h["stop_reason"] == "operator_stop")


def test_the_lock_set_in_motion_stops_it(tmp_path: Path):
    with bridge_room(tmp_path, speed_hz=200) as room:  # about 15 s to get there
        room.start_daemon()
        client = room.ready_client()
        locked = threading.Event()

        def lock_when_moving(state, status) -> None:
            if locked.is_set():
                return
            locked.set()
            while max(room.controllers.positions_um().values()) < 50:
                client.pump(0.01)
            client.set_insertion_lock(True, "test")

        outcome = client.move("a", FAR, None, lock_when_moving)
        assert outcome.code == "locked_in_motion"
        assert 50 <= max(room.controllers.positions_um().values()) < 13_000
        assert client.status.insertion_locked
        client.arm("test")
        assert client.move("b", dict.fromkeys(AXES, 0), None).code == "insertion_locked"


def test_a_stalled_axis_fails_the_move_and_latches(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    room.controllers.all[1].faults.stalled = True
    outcome = client.move(room.id("a"), dict.fromkeys(AXES, 2000), None)
    assert outcome.state == "FAILED"
    assert outcome.code == "motor_fault"
    assert "yt" in outcome.text
    assert client.status.stopped
    room.controllers.all[1].faults.stalled = False
    with pytest.raises(RefusedError):
        client.arm("test")


def test_h13_stop_gets_through_while_the_control_thread_hangs_on_a_bad_line(
    shared_room: BridgeRoom,
):
    """The page's thread calls it; nobody pumps, and half of the frames are lost."""
    room = shared_room
    client = room.ready_client()

    def hang(state, status) -> None:
        room.line.set_faults(LineFaults(loss=0.5))
        threading.Timer(0.1, client.request_stop).start()
        time.sleep(0.6)
        moving_after_600_ms.append(room.controllers.moving)
        room.line.set_faults(LineFaults())

    moving_after_600_ms: list[bool] = []
    outcome = client.move(room.id("a"), FAR, None, hang)
    assert moving_after_600_ms[0] is False
    assert outcome.code == "operator_stop", outcome


def test_h13_stop_gets_through_without_an_open_session_of_ones_own(shared_room: BridgeRoom):
    """The service lost its session; another program even has the line."""
    room = shared_room
    other = room.ready_client()
    service = room.client()
    service.request_stop()
    wait_for(lambda: other.pump(0.02) or other.status.stopped, 60, "the stop")
    assert other.status.stop_reason == "operator_stop"
    other.close()
    service.open(5.0)
    wait_for(lambda: service.pump(0.02) or service.stop_acknowledged, 60, "the acknowledgement")
