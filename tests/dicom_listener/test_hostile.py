"""What a sender could do to a listener: each is bounded, has a reason, and others are served."""

import contextlib
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from pathlib import Path

import pytest
from listener_room import wait_for
from made_slices import mr_data_set
from pydicom.uid import DeflatedExplicitVRLittleEndian, ImplicitVRLittleEndian
from test_intake import Desk
from test_scp import associated, serving

from case_record.attempts import MOST_DEATHS, Attempts
from dicom_slice import bounds

MEMORY = 400 * 2**20
DEFLATED, IMPLICIT = str(DeflatedExplicitVRLittleEndian), str(ImplicitVRLittleEndian)


def head() -> bytes:
    """SOP class and instance, explicit little endian."""
    uid = b"1.2.840.10008.5.1.4.1.1.4\0"
    return struct.pack("<HH2sH", 8, 0x16, b"UI", len(uid)) + uid + struct.pack(
        "<HH2sH", 8, 0x18, b"UI", 6
    ) + b"1.2.3\0"  # fmt: skip


def deflate_bomb(mib: int) -> bytes:
    deflater = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    made = deflater.compress(head() + struct.pack("<HH2sHL", 9, 1, b"OB", 0, mib * 2**20))
    for _ in range(mib):
        made += deflater.compress(bytes(2**20))
    return made + deflater.flush()


def item_bomb() -> bytes:
    items = struct.pack("<HHL", 0xFFFE, 0xE000, 0) * 2_000_000
    return head() + struct.pack("<HH2sHL", 9, 1, b"SQ", 0, len(items)) + items


def implicit_item_bomb() -> bytes:
    items = struct.pack("<HHL", 0xFFFE, 0xE000, 0) * 2_000_000
    uid = b"1.2.840.10008.5.1.4.1.1.4\0"
    return struct.pack("<HHL", 8, 0x16, len(uid)) + uid + struct.pack(
        "<HHL", 0x5200, 0x9230, len(items)
    ) + items  # fmt: skip


def deep_bomb() -> bytes:
    opening = struct.pack("<HH2sHL", 9, 1, b"SQ", 0, 0xFFFFFFFF) + struct.pack(
        "<HHL", 0xFFFE, 0xE000, 0xFFFFFFFF
    )
    return head() + opening * 100_000


def element_bomb() -> bytes:
    return head() + b"".join(
        struct.pack("<HH2sH", 9, number % 0x10000, b"LO", 0) for number in range(500_000)
    )


def long_header() -> bytes:
    return head() + struct.pack("<HH2sHL", 9, 1, b"OB", 0, 40 * 2**20) + bytes(40 * 2**20)


BOMBS = [
    (deflate_bomb(1024), DEFLATED, "inflates"),
    (item_bomb(), "1.2.840.10008.1.2.1", "items"),
    (implicit_item_bomb(), IMPLICIT, "items"),
    (deep_bomb(), "1.2.840.10008.1.2.1", "deep"),
    (element_bomb(), "1.2.840.10008.1.2.1", "elements"),
    (long_header(), "1.2.840.10008.1.2.1", "MiB besides the pixels"),
]


@pytest.mark.parametrize(("data", "syntax", "reason"), BOMBS, ids=[b[2] for b in BOMBS])
def test_a_bomb_is_set_aside_with_its_reason_in_bounded_memory(tmp_path, data, syntax, reason):
    desk = Desk(tmp_path)
    child = os.fork()
    if child == 0:  # with so little memory that opening it as it says would fail in another way
        with contextlib.suppress(BaseException):
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
            desk.receive(data, syntax, sop_instance_uid="1.2.3")
            os._exit(0)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
    (row,) = desk.record.slices()
    assert (row.state, row.reason_code) == ("quarantined", "too_large")
    assert reason in row.reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"NumberOfFrames": 10_000}, "10000 frames"),
        ({"Rows": 40_000, "Columns": 40_000}, "40000 x 40000"),
        ({"Rows": 4096, "Columns": 4096, "PixelData": bytes(2 * 4096**2)}, "4096 x 4096"),
    ],
)
def test_what_is_too_large_to_use_is_set_aside(tmp_path, changes, reason):
    data_set = mr_data_set()
    for name, value in changes.items():
        setattr(data_set, name, value)
    (row,) = Desk(tmp_path).receive(data_set)
    assert (row.state, row.reason_code) == ("quarantined", "too_large")
    assert reason in row.reason


def test_real_objects_are_within_all_bounds(tmp_path):
    path = tmp_path / "plain.dcm"
    mr_data_set().save_as(path, enforce_file_format=True)
    bounds.check_bounds(path)


def test_a_file_that_killed_the_listener_twice_is_set_aside_at_its_next_start(tmp_path):
    (tmp_path / "room.toml").write_text(
        '[room]\nname = "x"\ncase_dir = "case"\n[listener]\nport = 0\nmin_free_mib = 1\n'
        '[service]\nbridge_link = "/dev/null"\n'
    )
    desk = Desk(tmp_path)
    data_set = mr_data_set()
    desk.receive(data_set)
    data_set.SOPInstanceUID = "1.2.826.0.1.2"
    stored = tmp_path / "case" / desk.record.slices()[0].path
    poison = stored.with_name("00000000000000000001-000000-poison.dcm")
    poison.write_bytes(stored.read_bytes().replace(b"1.2.826.0.1.1", b"1.2.826.0.1.2"))
    for _ in range(MOST_DEATHS):
        dying = os.fork()
        if dying == 0:
            with Attempts(desk.record.case_dir, "listener").at(poison.name):
                os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(dying, 0)
    words = [sys.executable, "-m", "service.cli.main", "listener", "--exit-with-parent"]
    words += ["--config", str(tmp_path / "room.toml")]
    listener = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    try:
        wait_for(lambda: any("ended 2 times" in row.reason for row in desk.record.slices()))
    finally:
        listener.communicate()


def connect(port: int, address: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), source_address=(address, 0))


@pytest.mark.parametrize("first_bytes", [b"", b"\x01", struct.pack(">BBL", 1, 0, 60) + bytes(20)])
def test_a_flood_of_connections_that_say_little_keeps_nobody_out(tmp_path, first_bytes):
    with serving(tmp_path, acse_timeout_s=60.0) as server, contextlib.ExitStack() as stack:
        before = threading.active_count()
        for _ in range(300):
            one = stack.enter_context(connect(server.port))
            with contextlib.suppress(OSError):  # it had to make room already
                one.sendall(first_bytes)
        with associated(server.port) as association:
            assert association.send_c_store(mr_data_set()).Status == 0
        # 64 may wait; those that made room are ending
        wait_for(lambda: threading.active_count() - before <= 66)


def test_strangers_have_little_room_and_cannot_crowd_out_those_who_may_send(tmp_path):
    rules = {"peer_networks": ("127.0.0.1/32",), "acse_timeout_s": 60.0}
    with serving(tmp_path, **rules) as server, contextlib.ExitStack() as stack:
        ours = [stack.enter_context(connect(server.port)) for _ in range(20)]
        for _ in range(100):
            stack.enter_context(connect(server.port, "127.0.0.77"))
        wait_for(lambda: server.count("connections_dropped_total") >= 92)
        for one in ours:  # none of them had to go
            one.setblocking(False)
            with pytest.raises(BlockingIOError):
                one.recv(1)
        with associated(server.port) as association:
            assert association.is_established


def test_a_silent_association_makes_room_for_one_that_wants_in(tmp_path):
    with serving(tmp_path, max_associations=2) as server, contextlib.ExitStack() as stack:
        silent = [stack.enter_context(associated(server.port)) for _ in range(2)]
        time.sleep(2.5)  # longer than an association at work is silent
        third = stack.enter_context(associated(server.port))
        wait_for(lambda: third.is_established or third.is_rejected)
        assert third.is_established
        assert third.send_c_store(mr_data_set()).Status == 0
        wait_for(lambda: sum(one.is_established for one in silent) == 1)
