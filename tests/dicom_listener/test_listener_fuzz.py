"""Mangled files and PDUs by the thousand: set aside or refused by name, and others still served."""

import random
import socket
import struct
from pathlib import Path

import pytest
from listener_room import ListenerProcess, wait_for, write_room
from made_slices import mr_data_set
from mangled import mangled, sources
from pynetdicom import AE
from pynetdicom.pdu import A_ASSOCIATE_RQ
from pynetdicom.pdu_primitives import A_ASSOCIATE

from case_record.record import CaseRecord
from dicom_listener.association_fix import mended
from dicom_listener.inbox import Envelope, Inbox, sha256_of
from dicom_slice.decode_guard import DecodeGuard
from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.header import read_header
from dicom_slice.quirks import MR_IMAGE
from dicom_slice.reasons import Reason, UnusableError

# Seeds that once did harm: a codec that panicked, one that aborted the process.
KEPT_SEEDS = (2779, 2785)


def files_campaign(folder: Path, seeds: list[int]) -> dict[str, int]:
    """Read each mangled file as the listener does; count what came of it."""
    wholes, path, guard = sources(folder), folder / "mangled.dcm", DecodeGuard()
    found: dict[str, int] = {}
    for seed in seeds:
        path.write_bytes(mangled(wholes[seed % len(wholes)], seed))
        try:
            slices = read_header(path)
            problems = guard.check(path, slices)
            reasons = [why_not_usable(slice_, SliceRules()) for slice_ in slices]
            outcome = "pixels" if problems else "kind" if any(reasons) else "used"
        except UnusableError as error:
            outcome = str(error.reason.code)
        found[outcome] = found.get(outcome, 0) + 1
    guard.close()
    return found


def test_mangled_files_are_read_or_set_aside_by_name(tmp_path):
    found = files_campaign(tmp_path, [*KEPT_SEEDS, *range(400)])
    assert sum(found.values()) == 402
    assert len(found) >= 4
    assert found.keys() - {"pixels", "kind", "used"} <= {str(reason) for reason in Reason}


@pytest.mark.soak
def test_ten_thousand_mangled_files_are_read_or_set_aside_by_name(tmp_path):
    assert sum(files_campaign(tmp_path, list(range(10_000))).values()) == 10_000


def association_request() -> bytes:
    primitive = A_ASSOCIATE()
    ae = AE("FUZZ")
    ae.add_requested_context(MR_IMAGE)
    primitive.application_context_name = "1.2.840.10008.3.1.1.1"
    primitive.calling_ae_title, primitive.called_ae_title = "FUZZ", "AUTOSPINE"
    contexts = ae.requested_contexts
    contexts[0].context_id = 1
    primitive.presentation_context_definition_list = contexts
    from pynetdicom.pdu_primitives import (
        ImplementationClassUIDNotification,
        MaximumLengthNotification,
    )

    length, implementation = MaximumLengthNotification(), ImplementationClassUIDNotification()
    length.maximum_length_received = 16384
    implementation.implementation_class_uid = "1.2.3"
    primitive.user_information = [length, implementation]
    pdu = A_ASSOCIATE_RQ()
    pdu.from_primitive(primitive)
    return pdu.encode()


def attack(port: int, seed: int, request: bytes) -> None:
    """Half of them mangle the request, half what follows it; some just stop in the middle."""
    dice = random.Random(seed)
    with socket.create_connection(("127.0.0.1", port), 5) as sock:
        sock.settimeout(0.2)
        try:
            if seed % 2:
                sock.sendall(mangled(request, seed))
            else:
                sock.sendall(request)
                sock.recv(4096)
                body = dice.randbytes(dice.randrange(200))
                kind, length = dice.choice((1, 2, 4, 4, 4, 5, 9)), dice.choice((len(body), 2**31))
                sock.sendall(struct.pack(">BBL", kind, 0, length) + body)
            if dice.random() < 0.3:
                sock.recv(4096)
        except OSError:
            return


def pdu_campaign(folder: Path, count: int) -> None:
    config = write_room(folder, acse_timeout_s=5.0, network_timeout_s=10.0, max_associations=64)
    listener = ListenerProcess(config)
    try:
        request = association_request()
        for seed in range(count):
            attack(listener.port, seed, request)
        # those who fell silent hold their places until the timeouts take them away
        wait_for(lambda: threads_of(listener.process.pid) < 12)
        ae = AE("SCANNER")
        ae.add_requested_context(MR_IMAGE)
        association = mended(ae.associate("127.0.0.1", listener.port, ae_title="AUTOSPINE"))
        assert association.is_established
        assert association.send_c_store(mr_data_set()).Status == 0
        association.release()
        assert listener.process.poll() is None
    finally:
        listener.end()


def threads_of(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def test_mangled_pdus_end_their_own_connection_and_nothing_else(tmp_path):
    pdu_campaign(tmp_path, 150)


@pytest.mark.soak
def test_thousands_of_mangled_pdus_end_their_own_connection_and_nothing_else(tmp_path):
    pdu_campaign(tmp_path, 5000)


def test_mangled_data_sets_in_the_inbox_all_reach_the_record(tmp_path):
    """What was accepted is never lost, however broken: it is in the record with a reason."""
    config = write_room(tmp_path)
    inbox = Inbox(tmp_path / "case" / "inbox")
    wholes = sources(tmp_path)
    count = 60
    for seed in range(count):
        data = mangled(wholes[seed % len(wholes)][400:], seed) + struct.pack("<L", seed)
        envelope = Envelope(
            "FUZZ", "AUTOSPINE", "127.0.0.1", 1, 1e9, 1.0, "1.2.840.10008.1.2.1", MR_IMAGE,
            f"1.2.{seed}", sha256_of(data), len(data),
        )  # fmt: skip
        inbox.store(data, envelope)
    listener = ListenerProcess(config)
    try:
        with CaseRecord(tmp_path / "case") as record:
            wait_for(lambda: len({r.sop_instance_uid for r in record.slices()}) == count)
            assert all(row.state == "quarantined" for row in record.slices())
            assert all(row.reason for row in record.slices())
            kinds = [event.body["alarm"] for event in record.events() if event.kind == "alarm"]
            assert "intake_failed" not in kinds
    finally:
        listener.end()
