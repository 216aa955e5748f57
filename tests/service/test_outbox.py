"""The outbox: what is to be sent gets to every destination, whatever happens on the way."""

from __future__ import annotations

import os
import signal
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pydicom
import pytest
import trustme
from lone_service import running_service
from pydicom.dataset import Dataset
from pynetdicom.sop_class import MRImageStorage
from receivers import (
    ARCHIVE,
    OutboxProcess,
    Receiver,
    free_port,
    held_back,
    needs_program,
    receiving,
    room,
    running_outbox,
    storescp,
    wait_until,
)
from recorded_case import add_measurement, come_to_ready, make_case, puncture

from case_record.record import CaseRecord
from room_config.load import ConfigError, load_config
from service.dicom_out.make import FOLDER, make_output, outputs_to_send
from service.dicom_out.outbox_store import OutboxStore
from service.dicom_out.outbox_watch import OutboxWatch

DESTINATION = """
[[outputs.destination]]
name = "archive"
host = "127.0.0.1"
port = {port}
ae_title = "ARCHIVE"
"""


@pytest.fixture
def case_dir(tmp_path: Path) -> Path:
    """A reconstruction, then one more with READY and puncture: five outputs."""
    case_dir = make_case(tmp_path)
    with CaseRecord(case_dir) as record:
        puncture(record, come_to_ready(record))
    return case_dir


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "outbox.log"


@pytest.fixture
def archive() -> Iterator[Receiver]:
    with receiving() as receiver:
        yield receiver


def names(case_dir: Path) -> list[str]:
    with CaseRecord(case_dir) as record:
        return [output.name for output in outputs_to_send(record)]


def states(case_dir: Path, destination: str = "archive") -> dict[str, str]:
    """State of every output on its way to the destination."""
    with OutboxStore(case_dir) as store:
        return {d.name: d.state for d in store.deliveries(1000) if d.destination == destination}


def wait_until_sent(case_dir: Path, destination: str = "archive") -> None:
    expected = dict.fromkeys(names(case_dir), "sent")
    wait_until(lambda: states(case_dir, destination) == expected)


def written(case_dir: Path) -> dict[str, bytes]:
    """The data set of each output on disk as it is to be sent, by SOP Instance UID."""
    found = {}
    for path in (case_dir / FOLDER).glob("*.dcm"):
        dataset = pydicom.dcmread(path)
        found[str(dataset.SOPInstanceUID)] = path.read_bytes()[_start_of_data_set(path) :]
    return found


def _start_of_data_set(path: Path) -> int:
    with path.open("rb") as file:
        pydicom.dcmread(file, stop_before_pixels=True, specific_tags=[])
        file.seek(140)  # preamble, DICM, and the head of FileMetaInformationGroupLength
        return 144 + int.from_bytes(file.read(4), "little")


# What arrives


def test_every_output_arrives_as_it_lies_on_disk(case_dir, archive):
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until_sent(case_dir)
    assert dict(archive.received) == written(case_dir)
    assert len(archive.received) == 5, "each once"
    with CaseRecord(case_dir) as record:
        sent = [event.body["sop_instance_uid"] for event in record.events_of_kind("output_sent")]
        record.verify_events()
    assert sent == archive.uids


@needs_program("storescp")
@needs_program("dcmdump")
def test_what_the_service_sends_is_stored_by_dcmtk_and_read_by_it(case_dir, tmp_path):
    stored = tmp_path / "archive"
    with storescp(stored) as port, running_service(tmp_path, DESTINATION.format(port=port)):
        wait_until_sent(case_dir)
    files = list(stored.iterdir())
    assert {pydicom.dcmread(p).SOPInstanceUID for p in files} == set(written(case_dir))
    for path in files:
        read = subprocess.run(["dcmdump", path], capture_output=True, text=True, check=True)
        assert "E:" not in read.stderr, read.stderr


def test_a_destination_gets_the_kinds_that_it_is_to_get(case_dir, archive):
    wanted = {"name": "archive", "port": archive.port, "kinds": ["report"]}
    with running_outbox(room(case_dir, wanted)):
        wait_until(lambda: len(archive.received) == 2)
        wait_until(lambda: list(states(case_dir).values()) == ["sent", "sent"])
    assert {name.rsplit("-", 1)[1] for name in states(case_dir)} == {"report"}


def test_what_is_measured_later_is_sent_too(tmp_path, archive):
    case_dir = make_case(tmp_path)
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until_sent(case_dir)
        with CaseRecord(case_dir) as record:
            add_measurement(record)
            wait_until_sent(case_dir)
            puncture(record, come_to_ready(record))
        wait_until_sent(case_dir)
    assert len(archive.received) == 6


def test_a_receiver_that_takes_implicit_little_endian_only_gets_the_same_content(case_dir):
    with receiving(implicit_only=True) as archive:
        with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
            wait_until_sent(case_dir)
        assert set(archive.uids) == set(written(case_dir))


# What happens on the way


def test_killed_in_the_middle_of_sending_it_delivers_everything_after_a_restart(
    case_dir, archive, log
):
    config = room(case_dir, {"name": "archive", "port": archive.port})
    with held_back(archive):
        outbox = OutboxProcess(config, log)
        wait_until(lambda: archive.received)
        outbox.kill()
    on_disk = written(case_dir)
    with running_outbox(config):
        wait_until_sent(case_dir)
    assert on_disk.items() <= written(case_dir).items(), "nothing was made anew"
    assert dict(archive.received) == written(case_dir)
    assert len(archive.received) == 6, "the one under way was sent again, as it was"
    assert archive.received[0] in archive.received[1:]


def test_killed_again_and_again_it_loses_and_changes_nothing(case_dir, archive, log):
    config = room(case_dir, {"name": "archive", "port": archive.port})
    archive.answer = lambda number: time.sleep(0.05) or 0x0000
    for count in range(1, 5):
        outbox = OutboxProcess(config, log)
        wait_until(lambda count=count: len(archive.received) >= count)
        outbox.kill()
    with running_outbox(config):
        wait_until_sent(case_dir)
    assert set(archive.received) == set(written(case_dir).items()), "the same bytes every time"


def test_a_dead_destination_does_not_hold_up_another_one(case_dir, archive):
    dead = {"name": "dead", "port": free_port()}
    config = room(case_dir, dead, {"name": "archive", "port": archive.port})
    with running_outbox(config):
        wait_until_sent(case_dir)
        assert set(states(case_dir, "dead").values()) == {"waiting"}
        with OutboxStore(case_dir) as store:
            wait_until(lambda: "dead" in store.lines())
            line = store.lines()["dead"]
        assert line.failing_since_s is not None
        assert "no response" in line.reason


def test_a_destination_that_keeps_silent_does_not_hold_up_another_one(case_dir, archive):
    with receiving() as silent, held_back(silent):
        config = room(
            case_dir,
            {"name": "silent", "port": silent.port},
            {"name": "archive", "port": archive.port},
        )
        with running_outbox(config):
            wait_until(lambda: silent.received)
            wait_until_sent(case_dir)
        assert len(set(archive.uids)) == len(states(case_dir))


def test_what_fails_in_the_watch_ends_neither_it_nor_the_outbox(case_dir, archive, monkeypatch):
    """An error in the watch's own work is one look's, and an outbox that is killed comes again."""
    look, failed = OutboxWatch._look, []

    def fails_at_first(watch):
        if len(failed) < 2:
            failed.append(watch)
            raise TypeError("injected")
        look(watch)

    monkeypatch.setattr(OutboxWatch, "_look", fails_at_first)
    watch = OutboxWatch(room(case_dir, {"name": "archive", "port": archive.port}))
    watch.start()
    try:
        wait_until_sent(case_dir)
        assert len(failed) == 2
        sole = case_dir / "processes" / "outbox.sole"
        first = int(sole.read_text())
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: int(sole.read_text() or first) != first)
        with CaseRecord(case_dir) as record:
            add_measurement(record)
        wait_until_sent(case_dir)
    finally:
        watch.close()


def test_an_object_at_which_the_receiver_breaks_off_holds_up_no_other(case_dir, archive):
    with CaseRecord(case_dir) as record:
        path = make_output(record, next(outputs_to_send(record)))
    archive.breaks_on = pydicom.dcmread(path).SOPInstanceUID
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until(lambda: sorted(states(case_dir).values()) == ["sent"] * 4 + ["waiting"])
        archive.breaks_on = None
        wait_until_sent(case_dir)
    assert set(states(case_dir).values()) == {"sent"}


def test_a_destination_that_comes_back_gets_everything(case_dir):
    port = free_port()
    with running_outbox(room(case_dir, {"name": "archive", "port": port})):
        with OutboxStore(case_dir) as store:
            wait_until(lambda: store.lines() and store.lines()["archive"].failing_since_s)
        with receiving(port) as archive:
            wait_until_sent(case_dir)
            assert set(archive.uids) == set(written(case_dir))
        with OutboxStore(case_dir) as store:
            line = store.lines()["archive"]
    assert (line.failing_since_s, line.reason) == (None, "")


def test_out_of_resources_is_tried_again_until_there_are_some(case_dir, archive):
    archive.answer = lambda number: 0xA700 if number < 3 else 0x0000
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until_sent(case_dir)
    assert dict(archive.received) == written(case_dir)


def test_a_duplicate_and_a_warning_are_as_good_as_stored(case_dir, archive):
    archive.answer = lambda number: 0x0111 if number % 2 else 0xB000
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until_sent(case_dir)
    assert len(archive.received) == 5


def test_a_refusal_is_kept_with_its_reason_and_holds_up_nothing_else(case_dir, archive):
    refusal = Dataset()
    refusal.Status, refusal.ErrorComment = 0xC123, "no room for needles"
    archive.answer = lambda number: refusal if number == 0 else 0x0000
    first = names(case_dir)[0]
    config = room(
        case_dir, {"name": "archive", "port": archive.port}, retry_s=100.0, longest_retry_s=1000.0
    )
    with running_outbox(config):
        wait_until(lambda: sorted(states(case_dir).values()) == ["refused", *["sent"] * 4])
    with OutboxStore(case_dir) as store:
        (refused,) = store.deliveries(10, "refused")
    assert (refused.name, refused.reason) == (first, "status 0xC123 no room for needles")
    with CaseRecord(case_dir) as record:
        (event,) = record.events_of_kind("output_refused")
    assert event.body["reason"] == refused.reason


def test_what_was_refused_is_sent_when_it_is_no_longer(case_dir, archive):
    archive.answer = lambda number: (
        0x0000 if archive.uids.count(archive.uids[number]) > 1 else 0xA900
    )
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until_sent(case_dir)
    with CaseRecord(case_dir) as record:
        assert len(record.events_of_kind("output_refused")) == 5, "said once each"


def test_a_kind_of_object_that_is_not_taken_there_is_a_refusal(case_dir):
    with receiving(sop_classes=(MRImageStorage,)) as archive:
        with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
            wait_until(lambda: sorted(states(case_dir).values()) == ["refused"] * 3 + ["sent"] * 2)
        with OutboxStore(case_dir) as store:
            reasons = {one.reason for one in store.deliveries(10, "refused")}
    assert reasons == {
        "Comprehensive 3D SR Storage is not accepted there",
        "Grayscale Softcopy Presentation State Storage is not accepted there",
    }


def test_a_wrong_ae_title_is_told_in_words(case_dir):
    with receiving(require_called_aet=True) as archive:
        wrong = {"name": "archive", "port": archive.port, "ae_title": "SOMEBODY"}
        with running_outbox(room(case_dir, wrong)), OutboxStore(case_dir) as store:
            wait_until(lambda: store.lines())
            line = store.lines()["archive"]
    assert "association rejected" in line.reason
    assert "alled AE title not recogni" in line.reason


def test_an_output_that_cannot_be_made_is_told_and_holds_up_nothing(case_dir, archive):
    with CaseRecord(case_dir) as record:
        (case_dir / record.slice(1).path).unlink()
    with running_outbox(room(case_dir, {"name": "archive", "port": archive.port})):
        wait_until(lambda: sorted(states(case_dir).values()) == ["not_made", *["sent"] * 4])
    with OutboxStore(case_dir) as store:
        (unmade,) = store.deliveries(10, "not_made")
    assert unmade.name == "measurement-1-image"
    assert "1.dcm" in unmade.reason


def test_a_destination_that_is_added_later_gets_what_was_sent_before(case_dir, archive):
    first = {"name": "archive", "port": archive.port}
    with running_outbox(room(case_dir, first)):
        wait_until_sent(case_dir)
    with receiving() as second:
        added = {"name": "second", "port": second.port}
        with running_outbox(room(case_dir, first, added)):
            wait_until_sent(case_dir, "second")
        assert set(second.uids) == set(archive.uids)
    assert len(archive.received) == 5, "who had it does not get it again"


# TLS


def test_over_tls_both_show_their_certificates(case_dir, tmp_path):
    authority = trustme.CA()
    server_side = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(server_side)
    authority.configure_trust(server_side)
    server_side.verify_mode = ssl.CERT_REQUIRED
    mine = authority.issue_cert("autospine")
    mine.cert_chain_pems[0].write_to_path(tmp_path / "certificate.pem")
    mine.private_key_pem.write_to_path(tmp_path / "key.pem")
    authority.cert_pem.write_to_path(tmp_path / "authority.pem")
    files = {f"tls_{n}": str(tmp_path / f"{n}.pem") for n in ("certificate", "key", "authority")}
    with receiving(tls=server_side) as archive:
        there = {"name": "archive", "port": archive.port}
        with running_outbox(room(case_dir, {**there, **files})):
            wait_until_sent(case_dir)
        with (
            running_outbox(room(case_dir, {**there, "name": "open"})),
            OutboxStore(case_dir) as store,
        ):
            wait_until(lambda: "open" in store.lines())
        assert len(archive.received) == 5, "without TLS nothing gets through"


# What the service shows


def test_the_service_shows_the_outbox_in_api_metrics_and_alarms(case_dir, archive, tmp_path):
    archive.answer = lambda number: 0xC000
    more = DESTINATION.format(port=archive.port) + DESTINATION.format(port=free_port()).replace(
        '"archive"', '"dead"'
    )
    outputs = "\n[outputs]\nretry_s = 0.1\nlongest_retry_s = 0.3\nalarm_after_s = 0.5\n"
    with running_service(tmp_path, outputs + more) as url:

        def asked() -> dict:
            return httpx.get(f"{url}/api/v1/outbox", params={"state": "refused"}).json()

        wait_until(lambda: len(asked()["deliveries"]) == 5)
        first, second = asked()["destinations"]
        assert (first["name"], first["counts"]["refused"]) == ("archive", 5)
        assert (second["name"], second["counts"]["waiting"]) == ("dead", 5)
        assert all("0xC000" in one["reason"] for one in asked()["deliveries"])

        def alarms() -> dict[str, str]:
            state = httpx.get(f"{url}/api/v1/state").json()
            return {alarm["code"]: alarm["text"] for alarm in state["alarms"]}

        wait_until(lambda: "no response" in alarms().get("destination_dead", ""))
        refused = "archive refused 5 of our DICOM objects"
        wait_until(lambda: alarms().get("refused_archive") == refused)
        wait_until(lambda: "no_link" in alarms())
        metrics = httpx.get(f"{url}/metrics").text
        assert 'autospine_outbox_outputs{destination="archive",state="refused"} 5.0' in metrics
        assert 'autospine_outbox_reached{destination="dead"} 0.0' in metrics
        assert 'autospine_outbox_reached{destination="archive"} 1.0' in metrics
        archive.answer = lambda number: 0x0000
        wait_until(lambda: "refused_archive" not in alarms())


def test_without_a_destination_nothing_happens(case_dir, tmp_path):
    with running_service(tmp_path) as url:
        wait_until(lambda: httpx.get(f"{url}/api/v1/state").json()["case_uid"])
        outbox = httpx.get(f"{url}/api/v1/outbox")
    assert outbox.json() == {"destinations": [], "deliveries": []}
    assert not (case_dir / FOLDER).exists()


def test_the_service_starts_an_outbox_again_that_was_killed(case_dir, tmp_path, archive):
    with running_service(tmp_path, DESTINATION.format(port=archive.port)):
        wait_until_sent(case_dir)
        sole = case_dir / "processes" / "outbox.sole"
        before = sole.read_text()
        subprocess.run(["kill", "-9", before.strip()], check=True)
        wait_until(lambda: sole.read_text() not in ("", before))
        with CaseRecord(case_dir) as record:
            add_measurement(record)
        wait_until_sent(case_dir)


def test_the_outbox_ends_with_the_service(case_dir, archive, log):
    outbox = OutboxProcess(room(case_dir, {"name": "archive", "port": archive.port}), log)
    wait_until_sent(case_dir)
    assert outbox.end() == 0


# The API


@pytest.mark.parametrize(
    ("path", "sop_class"),
    [
        ("measurements/1/image.dcm", "1.2.840.10008.5.1.4.1.1.4"),
        ("measurements/2/report.dcm", "1.2.840.10008.5.1.4.1.1.88.34"),
        ("approaches/1/presentation.dcm", "1.2.840.10008.5.1.4.1.1.11.1"),
    ],
)
def test_outputs_are_had_from_the_api(shown: tuple[str, Path], path, sop_class):
    url, folder = shown
    answer = httpx.get(f"{url}/api/v1/{path}", timeout=200.0)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/dicom"
    file = folder / "got.dcm"
    file.write_bytes(answer.content)
    assert pydicom.dcmread(file).SOPClassUID == sop_class
    assert httpx.get(f"{url}/api/v1/{path}").content == answer.content


@pytest.mark.parametrize(
    "path",
    ["measurements/99/report.dcm", "approaches/99/report.dcm", "punctures/1/report.dcm"],
)
def test_what_there_is_nothing_about_is_not_found(shown: tuple[str, Path], path):
    answer = httpx.get(f"{shown[0]}/api/v1/{path}")
    assert (answer.status_code, answer.json()["title"]) == (404, "not_found")


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    folder = tmp_path_factory.mktemp("shown")
    with CaseRecord(make_case(folder)) as record:
        puncture(record, come_to_ready(record))
    with running_service(folder) as url:
        yield url, folder


# Its configuration


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("port = 70000", "key outputs.destination.0.port"),
        ('kinds = ["picture"]', "key outputs.destination.0.kinds.0"),
        ("aetitle = 'A'", "unknown key outputs.destination.0.aetitle"),
        ('tls_key = "key.pem"', "belong together"),
    ],
)
def test_a_wrong_destination_is_named_with_its_file(tmp_path, more, expected):
    table = '[room]\nname = "r"\ncase_dir = "case"\n[service]\nbridge_link = "/dev/null"\n'
    text = table + DESTINATION.format(port=104)
    path = tmp_path / "room.toml"
    path.write_text(text.replace("port = 104", more) if "port" in more else text + more)
    with pytest.raises(ConfigError, match=expected):
        load_config(path, {})


def test_paths_of_a_destination_are_relative_to_the_file(tmp_path):
    table = '[room]\nname = "r"\ncase_dir = "case"\n[service]\nbridge_link = "/dev/null"\n'
    names = ("certificate", "key", "authority")
    tls = "".join(f'tls_{name} = "{name}.pem"\n' for name in names)
    path = tmp_path / "room.toml"
    path.write_text(table + DESTINATION.format(port=104) + tls)
    (destination,) = load_config(path, {}).outputs.destination
    assert destination.tls_key == tmp_path / "key.pem"
    assert destination.ae_title == ARCHIVE


def test_two_destinations_of_one_name_are_refused(tmp_path):
    table = '[room]\nname = "r"\ncase_dir = "case"\n[service]\nbridge_link = "/dev/null"\n'
    path = tmp_path / "room.toml"
    path.write_text(table + 2 * DESTINATION.format(port=104))
    with pytest.raises(ConfigError, match="two destinations have the same name"):
        load_config(path, {})
