"""Commands into bytes, bytes into replies: no I/O."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd.protocol import (
    Command,
    LineReader,
    PmdCommandError,
    PmdEchoError,
    PmdError,
    PmdRefusedError,
    PmdReplyError,
    PmdSyntaxError,
    Reply,
    match_reply,
)
from robot_bridge.pmd.status import Status, format_status, names, parse_status, parse_supply
from robot_bridge.pmd.status import parse_drive as parse_drive_limits


def microsteps_meant(body: str) -> int:
    """What the manual's rule makes of a `J` body: a sign on any argument reverses the whole."""
    steps, microsteps, speed = (int(a) for a in body[1:].split(","))
    sign = -1 if min(steps, microsteps, speed) < 0 else 1
    return sign * (abs(steps) * 8192 + abs(microsteps))


@given(microsteps=st.integers(-(2**40), 2**40).filter(bool), speed_hz=st.integers(1, 1500))
def test_a_run_means_exactly_the_microsteps_asked_for(microsteps: int, speed_hz: int):
    command = pmd_protocol.run_microsteps(3, microsteps, speed_hz)
    assert microsteps_meant(command.body) == microsteps
    assert not command.repeatable
    assert not pmd_protocol.run_stored(command).repeatable


def test_a_reverse_run_below_one_step_keeps_its_sign():
    assert pmd_protocol.run_microsteps(1, -4096, 100).line == b"X1J0,-4096,100\r"
    assert pmd_protocol.run_microsteps(1, -8192, 100).line == b"X1J-1,0,100\r"


def test_target_moves_may_be_repeated():
    command = pmd_protocol.move_to_count(2, -100, 1000)
    assert command.line == b"X2T-100,1000\r"
    assert command.repeatable
    assert pmd_protocol.store(command).line == b"X2T-100,1000b\r"
    assert pmd_protocol.run_stored(command).line == b"X2B1\r"


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: pmd_protocol.run_microsteps(1, 0, 100),
        lambda: pmd_protocol.run_microsteps(1, 10, 0),
        lambda: pmd_protocol.run_microsteps(1, 10, 2501),
        lambda: pmd_protocol.run_microsteps(1, 1.5, 100),
        lambda: pmd_protocol.run_microsteps(1, float("nan"), 100),
        lambda: pmd_protocol.move_to_count(1, 2**31, 100),
        lambda: pmd_protocol.move_to_count(1, float("inf"), 100),
        lambda: pmd_protocol.set_parameter(1, 100, 1),
        lambda: pmd_protocol.set_parameter(1, 3, None),
        lambda: Command(128, "S", reads=False),
        lambda: Command(1, "S;X1J10", reads=False),
        lambda: Command(1, "S\r", reads=False),
    ],
)
def test_what_cannot_be_meant_is_not_sent(wrong):
    with pytest.raises(PmdCommandError):
        wrong()


def test_replies_are_told_from_refusals():
    read = pmd_protocol.read(1, "E")
    assert match_reply(read, "X1E:-63") == Reply("-63")
    assert match_reply(read, "X1E") is None  # own echo
    assert match_reply(read, "X12E:5") is None  # another controller
    assert match_reply(read, "X2E:5") is None
    stored = pmd_protocol.store(pmd_protocol.move_to_count(1, 5, 10))
    assert match_reply(stored, "X1T5,10b") == Reply()
    with pytest.raises(PmdRefusedError, match="controller 1 cannot execute 'X1B1'"):
        match_reply(Command(1, "B1", reads=False), "X1B1!")
    with pytest.raises(PmdRefusedError):
        match_reply(pmd_protocol.read(1, "Y99"), "X1Y99:!")
    with pytest.raises(PmdSyntaxError):
        match_reply(Command(1, "Q5", reads=False), "X1_??_Q5")


@pytest.mark.parametrize(
    "line", ["X1T0", "X1J1", "X1R1", "X1C1", "X1E2", "X1T5,1000", "X1J-3,0,500", "X3B1", "XT0"]
)
def test_an_echo_of_an_unasked_motion_or_position_is_never_mere_chatter(line: str):
    with pytest.raises(PmdEchoError):
        match_reply(pmd_protocol.read(1, "U0"), line)


@pytest.mark.parametrize("line", ["X1J:0", "X1E:12", "X1T100b", "X2M2", "X1S", "X1J", "hello"])
def test_harmless_lines_are_chatter(line: str):
    assert match_reply(pmd_protocol.read(1, "U0"), line) is None


def test_integers_ignore_descriptions():
    assert Reply("1, Quad_32").integer() == 1
    assert Reply("-63").integer() == -63
    assert Reply("0,4096").integers() == (0, 4096)
    for wrong in ("", "abc", ",1"):
        with pytest.raises(PmdReplyError):
            Reply(wrong).integer()
    with pytest.raises(PmdReplyError):
        Reply("0,x").integers()


@given(
    lines=st.lists(st.text("XYETJ0123456789:,-", min_size=1, max_size=12), max_size=8),
    cuts=st.lists(st.integers(0, 60), max_size=6),
    end=st.sampled_from([b"\r", b"\n", b"\r\n", b"\n\r\r"]),
)
def test_lines_come_out_whole_however_the_bytes_arrive(lines, cuts, end):
    data = b"".join(line.encode() + end for line in lines)
    places = sorted({min(c, len(data)) for c in cuts} | {0, len(data)})
    reader, heard = LineReader(), []
    for start, stop in itertools.pairwise(places):
        heard += reader.feed(data[start:stop])
    assert heard == lines
    assert reader.bad_lines == 0


@given(st.binary(max_size=300))
def test_no_bytes_break_the_reader_or_the_matching(data: bytes):
    reader = LineReader()
    for line in reader.feed(data + b"\r"):
        try:
            reply = match_reply(pmd_protocol.read(1, "E"), line)
        except PmdError:
            continue
        assert (reply is not None) == line.startswith("X1E:")
    assert reader.feed(b"X1E:7\r") == ["X1E:7"]


def test_an_endless_line_is_dropped_and_counted():
    reader = LineReader()
    assert reader.feed(b"x" * 5000) == []
    assert reader.bad_lines == 1
    assert reader.feed(b"X1E:1\r") == ["X1E:1"]


@given(st.integers(0, 0xFFFF))
def test_status_survives_its_hex_digits_in_either_case(word: int):
    text = format_status(Status(word))
    assert parse_status(text) == parse_status(text.upper()) == Status(word)


def test_the_manuals_status_examples():
    assert parse_status("0808") == Status.RESET | Status.PARKED
    assert parse_status("0162") == (
        Status.INDEX | Status.TARGET_LIMIT | Status.TARGET_MODE | Status.REVERSE
    )
    assert parse_status("000a") == Status.PARKED | Status.REVERSE
    assert parse_status("0808,0c") == Status.RESET | Status.PARKED
    assert names(parse_status("0808")) == "reset, parked"
    assert names(Status(0)) == "none"


@pytest.mark.parametrize("wrong", ["", "080", "08080", "08g8", "-808", "0 08"])
def test_a_damaged_status_is_refused(wrong: str):
    with pytest.raises(PmdReplyError):
        parse_status(wrong)


def test_supply_and_drive_limits():
    supply = parse_supply("5.05,3.32,47.2*,23,56C")
    assert (supply.volts_48, supply.board_celsius, supply.error_seen) == (47.2, 56, True)
    assert parse_supply("5.05,3.32,47.2,23,56C,5").error_seen is False
    drive = parse_drive_limits("2064nF,457Hz Delta")
    assert (drive.capacitance_nf, drive.max_frequency_hz, drive.waveform) == (2064, 457, "Delta")
    for wrong in ("", "5.05", "a,b,c,d,e"):
        with pytest.raises(PmdReplyError):
            parse_supply(wrong)
    for wrong in ("", "2064nF", "2064nF,fast Delta"):
        with pytest.raises(PmdReplyError):
            parse_drive_limits(wrong)


def test_the_emergency_bytes_cancel_the_line_and_name_every_axis():
    assert pmd_protocol.emergency_stop_bytes([1, 7]) == b"\x1b;X127S;X1S;X7S;"
