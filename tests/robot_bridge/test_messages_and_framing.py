"""Bytes on the line: what is a message, what is a frame, and that nothing else passes for one."""

import dataclasses
import struct
import zlib

import cbor2
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from robot_bridge.protocol import framing, messages
from robot_bridge.protocol.framing import (
    Deframer,
    Frame,
    FrameCounters,
    FrameError,
    StopAckFrame,
    StopFrame,
    decode,
    encode,
    encode_stop,
    encode_stop_ack,
)
from robot_bridge.protocol.messages import (
    MESSAGES,
    AxisTravel,
    Move,
)
from robot_bridge.protocol.packing import MessageError, pack, schema_text, unpack

TEXT = st.text(max_size=60)
INTEGER = st.integers(-(2**53), 2**53)
POSITIONS = st.dictionaries(TEXT, st.integers(-(2**31) + 1, 2**31 - 1), max_size=8)
VALUES = {
    int: INTEGER,
    bool: st.booleans(),
    str: TEXT,
    str | None: st.none() | TEXT,
    dict[str, int]: POSITIONS,
    tuple[str, ...]: st.lists(TEXT, max_size=5).map(tuple),
    tuple[AxisTravel, ...]: st.lists(
        st.builds(AxisTravel, TEXT, INTEGER, INTEGER, INTEGER), max_size=5
    ).map(tuple),
}


def any_message() -> st.SearchStrategy[messages.Message]:
    return st.sampled_from(sorted(MESSAGES)).flatmap(
        lambda kind: st.builds(
            MESSAGES[kind],
            **{field.name: VALUES[field.type] for field in dataclasses.fields(MESSAGES[kind])},
        )
    )


@given(any_message(), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_every_message_survives_the_way_through_a_frame(message, session, sequence):
    frame = Frame(message.KIND, session, sequence, pack(message))
    counters = FrameCounters()
    (arrived,) = Deframer(counters).feed(encode(frame))
    assert arrived == frame
    assert unpack(arrived.kind, arrived.payload) == message
    assert counters.bad == 0


MOVE = Move("a", {"xt": 1000, "yt": 2, "xb": -3, "yb": 0}, "m1", "boot:1", 12345)


def move_frame() -> bytes:
    return encode(Frame(Move.KIND, 77, 3, pack(MOVE)))


@given(st.data())
def test_no_damage_to_a_move_makes_another_move(data):
    """Any bits flipped, bytes cut, inserted or doubled: the same frame, or none at all."""
    raw = bytearray(move_frame())
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, len(raw) - 1))
        match data.draw(st.sampled_from(["flip", "cut", "insert", "double"])):
            case "flip":
                raw[place] ^= 1 << data.draw(st.integers(0, 7))
            case "cut":
                del raw[place : place + data.draw(st.integers(1, 5))]
                raw = raw or bytearray(1)
            case "insert":
                raw[place:place] = data.draw(st.binary(min_size=1, max_size=5))
            case "double":
                raw += bytes(raw)
    whole = decode(move_frame().strip(b"\0"))
    assert all(frame == whole for frame in Deframer(FrameCounters()).feed(bytes(raw)))


def test_every_single_bit_flip_is_noticed():
    raw = move_frame()
    for bit in range(8 * len(raw)):
        damaged = bytearray(raw)
        damaged[bit // 8] ^= 1 << bit % 8
        frames = Deframer(FrameCounters()).feed(bytes(damaged))
        # Flipping a bit of an outer delimiter may leave the frame between the others whole.
        inside = 8 <= bit < 8 * (len(raw) - 1)
        assert not (inside and frames), bit


@given(st.binary(max_size=4000))
def test_garbage_is_never_a_frame_and_never_hides_the_next_one(garbage):
    deframer = Deframer(FrameCounters())
    frames = deframer.feed(garbage) + deframer.feed(b"\0") + deframer.feed(encode_stop(5, False))
    assert frames == [StopFrame(5, False)]


@given(st.lists(st.integers(1, 9), max_size=60))
def test_however_the_bytes_are_cut_the_frames_are_the_same(sizes):
    stream = move_frame() + encode_stop(1, True) + encode_stop_ack(1, True) + move_frame()
    deframer, frames = Deframer(FrameCounters()), []
    for size in sizes:
        frames += deframer.feed(stream[:size])
        stream = stream[size:]
    frames += deframer.feed(stream)
    move = decode(move_frame().strip(b"\0"))
    assert frames == [move, StopFrame(1, True), StopAckFrame(1, True), move]


def test_an_endless_frame_is_dropped_and_counted_without_growing():
    counters = FrameCounters()
    deframer = Deframer(counters)
    for _ in range(1000):
        assert deframer.feed(b"\x01" * 1000) == []
        assert len(deframer._buffer) <= framing.FRAME_MAX
    assert deframer.feed(b"\0" + encode_stop(1, False)) == [StopFrame(1, False)]
    assert counters.bad == 1


def test_stop_is_short_and_its_bytes_are_fixed_for_ever():
    raw = struct.pack(">BBI", ord("S"), 1, 0xDEADBEEF)
    raw += struct.pack(">I", zlib.crc32(b"autospine stop" + raw))
    assert encode_stop(0xDEADBEEF, True) == b"\0" + cobs.encode(raw) + b"\0"
    assert len(encode_stop(0, False)) == 13


def test_a_peer_with_another_schema_is_dropped_except_for_hello(monkeypatch):
    theirs, stop = move_frame(), encode_stop(9, False)
    hello = messages.HelloRequest(1, "service", 1, "0" * 16)
    their_hello = encode(Frame(hello.KIND, 0, 0, pack(hello)))
    monkeypatch.setattr(framing, "SCHEMA_HASH", b"\x01" * 8)
    counters = FrameCounters()
    frames = Deframer(counters).feed(theirs + stop + their_hello)
    assert [type(frame) for frame in frames] == [StopFrame, Frame]
    assert counters.bad == 1


def test_the_schema_covers_every_field_of_every_message():
    text = schema_text()
    for cls in MESSAGES.values():
        for field in dataclasses.fields(cls):
            assert f"{field.name}: " in text
    assert len(set(MESSAGES)) == len(MESSAGES)


BAD_FIELDS = [
    ("setpoints_um", {"xt": float("nan")}),
    ("setpoints_um", {"xt": float("inf")}),
    ("setpoints_um", {"xt": 1.0}),
    ("setpoints_um", {"xt": True}),
    ("setpoints_um", {"xt": 2**31}),
    ("setpoints_um", {"xt": 2**200}),
    ("setpoints_um", {"xt": "1"}),
    ("setpoints_um", {"xt": None}),
    ("setpoints_um", {7: 1}),
    ("setpoints_um", [1, 2]),
    ("setpoints_um", {f"axis{n}": 0 for n in range(33)}),
    ("command_id", 7),
    ("command_id", None),
    ("command_id", "x" * 241),
    ("seen_ms", 1.5),
    ("seen_ms", float("nan")),
    ("seen_ms", 2**60),
]


@pytest.mark.parametrize(("name", "value"), BAD_FIELDS, ids=str)
def test_a_field_of_the_wrong_kind_is_no_message_on_either_side(name, value):
    values = {field.name: getattr(MOVE, field.name) for field in dataclasses.fields(MOVE)}
    with pytest.raises(MessageError, match=f"Move.{name}"):
        pack(Move(**{**values, name: value}))
    with pytest.raises(MessageError, match=f"Move.{name}"):
        unpack(Move.KIND, cbor2.dumps(list({**values, name: value}.values())))


@given(st.sampled_from(sorted(MESSAGES)), st.binary(max_size=80))
def test_any_payload_is_a_message_or_a_message_error(kind, payload):
    try:
        message = unpack(kind, payload)
    except MessageError:
        return
    assert unpack(kind, pack(message)) == message


@given(st.integers(0, 255), st.binary(max_size=20))
def test_an_unknown_kind_is_a_message_error(kind, payload):
    if kind not in MESSAGES:
        with pytest.raises(MessageError, match="not known"):
            unpack(kind, payload)


@pytest.mark.parametrize(
    "raw", [b"", b"\x01", b"S" * 9, b"S" * 10, b"S" * 11, b"\x01\x15" + b"\x00" * 12], ids=str
)
def test_short_or_odd_frames_are_a_frame_error(raw):
    with pytest.raises(FrameError):
        decode(cobs.encode(raw))
