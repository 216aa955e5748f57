"""Messages of peers as bytes: whole ones are read, whatever stands between them."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.slicer.messages import HEADER, Message, Point, crc64, points, string, transform
from service.slicer.reading import (
    LARGEST_BODY,
    MessageError,
    Received,
    Stream,
    matrix_of,
    points_of,
    string_of,
)

MESSAGES = [
    string("CMD_0001", 1.0, "STOP"),
    transform("TGT_7", 1.0, np.eye(3), (1.0, 2.0, 3.0), {"FrameOfReferenceUID": "1.2.3"}),
    points("F", 1.0, [Point("TARGET", (1.0, 2.0, 3.0)), Point("ENTRY", (1.0, 2.0, 60.0))]),
    points("F", 1.0, []),
]


@given(
    st.lists(st.sampled_from(MESSAGES), min_size=1, max_size=6),
    st.lists(st.integers(1, 90), min_size=1, max_size=8),
    st.sampled_from([1, 2]),
)
def test_messages_are_read_however_they_are_cut(sent, cuts, version):
    sent = [one for one in sent if one.content or version == 2]
    data = b"".join(one.encoded(version) for one in sent)
    stream, heard, at, turn = Stream(), [], 0, 0
    while at < len(data):
        heard += stream.feed(data[at : at + cuts[turn % len(cuts)]])
        at, turn = at + cuts[turn % len(cuts)], turn + 1
    assert [(m.kind, m.device, m.content) for m in heard] == [
        (one.kind, one.device, one.content) for one in sent
    ]
    assert not stream.faults
    if version == 2:
        assert [m.meta for m in heard] == [dict(one.meta) for one in sent]


@given(st.lists(st.binary(max_size=400), max_size=5), st.integers(0, 3))
@settings(max_examples=200)
def test_a_stop_is_found_behind_any_rubbish(rubbish, number):
    """At the latest when the peer has been silent for a moment."""
    stream = Stream()
    heard = [m for piece in rubbish for m in stream.feed(piece)]
    heard += stream.feed(MESSAGES[0].encoded(1 + number % 2))
    for _ in range(3):
        heard += stream.give_up()
    assert "STOP" in [string_of(m) for m in heard if m.kind == "STRING"]


def with_header(version: int, kind: bytes, size: int, body: bytes, crc: int | None = None) -> bytes:
    right = crc64(body) if crc is None else crc
    return HEADER.pack(version, kind, b"D", 0, size, right) + body


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (with_header(1, b"STRING", 4, b"\0\3\0\0", crc=1), "crc"),
        (with_header(3, b"STRING", 4, b"\0\3\0\0"), "version"),
        (with_header(1, b"IMAGE", LARGEST_BODY + 1, bytes(LARGEST_BODY + 1), crc=0), "too large"),
        (with_header(2, b"STRING", 4, b"\0\3\0\0"), "meta-data"),
        (b"\xff" * 200, "no header"),
    ],
    ids=["crc", "version", "large", "extended header", "rubbish"],
)
def test_what_is_wrong_is_counted_and_the_next_message_is_read(bad, reason):
    stream = Stream()
    heard = stream.feed(bad) + stream.feed(MESSAGES[1].encoded())
    assert [m.device for m in heard] == ["TGT_7"]
    assert set(stream.faults) == {reason}


def test_a_length_that_is_wrong_does_not_swallow_the_next_message():
    first = bytearray(MESSAGES[1].encoded())
    first[42:50] = struct.pack(">Q", 100_000)
    stream = Stream()
    assert stream.feed(bytes(first) + MESSAGES[2].encoded()) == []
    assert stream.is_waiting
    assert [m.device for m in stream.give_up()] == ["F"]


@pytest.mark.parametrize("claimed", [1_500_000, 200_000_000], ids=["unfinished", "skipped"])
@pytest.mark.parametrize("kind", [b"IMAGE", b"STRING"])
def test_a_stop_is_heard_at_once_and_once_behind_a_message_that_never_ends(kind, claimed):
    """Though the peer is never silent."""
    tracking, stop = transform("NPOS_1", 0.0, np.eye(3), np.zeros(3)), MESSAGES[0]
    stream, heard = Stream(), []
    stream.feed(HEADER.pack(2, kind, b"Scout", 0, claimed, 0) + bytes(500))
    for _ in range(20):
        heard += stream.feed(tracking.encoded())
    now = [m for piece in _cut(stop.encoded(), 7) for m in stream.feed(piece)]
    assert [string_of(m) for m in now] == ["STOP"]
    for _ in range(3):
        heard += stream.feed(tracking.encoded()) + stream.resume() + stream.give_up()
    assert {m.device for m in heard} == {"NPOS_1"}
    assert stream.faults.total() <= 2


def test_what_is_awaited_for_long_is_given_up_for_what_comes_whole_behind_it():
    target, stream = MESSAGES[1].encoded(), Stream()
    assert stream.feed(HEADER.pack(2, b"IMAGE", b"Scout", 0, 1_500_000, 0) + bytes(500)) == []
    assert stream.resume() == []
    front = stream.front
    assert stream.feed(target + target) == []
    assert stream.front == front
    assert [m.device for m in stream.resume()] == ["TGT_7", "TGT_7"]
    assert not stream.is_waiting


def test_a_large_message_on_a_slow_line_comes_through():
    pixels = np.random.default_rng(1).bytes(LARGEST_BODY - 100)
    stream, heard = Stream(), []
    for piece in _cut(Message("IMAGE", "Scout", 0.0, pixels).encoded(2), 100_000):
        heard += stream.feed(piece) + stream.resume()
    assert [len(m.content) for m in heard] == [len(pixels)]
    assert not stream.faults


def test_headers_within_headers_do_not_keep_the_room_busy(monkeypatch):
    """Each claims a body that is there, with a CRC that is wrong."""
    one = HEADER.pack(2, b"IMAGE", b"Scout", 0, 1_000_000, 1)
    summed = []

    def counted(body: bytes) -> int:
        summed.append(len(body))
        return crc64(body)

    monkeypatch.setattr("service.slicer.reading.crc64", counted)
    stream = Stream()
    stream.feed((one * 40_000)[: LARGEST_BODY - 100])
    (heard,) = stream.feed(MESSAGES[0].encoded())
    assert string_of(heard) == "STOP"
    assert sum(summed) < 50_000_000


def test_a_stop_is_one_whatever_its_meta_data_say():
    body = bytearray(
        Message("STRING", "CMD_1", 0.0, MESSAGES[0].content, {"a": "b"}).encoded(2)[58:]
    )
    body[4:8] = struct.pack(">I", 10)
    (heard,) = Stream().feed(with_header(2, b"STRING", len(body), bytes(body)))
    assert string_of(heard) == "STOP"


def _cut(data: bytes, size: int) -> list[bytes]:
    return [data[at : at + size] for at in range(0, len(data), size)]


def test_coordinates_come_as_lps():
    (found,) = Stream().feed(MESSAGES[1].encoded())
    axes, origin = matrix_of(found)
    assert np.allclose(axes, np.eye(3))
    assert origin.tolist() == [1.0, 2.0, 3.0]
    (listed,) = Stream().feed(MESSAGES[2].encoded())
    assert [(p.name, p.patient_mm) for p in points_of(listed)] == [
        ("TARGET", (1.0, 2.0, 3.0)),
        ("ENTRY", (1.0, 2.0, 60.0)),
    ]


@pytest.mark.parametrize("read", [string_of, matrix_of, points_of])
@given(content=st.binary(max_size=300))
def test_content_of_any_bytes_is_read_or_refused(read, content):
    with contextlib.suppress(MessageError):
        read(Received(1, "X", "D", content))


def test_meta_data_that_lie_about_their_size_are_refused():
    body = struct.pack(">HHII", 12, 10, 4, 0) + struct.pack(">H", 1)
    body += struct.pack(">HHI", 60000, 3, 60000) + b"abcd"
    stream = Stream()
    assert stream.feed(with_header(2, b"STATUS", len(body), body)) == []
    assert stream.faults == {"meta-data": 1}


def test_a_message_is_what_it_was_after_both_ways():
    sent = Message("STRING", "D", 3.25, b"\0\3\0\1a", {"a": "b", "c": ""})
    (found,) = Stream().feed(sent.encoded())
    assert (found.content, found.meta) == (sent.content, dict(sent.meta))
