"""What a sender asks for beside slices, and out of step with them: it is answered, and lives on."""

import contextlib
import logging
import socket
import struct
import threading
from collections.abc import Iterator

import pytest
from listener_room import wait_for
from made_slices import mr_data_set
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian
from pynetdicom import AE, evt
from pynetdicom.sop_class import StorageCommitmentPushModel as Push
from pynetdicom.sop_class import StorageCommitmentPushModelInstance
from raw_pdus import (
    RELEASE,
    answer,
    associate,
    command,
    command_of,
    context,
    element,
    encoded,
    p_data,
    status_of,
    store_command,
)
from structlog.testing import capture_logs
from test_scp import Serving, serving

from dicom_listener.association_fix import mended
from dicom_listener.network.commitment import Commitment, KeptInstances
from dicom_slice.quirks import MR_IMAGE

ACCEPTED, DATA, RELEASED, ABORTED = 2, 4, 6, 7
WORKLIST = "1.2.840.10008.5.1.4.31"
REPORT, REPORT_ANSWER = 0x0100, 0x8100
DATA_SET = encoded(mr_data_set("1.2.3"))
ASKED = Dataset()
ASKED.TransactionUID = "1.2.840.1"
ASKED.ReferencedSOPSequence = [Dataset()]
ASKED.ReferencedSOPSequence[0].ReferencedSOPClassUID = MR_IMAGE
ASKED.ReferencedSOPSequence[0].ReferencedSOPInstanceUID = "1.2.1"
BOTH = associate(contexts=context(1) + context(3, str(Push)))


@contextlib.contextmanager
def connected(server: Serving, request: bytes = BOTH) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", server.port), 60) as sock:
        sock.sendall(request)
        assert answer(sock)[0] == ACCEPTED
        yield sock


def stored(sock: socket.socket, uid: str) -> int:
    sock.sendall(p_data(3, store_command(uid)) + p_data(2, encoded(mr_data_set(uid))))
    return status_of(answer(sock)[1])


def released(sock: socket.socket) -> bool:
    sock.sendall(RELEASE)
    return answer(sock)[0] == RELEASED


def alarms(server: Serving) -> list[tuple[str, str]]:
    return list(server.scp.alarms)


@pytest.mark.parametrize(
    ("said", "status", "why"),
    [
        (p_data(3, command(0x0150)), 0x0211, "an N-DELETE, which is not offered here"),
        (p_data(3, command(0x0130)), 0x0211, "an N-ACTION, which is not offered here"),
        (p_data(3, command(0x0100)), 0x0211, "an N-EVENT-REPORT, which is not offered here"),
        (
            p_data(3, command(0x0020, has_data=True)) + p_data(2, DATA_SET),
            0x0122,
            "a C-FIND, which is not offered here",
        ),
        (p_data(3, command(0x0020)), 0x0122, "a C-FIND, which is not offered here"),
        (p_data(3, command(0x0021)), 0x0122, "a C-MOVE, which is not offered here"),
        (p_data(3, command(0x0030)), 0x0122, "a C-ECHO of MR Image Storage"),
        (
            p_data(3, command(1, sop_class=WORKLIST, has_data=True)) + p_data(2, DATA_SET),
            0x0122,
            "a C-STORE of Modality Worklist Information Model - FIND, an object type that",
        ),
        (
            p_data(3, command(1, sop_class="1.2.3.4", has_data=True)) + p_data(2, DATA_SET),
            0x0122,
            "a C-STORE of 1.2.3.4, which was not proposed",
        ),
    ],
)
def test_what_is_not_offered_is_refused_with_a_status_and_the_slice_behind_it_is_stored(
    tmp_path, said, status, why
):
    with serving(tmp_path) as server, connected(server, associate()) as sock:
        sock.sendall(said)
        kind, body = answer(sock)
        assert (kind, status_of(body)) == (DATA, status)
        assert command_of(body) == 0x8000 | command_of(said)
        assert stored(sock, "1.2.4") == 0
        assert released(sock)
        wait_for(lambda: server.count("association_endings_total", ending="released") == 1)
        ((code, text),) = alarms(server)
        assert code == ("slice_refused" if "C-STORE" in why else "not_offered")
        assert text.startswith(f"association of 'SCANNER' (127.0.0.1): {why}")
        assert text.endswith(f"; answered 0x{status:04X}")
        assert server.count("alarms_total", kind=code) == 1


def commitment(**keys) -> Commitment:
    return Commitment(KeptInstances(lambda: []), "AUTOSPINE", **keys)


def request_for_commitment() -> bytes:
    fields = element(0x0003, str(Push).encode()) + element(0x0100, struct.pack("<H", 0x0130))
    fields += element(0x0110, b"\1\0") + element(0x0800, b"\0\0")
    fields += element(0x1001, StorageCommitmentPushModelInstance.encode())
    fields += element(0x1008, b"\1\0")
    whole = element(0, struct.pack("<L", len(fields))) + fields
    return p_data(3, whole, 3) + p_data(2, encoded(ASKED), 3)


def ask(sock: socket.socket) -> int:
    """Send a request for commitment; return its status."""
    sock.sendall(request_for_commitment())
    return status_of(answer(sock)[1])


def message_id(body: bytes) -> int:
    at = body.index(struct.pack("<HHL", 0, 0x0110, 2))
    return int(struct.unpack_from("<H", body, at + 8)[0])


def next_report(sock: socket.socket) -> int:
    """Wait for a report; return its message ID."""
    kind, body = answer(sock)
    assert (kind, command_of(body)) == (DATA, REPORT)
    assert answer(sock)[0] == DATA  # its data set
    return message_id(body)


def answer_report(sock: socket.socket, number: int) -> None:
    sock.sendall(p_data(3, command(REPORT_ANSWER, sop_class=str(Push), number=number), 3))


def test_slices_that_come_before_the_answer_to_a_report_are_stored(tmp_path):
    with serving(tmp_path, commitment=commitment()) as server, connected(server) as sock:
        for _ in range(2):
            assert ask(sock) == 0
        number = next_report(sock)
        for uid in ("1.2.1", "1.2.2", "1.2.3"):
            assert stored(sock, uid) == 0
        answer_report(sock, number)
        answer_report(sock, next_report(sock))  # the second one waited for the first
        assert stored(sock, "1.2.4") == 0
        assert released(sock)
        wait_for(lambda: server.count("association_endings_total", ending="released") == 1)
        assert len(server.stored) == 4
        assert alarms(server) == []


def test_a_console_that_stores_while_it_takes_its_report_is_not_aborted(tmp_path):
    """pynetdicom's own sender, which answers a report in a thread beside."""
    reported, may_answer, answering = threading.Event(), threading.Event(), []

    def on_report(event: evt.Event) -> tuple[int, None]:
        answering.append(threading.current_thread())
        reported.set()
        may_answer.wait(60)
        return 0x0000, None

    ae = AE("CONSOLE")
    ae.add_requested_context(MR_IMAGE, ExplicitVRLittleEndian)
    ae.add_requested_context(Push)
    with serving(tmp_path, commitment=commitment()) as server:
        handlers = [(evt.EVT_N_EVENT_REPORT, on_report)]
        association = mended(
            ae.associate("127.0.0.1", server.port, ae_title="AUTOSPINE", evt_handlers=handlers)
        )
        asked, _ = association.send_n_action(ASKED, 1, Push, StorageCommitmentPushModelInstance)
        assert asked.Status == 0
        assert reported.wait(60)
        for number in range(20):
            assert association.send_c_store(mr_data_set(f"1.2.{number + 1}")).Status == 0
        may_answer.set()
        answering[0].join()  # until then pynetdicom may say that nothing is paused
        assert association.send_c_store(mr_data_set("1.2.99")).Status == 0
        association.release()
        wait_for(lambda: server.count("association_endings_total", ending="released") == 1)
        assert [kind for kind, _ in alarms(server)] in ([], ["commitment_unreported"])
        assert len(server.stored) == 21


def test_a_report_that_is_never_answered_is_told_once_and_costs_no_slice(tmp_path):
    rules = {"dimse_timeout_s": 0.5, "commitment": commitment()}
    with serving(tmp_path, **rules) as server, connected(server) as sock:
        assert ask(sock) == 0
        number = next_report(sock)
        wait_for(lambda: alarms(server))
        assert stored(sock, "1.2.1") == 0
        answer_report(sock, number)  # after all
        assert stored(sock, "1.2.2") == 0
        assert released(sock)
        text = "SCANNER could not be informed of transaction 1.2.840.1: no answer within 0.5 s"
        assert alarms(server) == [("commitment_unreported", text)]
        assert server.count("alarms_total", kind="commitment_unreported") == 1


def test_a_console_that_asks_on_without_an_answer_to_its_reports_is_told_to_wait(tmp_path):
    with serving(tmp_path, commitment=commitment()) as server, connected(server) as sock:
        for _ in range(40):
            sock.sendall(request_for_commitment())
        statuses, numbers = [], []
        while len(statuses) < 40:
            kind, body = answer(sock)
            assert kind == DATA
            if command_of(body) == REPORT:
                numbers.append(message_id(body))
                assert answer(sock)[0] == DATA
            else:
                statuses.append(status_of(body))
        assert statuses == [0] * 32 + [0x0213] * 8
        answer_report(sock, numbers[0] if numbers else next_report(sock))
        for _ in range(31):
            answer_report(sock, next_report(sock))
        wait_for(lambda: ask(sock) == 0)
        assert stored(sock, "1.2.1") == 0


@pytest.mark.parametrize(
    ("how", "kind", "why"),
    [
        ("release", "released", "the association ended before it was answered"),
        ("refuse", "released", "it answered 0x0110"),
        ("close", "closed", "the association ended before it was answered"),
    ],
)
def test_a_report_that_is_not_taken_is_told(tmp_path, how, kind, why):
    with serving(tmp_path, commitment=commitment()) as server:
        with connected(server) as sock:
            assert ask(sock) == 0
            number = next_report(sock)
            if how == "refuse":
                refusal = command(REPORT_ANSWER, sop_class=str(Push), number=number)
                refusal = refusal.replace(element(0x0900, b"\0\0"), element(0x0900, b"\x10\1"))
                sock.sendall(p_data(3, refusal, 3))
                wait_for(lambda: alarms(server))
            if how != "close":
                assert released(sock)
        wait_for(lambda: server.count("association_endings_total", ending=kind) == 1)
        wait_for(lambda: server.count("alarms_total", kind="commitment_unreported") == 1)
        text = f"SCANNER could not be informed of transaction 1.2.840.1: {why}"
        assert ("commitment_unreported", text) in alarms(server)


def test_who_releases_before_the_answer_is_told_where_the_configuration_says(tmp_path):
    reports = []

    def on_report(event: evt.Event) -> tuple[int, None]:
        reports.append(event.event_information)
        return 0x0000, None

    console = AE("SCANNER")
    console.add_supported_context(Push, scu_role=True, scp_role=True)
    handlers = [(evt.EVT_N_EVENT_REPORT, on_report)]
    elsewhere = console.start_server(("127.0.0.1", 0), block=False, evt_handlers=handlers)
    place = ("127.0.0.1", elsewhere.server_address[1])
    asked = commitment(reports_to={"SCANNER": place})
    try:
        with serving(tmp_path, commitment=asked) as server:
            with connected(server) as sock:
                assert ask(sock) == 0
                next_report(sock)
                assert released(sock)
            wait_for(lambda: reports)
            assert reports[0].TransactionUID == "1.2.840.1"
            assert alarms(server) == []
    finally:
        elsewhere.shutdown()


def test_a_sender_that_waits_for_no_answer_is_read_as_fast_as_its_slices_are_stored(tmp_path):
    n_slices, may_store = 300, threading.Event()
    slice_ = p_data(3, store_command("1.2.3")) + p_data(2, DATA_SET + bytes(100_000))
    with serving(tmp_path) as server:
        server.scp._on_stored = lambda path: may_store.wait(60)
        with connected(server, associate()) as sock:
            sending = threading.Thread(target=lambda: sock.sendall(slice_ * n_slices))
            sending.start()
            wait_for(lambda: alarms(server))
            (association,) = server.scp._server.active_associations
            most = association.dul.socket.most_unanswered
            sending.join(2)
            assert sending.is_alive()
            assert association.dul.socket.unanswered <= most
            assert association.dimse.msg_queue.qsize() <= most
            may_store.set()
            assert [status_of(answer(sock)[1]) for _ in range(n_slices)] == [0] * n_slices
            sending.join()
            assert released(sock)
        wait_for(lambda: server.count("association_endings_total", ending="released") == 1)
        ((kind, text),) = alarms(server)
        assert kind == "sends_ahead"
        assert text.startswith("association of 'SCANNER' (127.0.0.1): it sends on without waiting")


def test_large_messages_fill_it_sooner(tmp_path):
    may_store = threading.Event()
    slice_ = p_data(3, store_command("1.2.3")) + p_data(2, DATA_SET + bytes(900_000))
    with serving(tmp_path) as server:
        server.scp._server.socket_class.most_unanswered_bytes = 2_000_000
        server.scp._on_stored = lambda path: may_store.wait(60)
        with connected(server, associate()) as sock:
            sending = threading.Thread(target=lambda: sock.sendall(slice_ * 15))
            sending.start()
            wait_for(lambda: alarms(server))
            (association,) = server.scp._server.active_associations
            assert association.dul.socket.unanswered <= 3
            may_store.set()
            assert [status_of(answer(sock)[1]) for _ in range(15)] == [0] * 15
            sending.join()


def test_a_sender_that_is_not_read_for_long_is_not_taken_for_silent(tmp_path):
    may_store = threading.Event()
    slice_ = p_data(3, store_command("1.2.3")) + p_data(2, DATA_SET)
    with serving(tmp_path, network_timeout_s=1.0, dimse_timeout_s=1.0) as server:
        server.scp._on_stored = lambda path: may_store.wait(60)
        with connected(server, associate()) as sock:
            sock.sendall(slice_ * 40)
            wait_for(lambda: alarms(server))
            assert not may_store.wait(2.5)
            may_store.set()
            assert [status_of(answer(sock)[1]) for _ in range(40)] == [0] * 40


@pytest.mark.parametrize("where", ["association", "dul"])
def test_an_error_that_nobody_has_foreseen_is_in_the_log_with_its_traceback(tmp_path, where):
    with serving(tmp_path) as server, capture_logs() as logs:
        with connected(server, associate()) as sock:
            (association,) = server.scp._server.active_associations

            def broken(*_args, **_keys):
                raise ZeroDivisionError("by nobody foreseen")

            if where == "association":
                association.dimse.get_msg = broken
            else:
                association.dul.state_machine.do_action = broken
                sock.sendall(p_data(3, command(0x0030)))
            assert answer(sock)[0] in (0, ABORTED)
        wait_for(lambda: server.scp.open_associations == 0)
        (entry,) = (e for e in logs if e["log_level"] == "error")
        assert entry["exc_info"]
        (text,) = (text for kind, text in alarms(server) if kind == "association_ended")
        assert "ended by an error here (ZeroDivisionError('by nobody foreseen'))" in text
        assert server.count("association_endings_total", ending="internal_error") == 1


def test_an_error_that_pynetdicom_keeps_to_itself_is_in_the_log_too():
    with capture_logs() as logs:
        for error in (ZeroDivisionError("unforeseen"), ConnectionRefusedError("a console is off")):
            try:
                raise error
            except Exception as caught:
                logging.getLogger("pynetdicom.dul").exception(caught)
    (entry,) = logs
    assert (entry["log_level"], entry["text"]) == ("error", "unforeseen")
    assert entry["exc_info"]
