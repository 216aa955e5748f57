"""replay, export and report of a case that was really recorded (offline room, real DICOM files)."""

import hashlib
import json
import shutil
import sqlite3
import subprocess
import sys
import zipfile
from pathlib import Path

import pydicom
import pytest
from offline_arguments import approach_arguments, beside, calibration_arguments

from case_record.record import FILE_NAME, CaseRecord
from case_record.seal_triggers import prepare
from case_record.sql import MIGRATIONS
from service.cli.replay import replay_measurements
from service.procedure.observe import ProcedureFailedError
from service.procedure.registry import (
    APPROACH,
    CALIBRATION,
)
from service.procedure.registry import (
    approach_arguments as approach_json,
)
from service.procedure.registry import (
    calibration_arguments as calibration_json,
)
from service.procedure.steps import Acquire
from service.room.validity import Now, why_not_now
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from sr_engine.reconstruction.shiftset import named
from studies.offline_room import MrImaging
from studies.recorded_room import RecordedRoom

AUTOSPINE = Path(sys.executable).parent / "autospine"


def autospine(*words):
    return subprocess.run([AUTOSPINE, *words], capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A calibration with commanded shifts, an approach that is READY, one out of reach."""
    folder = tmp_path_factory.mktemp("cases") / "phantom"
    with CaseRecord(folder, create=True) as record:
        room = RecordedRoom(record, MrImaging(VirtualRoom()), StageParameters(), 2)
        shifts = named("quarter").shifts_px
        calibration = room.run_recorded(
            CALIBRATION, calibration_json(calibration_arguments(shifts_px=shifts))
        )
        target = beside(calibration, 2.0, -3.0)
        patient = [float(target[1]), 58.0, -float(target[0])]
        record.append_event("target_set", {"patient_mm": patient}, source="test", who="operator")
        arguments = approach_arguments(target, confirm_moves=False)
        arrival = room.run_recorded(APPROACH, approach_json(arguments, calibration))
        record.append_event("puncture", {"procedure_id": 2}, source="test", who="<b>operator</b>")
        away = approach_arguments(beside(calibration, 60.0, 0.0), confirm_moves=False)
        with pytest.raises(ProcedureFailedError):
            room.run_recorded(APPROACH, approach_json(away, arrival.calibration))
    return folder


def test_replay_takes_the_recorded_steps_and_measures_the_same_to_the_last_bit(case):
    ended = autospine("replay", case, "--json")
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    assert [row["name"] for row in found["procedures"]] == [CALIBRATION, APPROACH, APPROACH]
    assert all(row["agrees"] for row in found["procedures"])
    assert len(found["measurements"]) >= 6
    assert all(row["difference_mm"] == 0.0 for row in found["measurements"])


def test_replay_with_another_method_says_what_it_would_have_said(case):
    found = json.loads(autospine("replay", case, "--method", "sr", "--json").stdout)
    rows = [row for row in found["measurements"] if row["replayed_mm"]]
    assert rows
    assert all(row["method"] == "sr" for row in rows)
    assert 0.0 < max(row["difference_mm"] for row in rows) < 0.7
    sets = [row for row in rows if row["frames"] == 4]
    assert sets
    single = [row for row in found["measurements"] if row["frames"] == 1]
    assert all(row["reason"] or row["difference_mm"] is not None for row in single)


def test_replay_changes_nothing(case):
    with CaseRecord(case) as record:
        before = (record.last_event_id(), len(record.measurements()), len(record.holds()))
    autospine("replay", case)
    with CaseRecord(case) as record:
        after = (record.last_event_id(), len(record.measurements()), len(record.holds()))
    assert after == before


def test_a_procedure_that_would_now_take_other_steps_is_told(case, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(case, copy)
    db = sqlite3.connect(copy / FILE_NAME)
    prepare(db)  # as by a program that seals what it writes
    body = json.loads(
        db.execute("SELECT body FROM step WHERE procedure_id = 2 AND kind = 'MoveTo'").fetchone()[0]
    )
    body["setpoints_um"]["xt"] += 500
    db.execute(
        "UPDATE step SET body = ? WHERE procedure_id = 2 AND kind = 'MoveTo'", (json.dumps(body),)
    )
    db.commit()
    db.close()
    ended = autospine("replay", copy, "--json")
    assert ended.returncode == 3
    assert not json.loads(ended.stdout)["procedures"][1]["agrees"]


def test_export_holds_every_file_as_received_and_every_row(case, tmp_path):
    target = tmp_path / "case.zip"
    assert autospine("export", case, "--out", target).returncode == 0
    with zipfile.ZipFile(target) as archive, CaseRecord(case) as record:
        manifest = json.loads(archive.read("MANIFEST.json"))
        for name, digest in manifest["sha256"].items():
            assert hashlib.sha256(archive.read(name)).hexdigest() == digest
        assert set(manifest["sha256"]) == set(archive.namelist()) - {"MANIFEST.json"}
        assert manifest["missing"] == []
        rows = [json.loads(line) for line in archive.read("slices.jsonl").splitlines()]
        assert [row["sha256"] for row in rows] == [row.sha256 for row in record.slices()]
        for row in rows:
            content = archive.read("dicom/" + Path(row["path"]).name)
            assert hashlib.sha256(content).hexdigest() == row["sha256"]
        events = [json.loads(line) for line in archive.read("events.jsonl").splitlines()]
        assert len(events) == record.last_event_id()
        assert "images/measurement-5.png" in archive.namelist()
        archive.extract("dicom/0001.dcm", tmp_path)
    assert pydicom.dcmread(tmp_path / "dicom" / "0001.dcm").Rows == 128


def test_export_does_not_overwrite_unless_told(case, tmp_path):
    target = tmp_path / "case.zip"
    target.write_text("something dear")
    ended = autospine("export", case, "--out", target)
    assert (ended.returncode, target.read_text()) == (2, "something dear")
    assert "--force" in ended.stderr
    assert autospine("export", case, "--out", target, "--force").returncode == 0
    assert zipfile.is_zipfile(target)


def test_export_says_which_file_is_gone(case, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(case, copy)
    (copy / "inbox" / "0002.dcm").unlink()
    target = tmp_path / "case.zip"
    assert autospine("export", copy, "--out", target).returncode == 0
    with zipfile.ZipFile(target) as archive:
        assert json.loads(archive.read("MANIFEST.json"))["missing"] == ["inbox/0002.dcm"]


def test_report_is_one_page_that_loads_nothing_and_escapes_what_people_wrote(case, tmp_path):
    target = tmp_path / "report.html"
    assert autospine("report", case, "--out", target).returncode == 0
    page = target.read_text(encoding="utf-8")
    for heading in ("Approaches", "Calibrations", "Distance to the target", "Measurements"):
        assert f"<h2>{heading}</h2>" in page
    assert page.count("data:image/png;base64,") >= 2
    assert "http://" not in page
    assert "https://" not in page
    assert "<b>operator</b>" not in page
    assert "outside its travel" in page


@pytest.mark.parametrize("command", ["replay", "export", "report"])
def test_a_folder_without_a_case_or_from_a_newer_version_is_refused_in_one_line(
    command, tmp_path, case
):
    ended = autospine(command, tmp_path)
    assert ended.returncode == 2
    assert "no case record" in ended.stderr
    newer = tmp_path / "newer"
    shutil.copytree(case, newer)
    db = sqlite3.connect(newer / FILE_NAME)
    db.execute("PRAGMA user_version = 99")
    db.close()
    ended = autospine(command, newer)
    assert ended.returncode == 2
    assert "schema version 99, newer than" in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1


@pytest.fixture(scope="module")
def older(case, tmp_path_factory):
    """The case as the program of version 1 would have left it: its tables, its columns."""
    folder = tmp_path_factory.mktemp("older") / "case"
    shutil.copytree(case, folder)
    (folder / FILE_NAME).unlink()
    old = sqlite3.connect(folder / FILE_NAME)
    old.executescript(MIGRATIONS[0])
    old.execute("ATTACH ? AS new", (str(case / FILE_NAME),))
    tables = [
        row[0] for row in old.execute("SELECT name FROM main.sqlite_master WHERE type='table'")
    ]
    for table in tables:
        columns = ", ".join(row[1] for row in old.execute(f'PRAGMA main.table_info("{table}")'))
        old.execute(f'INSERT INTO main."{table}" ({columns}) SELECT {columns} FROM new."{table}"')
    old.execute("PRAGMA user_version = 1")
    old.commit()
    old.close()
    return folder


@pytest.mark.parametrize("command", ["report", "export"])
def test_a_record_of_version_1_is_read_and_stays_as_it_was(older, command, tmp_path):
    before = {path: path.read_bytes() for path in older.rglob("*") if path.is_file()}
    ended = autospine(command, older, "--out", tmp_path / "out")
    assert (ended.returncode, ended.stderr) == (0, "")
    with CaseRecord(older, read_only=True) as record:
        assert record.was_older
        record.verify()
        assert record.measurements()
        assert record.last_event("case_started").seq
        # nothing that was measured then is true now
        last = record.last_measurement("done")
        assert why_not_now(record, last, Now(None, 300.0)).code in ("unknown", "no_link")
    assert {path: path.read_bytes() for path in older.rglob("*") if path.is_file()} == before


def test_replay_refuses_a_method_that_does_not_exist(case):
    ended = autospine("replay", case, "--method", "magic")
    assert (ended.returncode, ended.stderr.strip()) == (
        2,
        "autospine: unknown method 'magic'; known: ml, base, bicubic, sr",
    )


def test_a_measurement_is_replayed_from_the_slices_that_were_there_then(tmp_path):
    """More slices of the same hold came later: they are not in the measurement."""
    with CaseRecord(tmp_path, create=True) as record:
        room = RecordedRoom(record, MrImaging(VirtualRoom()), StageParameters(), 6)
        room.run_recorded(CALIBRATION, calibration_json(calibration_arguments()))
        room.execute(Acquire(4))
        again = list(replay_measurements(record, None))
    assert [row.frames for row in again] == [1, 1, 1, 1]
    assert all(row.difference_mm == 0.0 for row in again)
