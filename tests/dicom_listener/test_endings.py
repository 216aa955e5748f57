"""Every ending of an association has a line, an event and a counter; what DCMTK takes is taken."""

import contextlib
import socket
import struct
import subprocess
from collections.abc import Iterator

import pytest
from listener_room import needs_program, wait_for
from made_slices import mr_data_set
from raw_pdus import (
    ABORT,
    RELEASE,
    answer,
    associate,
    context,
    encoded,
    item,
    p_data,
    status_of,
    store_command,
)
from test_scp import Serving, serving

from dicom_listener.negotiation import is_storage
from dicom_listener.network.association_request import MalformedRequestError, mended_request

ACCEPTED, ABORTED, DATA = 2, 7, 4
pytestmark = pytest.mark.filterwarnings("ignore:.*UI.*:UserWarning")


@contextlib.contextmanager
def connected(server: Serving, request: bytes) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", server.port), 60) as sock:
        sock.sendall(request)
        yield sock


def endings(server: Serving) -> list[str]:
    return [text for kind, text in server.scp.alarms if kind == "association_ended"]


def store(sock: socket.socket, uid: str, data: bytes, **command: int) -> int:
    sock.sendall(p_data(3, store_command(uid, **command)) + p_data(2, data))
    kind, body = answer(sock)
    assert kind == DATA
    return status_of(body)


@pytest.mark.parametrize(
    ("request_pdu", "calling"),
    [
        (associate(called=b"AUTOSPINE".ljust(16, b"\0")), "SCANNER"),
        (associate(called=b"AUTOSPINE\0 x"), "SCANNER"),
        (associate(calling=b""), "(BLANK)"),
        (associate(calling=bytes(16)), "(BLANK)"),
        (associate(calling=b"MR1".ljust(16, b"\0")), "MR1"),
        (associate(calling="MR_KÖLN".encode("latin-1")), "MR_K?LN"),
        (associate(calling=b"\xc0\xb3\x60\x49\xfc\x7f"), "??`I??"),
        (associate(calling=b"MR\\1"), "MR?1"),
        (associate(user=item(0x52, b"1." + b"2" * 68)), "SCANNER"),
        (associate(user=item(0x55, b"A" * 20)), "SCANNER"),
        (associate(user=item(0x5A, b"abcd") + item(0x52, b"1.2")), "SCANNER"),
        (associate(contexts=context(2) + context(3)), "SCANNER"),
    ],
)
def test_a_request_that_dcmtk_takes_is_taken_and_a_slice_comes_through(
    tmp_path, request_pdu, calling
):
    with serving(tmp_path) as server, connected(server, request_pdu) as sock:
        kind, _ = answer(sock)
        assert kind == ACCEPTED
        number = 3 if context(3) in request_pdu else 1
        data = encoded(mr_data_set("1.2.3"))
        sock.sendall(p_data(3, store_command("1.2.3"), number) + p_data(2, data, number))
        assert status_of(answer(sock)[1]) == 0
        sock.sendall(RELEASE)
        answer(sock)
        wait_for(lambda: server.count("association_endings_total", ending="released") == 1)
        assert endings(server) == []
        assert f"association of {calling!r}" in str(server.scp.reports[-1])


def test_what_was_left_out_of_a_request_stands_in_its_report(tmp_path):
    odd = associate(contexts=context(2) + context(1), user=item(0x5A, b"abcd"))
    with serving(tmp_path) as server, connected(server, odd) as sock:
        assert answer(sock)[0] == ACCEPTED
        report = str(server.scp.reports[-1])
        assert "presentation context 2 left out: its number must be odd" in report
        assert "unknown user information item 0x5A left out" in report


@pytest.mark.parametrize(
    ("request_pdu", "text"),
    [
        (associate(contexts=context(2)), "no presentation context can be used: presentation con"),
        (associate(contexts=b""), "no presentation context can be used: none were proposed"),
        (associate(user=item(0x52, b"1.2")[:-1]), "is cut off"),
        (struct.pack(">BBL", 1, 0, 10) + bytes(10), "an association request of 16 bytes"),
    ],
)
def test_a_request_that_cannot_be_read_is_aborted_at_once_with_a_line(tmp_path, request_pdu, text):
    with serving(tmp_path, max_associations=2) as server:
        for _ in range(3):
            with connected(server, request_pdu) as sock:
                assert answer(sock)[0] == ABORTED
        wait_for(lambda: len(endings(server)) == 1)  # the same words again only after a while
        assert text in endings(server)[0]
        assert "127.0.0.1" in endings(server)[0]
        assert server.count("association_endings_total", ending="unreadable") == 3
        wait_for(lambda: server.scp.open_associations == 0)
        with connected(server, associate()) as sock:
            assert answer(sock)[0] == ACCEPTED


@pytest.mark.parametrize(
    ("how", "kind", "text"),
    [
        ("abort", "aborted", "aborted by the sender"),
        ("reset", "broken", "the connection was broken (Connection reset by peer)"),
        ("close", "closed", "the sender closed the connection without a release"),
        ("stall", "idle", "nothing arrived for 0.5 s"),
    ],
)
def test_a_transfer_that_breaks_off_in_mid_slice_leaves_a_line_and_no_file(
    tmp_path, how, kind, text
):
    with serving(tmp_path, dimse_timeout_s=0.5) as server:
        with connected(server, associate()) as sock:
            answer(sock)
            half = encoded(mr_data_set("1.2.3"))[:2000]
            sock.sendall(p_data(3, store_command("1.2.3")) + p_data(0, half))
            wait_for(lambda: server.scp.open_associations == 1)
            if how == "abort":
                sock.sendall(ABORT)
            elif how == "reset":
                linger = struct.pack("ii", 1, 0)
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            elif how == "stall":
                wait_for(lambda: endings(server))
        wait_for(lambda: endings(server))
        (line,) = endings(server)
        assert line.startswith(f"association of 'SCANNER' (127.0.0.1): {text}")
        assert "in the middle of a message (" in line
        assert server.count("association_endings_total", ending=kind) == 1
        assert list(server.inbox.folder.iterdir()) == []


def test_between_messages_an_association_may_be_silent_for_longer_than_within_one(tmp_path):
    rules = {"dimse_timeout_s": 0.3, "network_timeout_s": 2.0}
    with serving(tmp_path, **rules) as server, connected(server, associate()) as sock:
        answer(sock)
        assert store(sock, "1.2.1", encoded(mr_data_set("1.2.1"))) == 0
        sock.settimeout(0.9)
        with pytest.raises(TimeoutError):
            sock.recv(1)
        sock.settimeout(60)
        assert store(sock, "1.2.2", encoded(mr_data_set("1.2.2"))) == 0
        assert answer(sock)[0] == ABORTED
        wait_for(lambda: endings(server))
        assert endings(server) == ["association of 'SCANNER' (127.0.0.1): nothing arrived for 2 s"]


@pytest.mark.parametrize(
    ("uid", "command"),
    [("1.2.3", {"priority": 3}), ("1." + "2" * 68, {}), ("", {})],
    ids=["priority 3", "UID of 70 characters", "no UID"],
)
def test_an_odd_store_request_is_answered_and_kept_under_the_uid_of_its_data_set(
    tmp_path, uid, command
):
    with serving(tmp_path) as server, connected(server, associate()) as sock:
        answer(sock)
        data = encoded(mr_data_set(uid or "1.2.9"))
        assert store(sock, uid, data, **command) == 0
        (path,) = server.stored
        assert (uid or "1.2.9").encode() in path.read_bytes()


def test_a_message_that_cannot_be_read_ends_the_association_with_a_line(tmp_path):
    with serving(tmp_path) as server, connected(server, associate()) as sock:
        answer(sock)
        sock.sendall(p_data(3, store_command("")) + p_data(2, b"\x10\0\x10\0LO\2\0ab"))
        assert answer(sock)[0] == ABORTED
        wait_for(lambda: endings(server))
        assert "an unreadable message: a C-STORE without a SOP Instance UID" in endings(server)[0]


def test_no_more_contexts_than_there_are_make_a_request():
    with pytest.raises(MalformedRequestError, match="half an item header"):
        mended_request(associate() + b"\x20")
    whole = associate()
    assert mended_request(whole).pdu == whole


@needs_program("dcmsend")
def test_a_transfer_does_not_stop_at_kinds_of_objects_that_nobody_knows(tmp_path):
    kinds = {
        "a": "1.2.840.10008.5.1.4.1.1.4",
        "b": "1.3.46.670589.11.0.0.12.2",  # Philips MR series data
        "c": "1.3.12.2.1107.5.9.1",  # Siemens CSA non-image
        "d": "1.2.840.10008.5.1.4.1.1.8",  # retired
        "e": "1.2.840.10008.5.1.4.1.1.4",
    }
    for number, (name, sop_class) in enumerate(kinds.items()):
        data_set = mr_data_set(f"1.2.{number + 1}")
        data_set.SOPClassUID = data_set.file_meta.MediaStorageSOPClassUID = sop_class
        data_set.save_as(tmp_path / f"{name}.dcm", enforce_file_format=True)
    files = sorted(str(path) for path in tmp_path.glob("*.dcm"))
    with serving(tmp_path) as server:
        command = ["dcmsend", "-aec", "AUTOSPINE", "127.0.0.1", str(server.port), *files]
        assert subprocess.run(command, capture_output=True).returncode == 0
        assert len(server.stored) == len(kinds)


def test_what_is_known_to_be_no_object_is_not_stored():
    find, commitment, print_meta = (
        "1.2.840.10008.5.1.4.1.2.2.1",
        "1.2.840.10008.1.20.1",
        "1.2.840.10008.5.1.1.9",
    )
    assert not any(is_storage(uid) for uid in (find, commitment, print_meta))
    assert all(is_storage(uid) for uid in ("1.2.840.113619.4.30", "1.2.840.10008.5.1.4.1.1.8"))
