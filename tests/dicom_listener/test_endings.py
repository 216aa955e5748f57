"""Every ending of an association has a line, an event and a counter; what DCMTK takes is taken."""

import contextlib
import socket
import ssl
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
    command,
    context,
    encoded,
    item,
    p_data,
    pdu,
    status_of,
    store_command,
)
from test_scp import Serving, certificates, serving

from dicom_listener.negotiation import is_storage
from dicom_listener.network.association_request import MalformedRequestError, mended_request
from dicom_listener.network.conversation import BreachError, Phase, check_turn
from dicom_listener.scp import tls_context

ACCEPTED, REJECTED, DATA, RELEASED, ABORTED = 2, 3, 4, 6, 7
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


DATA_SET = encoded(mr_data_set("1.2.3"))
TWO_PARTS = struct.pack(">LBB", len(command(0x30)) + 2, 1, 3) + command(0x30)


@pytest.mark.parametrize(
    ("said", "kind", "why"),
    [
        (p_data(3, store_command("1.2.3")) + RELEASE, "unfinished", "released, in the middle of a"),
        (
            p_data(3, store_command("1.2.3")) + p_data(0, DATA_SET[:500]) + RELEASE,
            "unfinished",
            "released, in the middle of a message (6",
        ),
        (p_data(1, store_command("1.2.3")[:30]) + RELEASE, "unfinished", "released, in the middle"),
        (p_data(3, command(0x7777)), "not_offered", "an unknown command (0x7777), which is not of"),
        (p_data(3, command(0x8001)), "not_offered", "a C-STORE response without a request"),
        (p_data(3, command(0x8100)), "not_offered", "an N-EVENT-REPORT response without a req"),
        (
            p_data(3, store_command("1.2.3"), 5) + p_data(2, DATA_SET, 5),
            "not_offered",
            "a C-STORE on presentation context 5, which was not accepted",
        ),
        (p_data(2, DATA_SET), "out_of_turn", "a data set without a command"),
        (p_data(0, DATA_SET[:100]), "out_of_turn", "a data set without a command"),
        (
            p_data(1, store_command("1.2.3")[:30]) + p_data(2, DATA_SET),
            "out_of_turn",
            "a data set in the middle of its command, in the middle of a message (42 bytes",
        ),
        (
            p_data(3, store_command("1.2.3")) + p_data(3, store_command("1.2.4")),
            "out_of_turn",
            "a command before the data set of a C-STORE was complete, in the middle of a message (",
        ),
        (
            p_data(3, store_command("1.2.3")) + p_data(2, DATA_SET, 3),
            "out_of_turn",
            "one message on two presentation contexts, in the middle of a message (",
        ),
        (pdu(4, TWO_PARTS + TWO_PARTS), "out_of_turn", "two messages in one PDU"),
        (associate(), "out_of_turn", "a second association request"),
        (
            p_data(3, store_command("1.2.3")) + associate(),
            "out_of_turn",
            "a second association request, in the middle of a message (112 bytes",
        ),
        (pdu(2), "out_of_turn", "an acceptance of an association without a request"),
        (pdu(6), "out_of_turn", "an answer to a release without a request"),
        (pdu(9), "unreadable", "an unknown kind of PDU (0x09)"),
        (pdu(4, b""), "unreadable", "a PDU for a message with nothing in it"),
        (
            pdu(4, b"\0\0\0\x64\1\3ab"),
            "unreadable",
            "a part of a message that does not fit its PDU",
        ),
        (p_data(3, b"\xff" * 40), "unreadable", "an unreadable command"),
        (p_data(3, command(1)[:20]), "unreadable", "an unreadable command"),
        (p_data(3, b""), "unreadable", "a command that does not say what it is"),
        (
            p_data(3, command(1, has_data=True).replace(b"\x10\1\2", b"\x20\1\2"))
            + p_data(2, DATA_SET),
            "unreadable",
            "an unreadable message: its message ID, SOP class or status is missing",
        ),
    ],
)
def test_what_is_said_out_of_turn_or_not_offered_ends_with_its_reason(tmp_path, said, kind, why):
    with serving(tmp_path) as server:
        with connected(server, associate()) as sock:
            assert answer(sock)[0] == ACCEPTED
            sock.sendall(said)
            assert answer(sock)[0] == (RELEASED if kind == "unfinished" else ABORTED)
        wait_for(lambda: endings(server))
        (line,) = endings(server)
        assert line.startswith(f"association of 'SCANNER' (127.0.0.1): {why}")
        assert server.count("association_endings_total", ending=kind) == 1
        assert server.count("alarms_total", kind="association_ended") == 1
        assert server.stored == []
        wait_for(lambda: server.scp.open_associations == 0)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (p_data(3, store_command("1.2.3")), "a message before any association request"),
        (RELEASE, "a release before any association request"),
        (ABORT, "an abort before any association request"),
        (pdu(2), "an acceptance of an association before any association request"),
        (associate()[:50], "no whole association request within 0.3 s"),
    ],
)
def test_who_speaks_before_an_association_is_named(tmp_path, said, why):
    with serving(tmp_path, acse_timeout_s=0.3) as server:
        with connected(server, said) as sock:
            assert sock.recv(1) == b""
        wait_for(lambda: endings(server))
        assert endings(server) == [f"connection of 127.0.0.1: {why}"]
        assert server.count("association_endings_total", ending="no_request") == 1
        assert server.count("connections_dropped_total") == 1


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.0\r\n\r\n"])
def test_a_health_check_is_counted_and_gives_no_line(tmp_path, said):
    with serving(tmp_path) as server:
        with connected(server, said):
            pass
        wait_for(lambda: server.count("connections_dropped_total") == 1)
        assert endings(server) == []


@pytest.mark.parametrize(("version", "is_taken"), [(b"\0\3", True), (b"\0\2", False)])
def test_of_the_protocol_versions_that_are_offered_ours_must_be_one(tmp_path, version, is_taken):
    with serving(tmp_path) as server:
        with connected(server, associate()[:6] + version + associate()[8:]) as sock:
            assert answer(sock)[0] == (ACCEPTED if is_taken else REJECTED)
            if is_taken:
                return
        wait_for(lambda: endings(server))
        text = "connection of 127.0.0.1: an association by another protocol version"
        assert endings(server) == [text]
        assert server.count("association_endings_total", ending="not_offered") == 1


def test_a_message_before_the_association_is_accepted_ends_it_with_a_line(tmp_path):
    with serving(tmp_path) as server:
        with connected(server, associate() + p_data(3, store_command("1.2.3"))) as sock:
            wait_for(lambda: endings(server))
            sock.recv(1)
        assert "a message before the association was accepted" in endings(server)[0]
        assert server.count("association_endings_total", ending="out_of_turn") == 1
    with pytest.raises(BreachError, match="a message after the request for a release"):
        check_turn(DATA, Phase.RELEASING)


@pytest.mark.parametrize(
    ("said", "ending", "why"),
    [
        (p_data(3, store_command("1.2.3")), "out_of_turn", "a message before any association"),
        (pdu(9), "unreadable", "an unknown kind of PDU (0x09)"),
    ],
)
def test_over_tls_it_is_named_too(tmp_path, said, ending, why):
    certificates(tmp_path)
    ours, key, authority = (tmp_path / name for name in ("ours.crt", "ours.key", "authority.crt"))
    trusting = ssl.create_default_context(cafile=str(authority))
    trusting.load_cert_chain(ours, key)
    with serving(tmp_path, tls_context(ours, key, authority)) as server:
        plain = socket.create_connection(("127.0.0.1", server.port), 60)
        with trusting.wrap_socket(plain, server_hostname="localhost") as sock:
            sock.sendall(said)
            wait_for(lambda: endings(server))
        assert endings(server)[0].startswith(f"connection of 127.0.0.1: {why}")
        assert server.count("association_endings_total", ending=ending) == 1


def test_a_cancel_is_named_and_the_slice_behind_it_comes_through(tmp_path):
    with serving(tmp_path) as server, connected(server, associate()) as sock:
        answer(sock)
        sock.sendall(p_data(3, command(0x0FFF)))
        assert store(sock, "1.2.3", DATA_SET) == 0
        sock.sendall(RELEASE)
        assert answer(sock)[0] == RELEASED
        text = "association of 'SCANNER' (127.0.0.1): a C-CANCEL; there is nothing to cancel"
        assert list(server.scp.alarms) == [("message_ignored", text)]
        assert server.count("alarms_total", kind="message_ignored") == 1
        wait_for(lambda: server.count("association_endings_total", ending="released") == 1)


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
