"""Storage Commitment: a console asks what is safe, and is told on the same or a new association."""

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from listener_room import listening, wait_for, write_room
from made_slices import mr_data_set
from pydantic import ValidationError
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian
from pynetdicom import AE, evt
from pynetdicom.sop_class import StorageCommitmentPushModel, StorageCommitmentPushModelInstance
from raw_pdus import encoded
from test_listener_process import alarms, send

from case_record.record import CaseRecord
from dicom_listener.association_fix import mended
from dicom_listener.inbox import Envelope, Inbox, sha256_of
from dicom_listener.network.commitment import Commitment, KeptInstances
from dicom_slice.quirks import MR_IMAGE
from room_config.listener import ListenerConfig


class Console:
    """Asks, and keeps the reports that come."""

    def __init__(self) -> None:
        self.reports: list[tuple[int, Dataset]] = []
        self._answering: list[threading.Thread] = []

    def on_report(self, event: evt.Event) -> tuple[int, None]:
        self._answering.append(threading.current_thread())
        self.reports.append((event.event_type, event.event_information))
        return 0x0000, None

    @contextlib.contextmanager
    def asking(self, port: int, *uids: str, sop_class: str = MR_IMAGE) -> Iterator[int]:
        """The status of the request, while the association stands."""
        asked = request(*uids, sop_class=sop_class)
        ae = AE("CONSOLE")
        ae.add_requested_context(StorageCommitmentPushModel)
        handlers = [(evt.EVT_N_EVENT_REPORT, self.on_report)]
        association = mended(
            ae.associate("127.0.0.1", port, ae_title="AUTOSPINE", evt_handlers=handlers)
        )
        answer, _ = association.send_n_action(
            asked, 1, StorageCommitmentPushModel, StorageCommitmentPushModelInstance
        )
        yield answer.Status
        for thread in self._answering:  # until then pynetdicom may say that nothing is paused
            thread.join()
        association.release()

    def references(self, name: str) -> list[str]:
        (report,) = (information for _, information in self.reports)
        return [item.ReferencedSOPInstanceUID for item in report.get(name, [])]


def test_what_was_received_is_safe_and_what_was_not_is_not(tmp_path):
    console = Console()
    with listening(write_room(tmp_path)) as listener:
        send(listener.port, mr_data_set("1.2.1"), mr_data_set("1.2.2"))
        with console.asking(listener.port, "1.2.1", "1.2.2", "1.2.9") as status:
            assert status == 0x0000
            wait_for(lambda: console.reports)
    ((event_type, report),) = console.reports
    assert (event_type, report.TransactionUID) == (2, "1.2.840.1")
    assert console.references("ReferencedSOPSequence") == ["1.2.1", "1.2.2"]
    assert console.references("FailedSOPSequence") == ["1.2.9"]
    assert report.FailedSOPSequence[0].FailureReason == 0x0112


def test_where_all_is_safe_the_report_says_so_and_a_damaged_file_is_not(tmp_path):
    with listening(write_room(tmp_path)) as listener:
        send(listener.port, mr_data_set("1.2.1"))
        console = Console()
        with console.asking(listener.port, "1.2.1"):
            wait_for(lambda: console.reports)
        assert console.reports[0][0] == 1
        (path,) = (tmp_path / "case").rglob("*.dcm")
        path.chmod(0o600)
        path.write_bytes(path.read_bytes()[:-10] + b"0123456789")
        again = Console()
        with again.asking(listener.port, "1.2.1"):
            wait_for(lambda: again.reports)
        assert again.references("FailedSOPSequence") == ["1.2.1"]


def test_what_is_held_while_no_case_is_open_is_safe_and_so_is_what_is_sent_twice(tmp_path):
    config = write_room(tmp_path)
    config.write_text(config.read_text().replace("case_dir", "cases_dir"))
    with listening(config) as listener:
        send(listener.port, mr_data_set("1.2.1"))
        wait_for(lambda: list(tmp_path.rglob("holding/*.dcm")))
        for _ in range(3):
            send(listener.port, mr_data_set("1.2.1"))
            assert safe_of(listener.port, "1.2.1") == ["1.2.1"]


def safe_of(port: int, *uids: str) -> list[str]:
    console = Console()
    with console.asking(port, *uids):
        wait_for(lambda: console.reports)
    return console.references("ReferencedSOPSequence")


def kept_in(*folders: Path) -> KeptInstances:
    return KeptInstances(lambda: folders)


def stored(inbox: Inbox, uid: str, sop_class: str = MR_IMAGE) -> Path:
    data = encoded(mr_data_set(uid))
    envelope = Envelope(
        calling_ae_title="SCANNER",
        called_ae_title="AUTOSPINE",
        peer_address="127.0.0.1",
        peer_port=1,
        received_s=0.0,
        received_monotonic_s=0.0,
        transfer_syntax_uid=ExplicitVRLittleEndian,
        sop_class_uid=sop_class,
        sop_instance_uid=uid,
        sha256=sha256_of(data),
        size_bytes=len(data),
    )
    return inbox.store(data, envelope)


def test_an_instance_is_safe_as_long_as_one_of_its_files_is(tmp_path):
    room, case = Inbox(tmp_path / "room"), Inbox(tmp_path / "case")
    kept = kept_in(room.folder, case.folder)
    first = stored(case, "1.2.1")
    assert kept.problem(MR_IMAGE, "1.2.1") is None
    second = stored(room, "1.2.1")
    assert kept.problem(MR_IMAGE, "1.2.1") is None
    second.unlink()  # the duplicate was judged
    assert kept.problem(MR_IMAGE, "1.2.1") is None
    assert kept.problem(MR_IMAGE + ".1", "1.2.1") == 0x0119
    stored(room, "1.2.1", MR_IMAGE + ".1")
    assert kept.problem(MR_IMAGE + ".1", "1.2.1") is None
    first.write_bytes(first.read_bytes()[:-1])
    assert kept.problem(MR_IMAGE, "1.2.1") == 0x0119
    first.write_bytes(b"")
    assert kept.problem(MR_IMAGE, "1.2.1") == 0x0119


def test_a_file_that_is_moved_is_found_again_wherever_it_went(tmp_path):
    room, case = Inbox(tmp_path / "room"), Inbox(tmp_path / "case")
    kept = kept_in(room.folder, case.folder)
    path = stored(room, "1.2.1")
    assert kept.problem(MR_IMAGE, "1.2.1") is None
    for folder in (case.folder, room.folder, case.folder):
        path = path.rename(folder / path.name)
        report = Commitment(kept, "AUTOSPINE").report_on(request("1.2.1"))
        assert report[0] == 1


def request(*uids: str, sop_class: str = MR_IMAGE) -> Dataset:
    asked = Dataset()
    asked.TransactionUID = "1.2.840.1"
    asked.ReferencedSOPSequence = [Dataset() for _ in uids]
    for item, uid in zip(asked.ReferencedSOPSequence, uids, strict=True):
        item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = sop_class, uid
    return asked


def test_a_console_that_is_gone_is_told_on_an_association_of_its_own(tmp_path):
    console = Console()
    ae = AE("CONSOLE")
    ae.add_supported_context(StorageCommitmentPushModel, scu_role=True, scp_role=True)
    handlers = [(evt.EVT_N_EVENT_REPORT, console.on_report)]
    server = ae.start_server(("127.0.0.1", 0), block=False, evt_handlers=handlers)
    config = write_room(tmp_path)
    place = f"127.0.0.1:{server.server_address[1]}"
    key = f'commitment_reports_to = {{CONSOLE = "{place}"}}'
    config.write_text(config.read_text().replace("[service]", f"{key}\n[service]"))
    try:
        with listening(config) as listener:
            send(listener.port, mr_data_set("1.2.1"))
            with console.asking(listener.port, "1.2.1"):
                pass  # released at once
            wait_for(lambda: console.reports)
            assert console.references("ReferencedSOPSequence") == ["1.2.1"]
    finally:
        server.shutdown()


def test_a_console_that_cannot_be_told_is_an_alarm(tmp_path):
    with listening(write_room(tmp_path)) as listener:
        with Console().asking(listener.port, "1.2.1"):
            pass
        with CaseRecord(tmp_path / "case") as record:
            wait_for(lambda: "commitment_unreported" in alarms(record))


@pytest.mark.parametrize("place", ["console", "console:", ":104", "console:99999"])
def test_an_address_that_is_none_is_a_configuration_error(place):
    with pytest.raises(ValidationError, match="is not host:port"):
        ListenerConfig(commitment_reports_to={"CONSOLE": place})


def test_a_file_that_could_not_be_read_once_is_looked_at_again(tmp_path):
    room, elsewhere = Inbox(tmp_path / "room"), Inbox(tmp_path / "elsewhere")
    kept = kept_in(room.folder)
    path = stored(elsewhere, "1.2.1")
    there = room.folder / path.name
    there.mkdir()  # whatever opens it gets an OSError
    assert kept.problem(MR_IMAGE, "1.2.1") == 0x0112
    there.rmdir()
    path.rename(there)
    assert kept.problem(MR_IMAGE, "1.2.1") is None
