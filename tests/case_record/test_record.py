"""The case record: durable, append-only where it must be, shared by several processes."""

import multiprocessing
import sqlite3
from pathlib import Path

import pytest

from case_record.record import FILE_NAME, CaseRecord, CaseRecordError
from case_record.rows import NewSlice
from case_record.sql import SCHEMA_VERSION


def a_slice(uid: str = "1.2.3", sha256: str = "aa", **changes: object) -> NewSlice:
    values: dict = {
        "sop_instance_uid": uid,
        "frame": 0,
        "sha256": sha256,
        "path": "inbox/1.dcm",
        "state": "quarantined",
        "hold_id": None,
        "reason_code": "no_hold",
        "reason": "no hold was open",
        "received_s": 100.0,
        "received_monotonic_s": 1.0,
        "acquired_from_s": 98.0,
        "acquired_to_s": 99.0,
        "time_source": "AcquisitionDateTime",
        "header": {"rows": 3},
    }
    return NewSlice(**{**values, **changes})


def begin_hold(record: CaseRecord, settled_at_s: float = 10.0, set_id: int = 1):
    return record.begin_hold(
        set_id=set_id,
        place=0,
        setpoints_um={"xt": 1000, "yt": -5},
        readback_um={"xt": 1001, "yt": -5},
        shift_um={"xt": 0, "yt": 0},
        shift_px=(0.25, -0.25),
        settled_at_s=settled_at_s,
        expected_slices=2,
    )


@pytest.fixture
def record(tmp_path: Path):
    with CaseRecord(tmp_path / "case", create=True) as opened:
        yield opened


def test_a_missing_record_is_refused_by_name(tmp_path):
    with pytest.raises(CaseRecordError, match="nowhere"):
        CaseRecord(tmp_path / "nowhere")


def test_a_record_from_a_newer_version_is_refused_and_left_as_it_was(tmp_path):
    CaseRecord(tmp_path, create=True).close()
    with sqlite3.connect(tmp_path / FILE_NAME) as db:
        db.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    db.close()
    with pytest.raises(CaseRecordError, match="newer than"):
        CaseRecord(tmp_path)
    db = sqlite3.connect(tmp_path / FILE_NAME)
    assert db.execute("PRAGMA user_version").fetchone()[0] == SCHEMA_VERSION + 1
    db.close()


def test_a_file_that_is_no_database_is_refused_by_name(tmp_path):
    (tmp_path / FILE_NAME).write_text("this is a letter, not a case\n" * 100)
    with pytest.raises(CaseRecordError, match=FILE_NAME):
        CaseRecord(tmp_path)


def test_starting_a_case_twice_keeps_the_first(record):
    first = record.start_case("phantom", 7)
    assert record.start_case("other", 8) == first
    assert record.case() == first


def test_the_event_chain_verifies_and_shows_tampering(record):
    for number in range(5):
        record.append_event("noted", {"number": number}, source="test", who="operator")
    assert record.verify_events() == 5
    path = record.case_dir / FILE_NAME
    db = sqlite3.connect(path)
    with pytest.raises(sqlite3.OperationalError, match="no such function"):  # only we can write
        db.execute("UPDATE event SET who = 'nobody' WHERE event_id = 3")
    db.execute("DROP TRIGGER event_is_never_changed")
    db.execute("DROP TRIGGER event_updated")
    db.execute("UPDATE event SET who = 'nobody' WHERE event_id = 3")
    db.commit()
    db.close()
    with pytest.raises(CaseRecordError, match="event 3"):
        record.verify_events()


def test_there_is_at_most_one_open_hold(record):
    first = begin_hold(record)
    with pytest.raises(sqlite3.IntegrityError):
        begin_hold(record, settled_at_s=20.0)
    record.end_open_hold(15.0)
    second = begin_hold(record, settled_at_s=20.0)
    assert record.open_hold() == second
    assert record.hold(first.hold_id).ended_at_s == 15.0
    assert record.holds(since_s=16.0) == [second]
    assert record.hold(first.hold_id).shift_px == (0.25, -0.25)


def test_the_same_slice_again_is_a_no_op_and_other_bytes_are_kept_beside_it(record):
    first = record.add_slice(a_slice())
    again = record.add_slice(a_slice(path="inbox/2.dcm"))
    other = record.add_slice(a_slice(sha256="bb"))
    assert again == first
    assert other.slice_id != first.slice_id
    assert len(record.slices(sop_instance_uid="1.2.3")) == 2


def test_an_assigned_slice_without_a_hold_cannot_be_written(record):
    with pytest.raises(sqlite3.IntegrityError):
        record.add_slice(a_slice(state="assigned"))
    hold = begin_hold(record)
    assert record.add_slice(a_slice(state="assigned", hold_id=hold.hold_id)).hold_id == hold.hold_id


def test_a_measurement_is_finished_once(record):
    hold = begin_hold(record)
    number = record.request_measurement("ml", [hold.hold_id], {"shape": [3, 4]})
    assert [m.measurement_id for m in record.requested_measurements()] == [number]
    record.finish_measurement(number, {"centre_px": [1.0, 2.0]})
    record.fail_measurement(number, "late", "should change nothing")
    done = record.measurement(number)
    assert (done.state, done.result) == ("done", {"centre_px": [1.0, 2.0]})


def test_not_a_number_never_enters_the_record(record):
    with pytest.raises(ValueError, match="JSON compliant"):
        record.append_event("bad", {"value": float("nan")}, source="test")
    assert record.events() == []


def test_a_step_or_move_that_was_sent_is_found_again_not_sent_twice(record):
    procedure = record.begin_procedure("approach", {"target": 1})
    first = record.send_step(procedure, 0, "MoveTo", {"command_id": "a"})
    again = record.send_step(procedure, 0, "MoveTo", {"command_id": "b"})
    assert again == first
    sent = record.send_move("a", setpoints_um={"xt": 1}, measurement_id=None, purpose="approach")
    assert (
        record.send_move("a", setpoints_um={"xt": 9}, measurement_id=None, purpose="approach")
        == sent
    )


def test_a_second_running_procedure_is_refused(record):
    record.begin_procedure("calibration", {})
    with pytest.raises(sqlite3.IntegrityError):
        record.begin_procedure("approach", {})


def test_a_failed_transaction_leaves_nothing_behind(record):
    def fail_half_way() -> None:
        with record.transaction():
            begin_hold(record)
            record.append_event("moved", {}, source="test")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert record.holds() == []
    assert record.last_event_id() == 0


def _append_many(case_dir: Path, source: str) -> None:
    with CaseRecord(case_dir) as record:
        for number in range(50):
            record.append_event("noted", {"number": number}, source=source)


def test_three_processes_append_at_once_and_the_chain_holds(record):
    version = record.data_version()
    spawn = multiprocessing.get_context("spawn")
    writers = [spawn.Process(target=_append_many, args=(record.case_dir, name)) for name in "abc"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert record.verify_events() == 150
    assert record.data_version() != version


def test_after_a_full_disk_the_error_is_named_and_the_next_change_is_durable(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        pages = record._db.execute("PRAGMA page_count").fetchone()[0]
        record._db.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(sqlite3.OperationalError, match="full"):
            record.append_event("note", {"text": "x" * 100_000}, source="test")
        record._db.execute("PRAGMA max_page_count = 1000000")
        record.append_event("note", {"text": "after"}, source="test")
        with CaseRecord(tmp_path) as other:
            assert [event.body["text"] for event in other.events()] == ["after"]
            assert other.verify_events() == 1


def _end_with_a_step_of_no_procedure(record: CaseRecord) -> None:
    with record.transaction():
        record._db.execute("PRAGMA defer_foreign_keys = ON")
        record.send_step(4711, 0, "measure", {})


def test_where_the_commit_fails_nothing_stays_open(tmp_path):
    """A deferred foreign key is checked at the commit: it fails there, and nowhere before."""
    with CaseRecord(tmp_path, create=True) as record:
        with pytest.raises(sqlite3.IntegrityError):
            _end_with_a_step_of_no_procedure(record)
        record.append_event("note", {}, source="test")
        with CaseRecord(tmp_path) as other:
            assert [event.kind for event in other.events()] == ["note"]


def test_the_record_and_its_folder_are_for_their_owner_alone(tmp_path):
    folder = tmp_path / "case"
    with CaseRecord(folder, create=True) as record:
        record.start_case("x", seed=0)
        modes = {p.name: p.stat().st_mode & 0o777 for p in (folder, *folder.iterdir())}
    assert modes.pop("case") == 0o700
    assert FILE_NAME in modes
    assert set(modes.values()) == {0o600}
    folder.chmod(0o755)  # as an older program made it
    (folder / FILE_NAME).chmod(0o644)
    CaseRecord(folder, create=True).close()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert (folder / FILE_NAME).stat().st_mode & 0o777 == 0o600
