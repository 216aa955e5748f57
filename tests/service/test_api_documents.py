"""Report and export through the API, and the list of cases, which writes nowhere."""

import hashlib
import io
import json
import shutil
import sqlite3
import threading
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from attended_room import AttendedRoom, calibrated
from lone_service import running_service

from case_record.record import FILE_NAME, CaseRecord
from service.client import RefusedByServiceError, RoomClient

LONG_S = 300.0


@pytest.fixture(scope="module")
def beside(room: AttendedRoom, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the present case of a lone service, a case that ended, and an old record."""
    with RoomClient(room.url) as client:
        calibrated(client)
    folder = tmp_path_factory.mktemp("cases")
    copy_case(room.folder, folder / "last week")
    (folder / "old").mkdir()
    with closing(sqlite3.connect(folder / "old" / FILE_NAME)) as old:
        old.execute("PRAGMA user_version = 0")
        old.execute("CREATE TABLE something (a)")
    return folder


def copy_case(source: Path, target: Path) -> None:
    """A copy with the write-ahead log merged in, as a process that ends leaves it."""
    target.mkdir()
    with (
        closing(sqlite3.connect(source / FILE_NAME)) as live,
        closing(sqlite3.connect(target / FILE_NAME)) as copy,
    ):
        live.backup(copy)
    for part in ("inbox", "images"):
        shutil.copytree(source / part, target / part)


@pytest.fixture(scope="module")
def url(beside: Path) -> Iterator[str]:
    with running_service(beside) as address:
        yield address


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_the_list_of_cases_writes_nothing_into_their_folders(url: str, beside: Path) -> None:
    before = [contents(beside / name) for name in ("last week", "old")]
    with RoomClient(url) as client:
        cases = {case.folder: case for case in client.cases()}
    assert [contents(beside / name) for name in ("last week", "old")] == before
    assert set(cases) == {"case", "last week", "old"}, "an older schema is read through a copy"
    assert cases["case"].current
    assert cases["last week"].measurements >= 3


def test_a_record_opened_to_be_read_only_cannot_be_written(beside: Path) -> None:
    with CaseRecord(beside / "last week", read_only=True) as record:
        assert record.case() is not None
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            record.append_event("note", {}, source="test")
    before = contents(beside / "old")
    with CaseRecord(beside / "old", read_only=True) as record:
        assert record.moves() == [], "an older schema is read through a copy"
    assert contents(beside / "old") == before


def test_what_another_process_has_just_written_is_read_by_a_read_only_record(
    room: AttendedRoom, client: RoomClient
) -> None:
    calibrated(client)
    client.describe_case("seen at once")
    with CaseRecord(room.folder, read_only=True) as record:
        described = record.last_event("case_described")
        assert described is not None
        assert described.body["label"] == "seen at once"


def test_the_report_is_one_page_that_loads_nothing(room: AttendedRoom, client: RoomClient) -> None:
    calibrated(client)
    answer = httpx.get(f"{room.url}/api/v1/report", timeout=LONG_S)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/html")
    assert "sandbox" in answer.headers["content-security-policy"]
    assert "script" not in answer.headers["content-security-policy"]
    assert answer.headers["x-frame-options"] == "DENY"
    assert "Research software" in answer.text
    assert client.state().case_uid in answer.text
    for loads in ('src="http', "src='http", "<link", "<script"):
        assert loads not in answer.text


def test_the_export_holds_every_slice_bit_for_bit_and_a_manifest(
    room: AttendedRoom, client: RoomClient
) -> None:
    calibrated(client)
    with zipfile.ZipFile(io.BytesIO(client.export())) as archive:
        manifest = json.loads(archive.read("MANIFEST.json"))
        for name, digest in manifest["sha256"].items():
            assert hashlib.sha256(archive.read(name)).hexdigest() == digest
        packed = {hashlib.sha256(archive.read(n)).hexdigest() for n in dicom_names(archive)}
    with CaseRecord(room.folder, read_only=True) as record:
        files = [record.case_dir / row.path for row in record.slices(state="assigned")]
    assert files
    assert {hashlib.sha256(path.read_bytes()).hexdigest() for path in files} <= packed


def dicom_names(archive: zipfile.ZipFile) -> list[str]:
    return [name for name in archive.namelist() if name.startswith("dicom/")]


def test_a_case_beside_the_present_one_is_reported_by_the_name_of_its_folder(
    url: str, beside: Path
) -> None:
    with RoomClient(url) as client, CaseRecord(beside / "last week", read_only=True) as record:
        case = record.case()
        assert case is not None
        assert case.case_uid in client.report("last week")


@pytest.mark.parametrize("name", ["nowhere", "../cases/last week", "..", "/etc", "last week/inbox"])
@pytest.mark.parametrize("what", ["report", "export"])
def test_no_other_folder_can_be_had(url: str, what: str, name: str) -> None:
    answer = httpx.get(f"{url}/api/v1/{what}", params={"case": name})
    assert (answer.status_code, answer.json()["title"]) == (404, "not_found")
    assert answer.headers["content-type"] == "application/problem+json"


def test_who_asks_for_a_second_export_meanwhile_is_told_to_try_again(room: AttendedRoom) -> None:
    answers: list[httpx.Response] = []

    def ask() -> None:
        answers.append(httpx.get(f"{room.url}/api/v1/export", timeout=LONG_S))

    asking = [threading.Thread(target=ask) for _ in range(6)]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()
    busy = [answer for answer in answers if answer.status_code == 429]
    assert {answer.status_code for answer in answers} == {200, 429}
    assert {(a.json()["title"], a.headers["retry-after"]) for a in busy} == {("busy", "5")}


def test_a_case_that_cannot_be_read_is_a_problem_in_the_words_of_the_command(
    tmp_path: Path, room: AttendedRoom
) -> None:
    copy_case(room.folder, tmp_path / "broken")
    with closing(sqlite3.connect(tmp_path / "broken" / FILE_NAME)) as broken:
        triggers = "SELECT name FROM sqlite_master WHERE type = 'trigger'"
        for (name,) in broken.execute(triggers).fetchall():
            broken.execute(f"DROP TRIGGER {name}")
        broken.execute("UPDATE event SET who = 'Mallory' WHERE event_id = 2")
        broken.commit()
    with running_service(tmp_path) as url, RoomClient(url) as client:
        for make in (client.report, client.export):
            with pytest.raises(RefusedByServiceError, match="event 2 was changed") as told:
                make("broken")
            assert told.value.status == 409
