"""The service on the network, with real peers: what is stored, what is refused, and how."""

import contextlib
import io
import json
import os
import shutil
import socket
import ssl
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import trustme
from listener_room import needs_program, wait_for
from made_slices import mr_data_set
from pydicom import dcmread
from pydicom.uid import UID, ExplicitVRBigEndian, ExplicitVRLittleEndian, JPEGLosslessSV1
from pynetdicom import AE, StoragePresentationContexts
from pynetdicom.association import Association
from pynetdicom.dimse_primitives import C_STORE
from real_slices import DICOM

from dicom_listener.association_fix import mended
from dicom_listener.inbox import Inbox, data_set_bytes, is_whole, read_envelope
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.negotiation import VERIFICATION
from dicom_listener.network.bounded_socket import acknowledge_at_once
from dicom_listener.scp import Scp, ScpRules, tls_context
from dicom_slice.quirks import MR_CLASSES, MR_IMAGE

FOLDER = DICOM / "hazen" / "nist_T2_site4_philips_plate5"
CT_IMAGE = "1.2.840.10008.5.1.4.1.1.2"


class Serving:
    """A service on a free port with a fresh inbox."""

    def __init__(self, folder: Path, tls: ssl.SSLContext | None = None, **rules) -> None:
        min_free_bytes = rules.pop("min_free_bytes", 0)
        asked = rules.pop("commitment", None)
        self.inbox = Inbox(folder / "inbox", min_free_bytes=min_free_bytes)
        self.metrics = ListenerMetrics()
        self.stored: list[Path] = []
        self.scp = Scp(ScpRules(**rules), self.inbox, self.metrics, self.stored.append, tls, asked)
        self.scp.start()
        self.port = self.scp.port

    def count(self, name: str, **labels: str) -> float:
        value = self.metrics.registry.get_sample_value(f"autospine_listener_{name}", labels)
        return value or 0.0

    def close(self) -> None:
        self.scp.stop()


@contextlib.contextmanager
def serving(folder: Path, tls: ssl.SSLContext | None = None, **rules) -> Iterator[Serving]:
    server = Serving(folder, tls, **rules)
    try:
        yield server
    finally:
        server.close()


@contextlib.contextmanager
def associated(
    port: int,
    *,
    sop_class: str = MR_IMAGE,
    syntaxes: tuple[str, ...] = (ExplicitVRLittleEndian,),
    called: str = "AUTOSPINE",
    calling: str = "SCANNER",
) -> Iterator[Association]:
    ae = AE(calling)
    ae.add_requested_context(sop_class, list(syntaxes))
    association = mended(ae.associate("127.0.0.1", port, ae_title=called))
    try:
        yield association
    finally:
        if association.is_established:
            association.release()


def run(program: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [program, *map(str, words)], capture_output=True, text=True, timeout=60, check=False
    )


@needs_program("dcmsend")
def test_what_dcmsend_sends_is_in_the_inbox_with_how_it_came(tmp_path):
    files = sorted(FOLDER.iterdir())[:4]
    with serving(tmp_path) as server:
        sent = run("dcmsend", "-aec", "AUTOSPINE", "127.0.0.1", server.port, *files)
        assert sent.returncode == 0, sent.stderr
        kept = server.inbox.files()
        assert len(kept) == len(server.stored) == 4
        for source, path in zip(files, kept, strict=True):
            envelope, start = read_envelope(path)
            assert is_whole(path)
            assert dcmread(path) == dcmread(source)  # dcmsend itself encodes anew
            assert envelope.calling_ae_title == "DCMSEND"
            assert envelope.called_ae_title == "AUTOSPINE"
            assert envelope.peer_address == "127.0.0.1"
            assert envelope.transfer_syntax_uid == ExplicitVRLittleEndian
            assert abs(envelope.received_s - time.time()) < 60
            assert start > 132


@needs_program("storescu")
@pytest.mark.parametrize("option", ["-xe", "-xi", "-xb"])
def test_storescu_may_choose_any_uncompressed_encoding(tmp_path, option):
    with serving(tmp_path) as server:
        sent = run(
            "storescu", option, "-aec", "AUTOSPINE", "127.0.0.1", server.port, FOLDER / "IM_0407"
        )
        assert sent.returncode == 0, sent.stderr
        (path,) = server.inbox.files()
        assert (dcmread(path).pixel_array == dcmread(FOLDER / "IM_0407").pixel_array).all()


@needs_program("echoscu")
def test_echoscu_is_answered(tmp_path):
    with serving(tmp_path) as server:
        assert run("echoscu", "-aec", "AUTOSPINE", "127.0.0.1", server.port).returncode == 0
        assert server.count("echoes_total") == 1


def certificates(folder: Path) -> tuple[trustme.CA, trustme.CA]:
    ours, theirs = trustme.CA(), trustme.CA()
    for name, authority in (("ours", ours), ("stranger", theirs)):
        certificate = authority.issue_cert("localhost", "127.0.0.1")
        certificate.private_key_pem.write_to_path(folder / f"{name}.key")
        certificate.cert_chain_pems[0].write_to_path(folder / f"{name}.crt")
    ours.cert_pem.write_to_path(folder / "authority.crt")
    return ours, theirs


@needs_program("echoscu")
@needs_program("storescu")
def test_mutual_tls_lets_in_those_with_a_certificate_and_nobody_else(tmp_path):
    certificates(tmp_path)
    files = (tmp_path / "ours.crt", tmp_path / "ours.key", tmp_path / "authority.crt")
    slice_file = tmp_path / "slice.dcm"
    mr_data_set().save_as(slice_file)
    with serving(tmp_path, tls_context(*files), acse_timeout_s=30.0) as server:
        address = ("-aec", "AUTOSPINE", "127.0.0.1", server.port)
        trusted = ("+tls", files[1], files[0], "+cf", files[2])
        assert run("echoscu", *trusted, *address).returncode == 0
        assert run("storescu", *trusted, *address, slice_file).returncode == 0
        assert len(server.inbox.files()) == 1
        stranger = ("+tls", tmp_path / "stranger.key", tmp_path / "stranger.crt", "+cf", files[2])
        assert run("echoscu", *stranger, *address).returncode != 0
        assert run("echoscu", "-to", "3", "-ta", "3", *address).returncode != 0  # no TLS at all
        silent = socket.create_connection(("127.0.0.1", server.port))  # a handshake without end
        assert run("echoscu", *trusted, *address).returncode == 0
        silent.close()
        wait_for(lambda: server.count("connections_dropped_total") >= 3)


@pytest.mark.parametrize(
    ("rules", "peer", "text"),
    [
        ({}, {"called": "OTHER"}, "called AE title 'OTHER'"),
        ({"calling_ae_titles": ("MR1",)}, {}, "calling AE title 'SCANNER'"),
        ({"peer_networks": ("10.1.0.0/16", "192.168.1.7")}, {}, "address 127.0.0.1"),
    ],
)
def test_who_is_not_on_the_list_is_rejected_with_a_readable_report(tmp_path, rules, peer, text):
    with serving(tmp_path, **rules) as server:
        with associated(server.port, **peer) as association:
            assert association.is_rejected
        wait_for(lambda: len(server.scp.reports) == 1)
        report = server.scp.reports[0]
        assert text in str(report)
        assert not report.accepted
        assert server.scp.alarms[0][0] == "association_rejected"
        allowed = {"calling_ae_titles": ("SCANNER",), "peer_networks": ("127.0.0.0/8",)}
        with serving(tmp_path / "b", **allowed) as open_server, associated(open_server.port) as a:
            assert a.is_established


def test_an_ipv4_sender_to_a_dual_stack_listener_is_known_by_its_ipv4_address(tmp_path):
    only = {"host": "::", "peer_networks": ("127.0.0.0/8",)}
    with serving(tmp_path, **only) as server:
        with associated(server.port) as association:
            assert association.is_established
        ipv6 = AE("SCANNER")
        ipv6.add_requested_context(MR_IMAGE)
        assert ipv6.associate("::1", server.port, ae_title="AUTOSPINE").is_rejected


def test_what_cannot_be_decoded_is_refused_at_negotiation_and_the_report_says_so(tmp_path):
    mpeg = "1.2.840.10008.1.2.4.102"
    with serving(tmp_path, any_storage_class=False) as server:
        ae = AE("SCANNER")
        ae.add_requested_context(MR_IMAGE, [mpeg])
        ae.add_requested_context(CT_IMAGE, [ExplicitVRLittleEndian])
        ae.add_requested_context(
            MR_IMAGE, [JPEGLosslessSV1, ExplicitVRBigEndian, UID("1.2.840.10008.1.2.1")]
        )
        association = ae.associate("127.0.0.1", server.port, ae_title="AUTOSPINE")
        assert [cx.transfer_syntax for cx in association.accepted_contexts] == [
            [ExplicitVRLittleEndian]
        ]
        association.release()
        report = str(server.scp.reports[0])
    assert "CT Image Storage" in report
    assert "this kind of object is not stored here" in report
    assert "none of these encodings can be decoded here" in report
    assert "accepted in Explicit VR Little Endian" in report


def test_of_many_contexts_only_what_matters_is_an_alarm_and_in_one_line(tmp_path):
    """As a scanner proposes everything that it knows, on every association."""
    mpeg = UID("1.2.840.10008.1.2.4.102")
    others = [str(c.abstract_syntax) for c in StoragePresentationContexts]
    others = [uid for uid in others if uid not in MR_CLASSES]
    with serving(tmp_path, any_storage_class=False) as server:
        for lost in (False, True):
            for _ in range(3):
                ae = AE("SCANNER")
                ae.add_requested_context(MR_IMAGE, [mpeg] if lost else [ExplicitVRLittleEndian])
                for uid in others[:59]:
                    ae.add_requested_context(uid)
                association = ae.associate("127.0.0.1", server.port, ae_title="AUTOSPINE")
                assert association.is_established or lost
                if association.is_established:
                    association.release()
            said = [text for kind, text in server.scp.alarms if kind == "contexts_refused"]
            assert len(said) == lost, "each thing is said once"
        assert "MR Image Storage in MPEG-4 AVC/H.264 High Profile" in said[0]
        assert "can be decoded here" in said[0]
        assert len(said[0]) < 300
        assert len(server.scp.reports) == 6, "the whole account is kept beside"


def test_low_disk_is_answered_out_of_resources_and_nothing_is_left_behind(tmp_path):
    free = shutil.disk_usage(tmp_path).free
    with serving(tmp_path, min_free_bytes=free * 2) as server:
        with associated(server.port) as association:
            status = association.send_c_store(mr_data_set())
        assert status.Status == 0xA700
        assert "disk low" in status.ErrorComment
        assert list((tmp_path / "inbox").iterdir()) == []
        assert server.count("slices_refused_total", status="A700") == 1


def test_a_folder_that_cannot_be_written_is_answered_out_of_resources(tmp_path):
    with serving(tmp_path) as server:
        shutil.rmtree(tmp_path / "inbox")
        (tmp_path / "inbox").write_text("a file where the folder was")
        with associated(server.port) as association:
            status = association.send_c_store(mr_data_set())
        assert status.Status == 0xA700
        assert server.stored == []
        (tmp_path / "inbox").unlink()
        (tmp_path / "inbox").mkdir()
        with associated(server.port) as association:
            assert association.send_c_store(mr_data_set()).Status == 0


def send_raw(association: Association, data_set: bytes, uid: str = "1.2.3.4") -> int:
    """C-STORE bytes that are not, or not quite, a data set."""
    request = C_STORE()
    request.MessageID = 7
    request.AffectedSOPClassUID = MR_IMAGE
    request.AffectedSOPInstanceUID = uid
    request.Priority = 2
    request.DataSet = io.BytesIO(data_set)
    context = association.accepted_contexts[0].context_id
    association._reactor_checkpoint.clear()
    association.dimse.send_msg(request, context)
    _, answer = association.dimse.get_msg(block=True)
    association._reactor_checkpoint.set()
    return answer.Status


def encoded(folder: Path, **changes) -> bytes:
    data_set = mr_data_set()
    for name, value in changes.items():
        setattr(data_set, name, value)
    path = folder / "encoded.dcm"
    data_set.save_as(path, enforce_file_format=True)
    whole = path.read_bytes()
    return whole[144 + struct.unpack_from("<L", whole, 140)[0] :]


def test_the_data_set_is_kept_bit_for_bit_also_where_it_is_odd(tmp_path):
    odd = encoded(tmp_path) + struct.pack("<HH2sH", 0x7FE1, 0x0010, b"ZZ", 4) + b"\x00\xffab"
    with serving(tmp_path) as server, associated(server.port) as association:
        assert send_raw(association, odd) == 0
        (path,) = server.inbox.files()
        assert data_set_bytes(path) == odd
        assert is_whole(path)


def test_what_is_no_data_set_is_answered_cannot_understand(tmp_path):
    with serving(tmp_path) as server, associated(server.port) as association:
        for junk in (b"this is a letter, not a slice", bytes(64), os.urandom(1000), b"\x08\x00"):
            assert send_raw(association, junk) == 0xC000
        assert send_raw(association, encoded(tmp_path)) == 0
        assert len(server.inbox.files()) == 1


def test_a_data_set_of_another_sop_class_is_answered_so(tmp_path):
    with serving(tmp_path) as server, associated(server.port) as association:
        assert send_raw(association, encoded(tmp_path, SOPClassUID=CT_IMAGE)) == 0xA900
        assert server.inbox.files() == []


def test_an_object_over_the_limit_is_refused_and_one_far_over_it_ends_the_association(tmp_path):
    limit = 100_000
    with serving(tmp_path, max_object_bytes=limit) as server:
        head = encoded(tmp_path)
        with associated(server.port) as association:
            assert send_raw(association, head.ljust(limit + 1000, b"\0")) == 0xA700
            assert send_raw(association, head) == 0
        sender = socket.create_connection(("127.0.0.1", server.port))
        with pytest.raises(OSError, match=r".*"):
            flood(sender, 4 * limit)
        sender.close()
        with associated(server.port) as association:
            assert send_raw(association, head) == 0


def flood(sender: socket.socket, n_bytes: int) -> None:
    """An A-ASSOCIATE-RQ header that announces more than we ever read, and then as much."""
    sender.sendall(struct.pack(">BBL", 1, 0, 2**31))
    for _ in range(n_bytes // 1000):
        sender.sendall(bytes(1000))
        time.sleep(0.001)
    raise OSError("never refused")


@pytest.mark.filterwarnings("ignore:Invalid value for VR UI")
def test_no_uid_and_no_title_from_the_network_reaches_a_path(tmp_path):
    data_set = encoded(tmp_path)
    with serving(tmp_path) as server, associated(server.port, calling="../../EVIL") as association:
        assert send_raw(association, data_set, uid="../../../../tmp/evil") == 0
        (path,) = server.inbox.files()
        assert path.parent == tmp_path / "inbox"
        assert set(path.name) <= set("0123456789abcdef-.dcm")
        assert read_envelope(path)[0].calling_ae_title == "../../EVIL"


def test_bare_and_silent_connections_hold_nothing_for_long(tmp_path):
    with serving(tmp_path, acse_timeout_s=3.0, network_timeout_s=5.0) as server:
        before = threading.active_count()
        for _ in range(100):  # health checks
            socket.create_connection(("127.0.0.1", server.port)).close()
        silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(10)]
        half = socket.create_connection(("127.0.0.1", server.port))
        half.sendall(struct.pack(">BBL", 1, 0, 200) + bytes(50))  # half a PDU
        with associated(server.port) as association:  # served meanwhile
            assert association.send_c_store(mr_data_set()).Status == 0
        wait_for(lambda: server.count("connections_dropped_total") >= 110)
        wait_for(lambda: threading.active_count() <= before)
        for connection in (*silent, half):
            connection.close()


def test_more_associations_than_allowed_are_turned_away_and_the_rest_go_on(tmp_path):
    with serving(tmp_path, max_associations=2) as server, contextlib.ExitStack() as stack:
        first = stack.enter_context(associated(server.port))
        stack.enter_context(associated(server.port))
        third = stack.enter_context(associated(server.port))
        assert third.is_rejected
        assert first.send_c_store(mr_data_set()).Status == 0
        assert any("too many associations" in str(report) for report in server.scp.reports)


def test_an_association_that_falls_silent_is_ended(tmp_path):
    with serving(tmp_path, network_timeout_s=0.5) as server, associated(server.port) as association:
        wait_for(lambda: not association.is_established)
        assert association.is_aborted
        wait_for(lambda: server.scp.open_associations == 0)


def test_an_association_outlives_that_our_clock_is_set(tmp_path, monkeypatch):
    with serving(tmp_path) as server:
        ae = AE("SCANNER")
        ae.network_timeout = ae.acse_timeout = ae.dimse_timeout = None  # its own timers
        ae.add_requested_context(MR_IMAGE, [ExplicitVRLittleEndian])
        association = mended(ae.associate("127.0.0.1", server.port, ae_title="AUTOSPINE"))
        assert association.send_c_store(mr_data_set("1.2.1")).Status == 0
        wall_s = time.time
        for step_s in (3600.0, -3600.0):
            monkeypatch.setattr(time, "time", lambda step_s=step_s: wall_s() + step_s)
            time.sleep(0.2)  # some rounds of the association's own loop
            assert association.send_c_store(mr_data_set(f"1.2.{abs(int(step_s))}")).Status == 0
        association.release()


def test_four_senders_at_once_lose_nothing(tmp_path):
    def send(number: int) -> None:
        with associated(server.port, calling=f"SENDER{number}") as association:
            for k in range(25):
                uid = f"1.2.826.0.1.{number}.{k + 1}"
                assert association.send_c_store(mr_data_set(uid)).Status == 0

    with serving(tmp_path) as server:
        senders = [threading.Thread(target=send, args=(number,)) for number in range(4)]
        for thread in senders:
            thread.start()
        for thread in senders:
            thread.join()
        kept = server.inbox.files()
        assert len({read_envelope(path)[0].sop_instance_uid for path in kept}) == 100
        assert all(is_whole(path) for path in kept)


@pytest.mark.skipif(not hasattr(socket, "TCP_QUICKACK"), reason="no TCP_QUICKACK on this system")
def test_a_sender_with_nagles_algorithm_is_not_held_up(tmp_path):
    """40 ms is what a delayed acknowledgement would cost every message, once TCP has warmed up."""
    with serving(tmp_path) as server, associated(server.port) as association:
        association.dul.socket.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0)
        took_s = []
        for k in range(100):
            began_s = time.perf_counter()
            assert association.send_c_store(mr_data_set(f"1.2.826.0.2.{k + 1}")).Status == 0
            took_s.append(time.perf_counter() - began_s)
        assert sorted(took_s[40:])[5] < 0.035  # some of them: the machine may be busy


def test_where_quickack_does_not_exist_it_is_not_set(monkeypatch):
    monkeypatch.setattr("dicom_listener.network.bounded_socket._QUICKACK", None)
    with socket.socket() as sock:
        acknowledge_at_once(sock)


ORTHANC = shutil.which("Orthanc")


@pytest.mark.skipif(ORTHANC is None, reason="Orthanc is not installed")
def test_orthanc_forwards_to_us(tmp_path):
    with serving(tmp_path) as server:
        ports = free_ports(2)
        config = {
            "Name": "peer",
            "StorageDirectory": str(tmp_path / "orthanc"),
            "IndexDirectory": str(tmp_path / "orthanc"),
            "Plugins": [],
            "DicomAet": "ORTHANC",
            "DicomPort": ports[0],
            "HttpPort": ports[1],
            "AuthenticationEnabled": False,
            "RemoteAccessAllowed": False,
            "DicomModalities": {"us": ["AUTOSPINE", "127.0.0.1", server.port]},
        }
        (tmp_path / "orthanc.json").write_text(json.dumps(config))
        with (tmp_path / "orthanc.log").open("wb") as log_file:
            orthanc = subprocess.Popen(
                [str(ORTHANC), str(tmp_path / "orthanc.json")], stdout=log_file, stderr=log_file
            )
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{ports[1]}", timeout=20) as http:
                wait_for(lambda: answers(http), 20)
                slices = sorted(FOLDER.iterdir())[:3]
                ids = [
                    http.post("/instances", content=path.read_bytes()).json()["ID"]
                    for path in slices
                ]
                assert http.post("/modalities/us/store", json=ids).status_code == 200
        finally:
            orthanc.terminate()
            orthanc.wait(20)
        kept = {dcmread(path).SOPInstanceUID for path in server.inbox.files()}
        assert kept == {dcmread(path).SOPInstanceUID for path in slices}


def answers(http) -> bool:
    try:
        return http.get("/system").status_code == 200
    except httpx.HTTPError:
        return False


def free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


def test_verification_is_always_there(tmp_path):
    with (
        serving(tmp_path, any_storage_class=False) as server,
        associated(server.port, sop_class=VERIFICATION) as association,
    ):
        assert association.send_c_echo().Status == 0
