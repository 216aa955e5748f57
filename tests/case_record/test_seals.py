"""What the record swears to: whoever changes it from outside is found out, whatever he changes."""

import random
import shutil
import sqlite3
from pathlib import Path

import pytest
from test_record import a_slice, begin_hold

from case_record.record import FILE_NAME, CaseRecord, CaseRecordError
from case_record.seal_chain import TamperedError
from case_record.seal_triggers import SEALED


@pytest.fixture(scope="module")
def case_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed record with rows in every table, made and changed."""
    folder = tmp_path_factory.mktemp("case")
    with CaseRecord(folder, create=True) as record:
        record.start_case("x", seed=0)
        for number in range(1, 31):
            record.end_open_hold(10.0 * number)
            hold = begin_hold(record, settled_at_s=10.0 * number + 1)
            row = record.add_slice(a_slice(uid=f"1.2.{number}", sha256=f"{number:064x}"))
            record.decide_slice(
                row.slice_id, state="assigned", hold_id=hold.hold_id, reason_code="", reason="",
                decided_by="listener",
            )  # fmt: skip
            measured = record.request_measurement("ml", [hold.hold_id], {"holds": []})
            record.finish_measurement(measured, {"centre_px": [1.5, number / 7]})
            procedure = record.begin_procedure("jog", {"setpoints_um": {"xt": number}})
            record.send_step(procedure, 0, "MoveTo", {"n": number})
            record.end_step(procedure, 0, {"state": "DONE"})
            name = f"c/{procedure}/0"
            record.send_move(name, setpoints_um={"xt": 1}, measurement_id=measured, purpose="x")
            record.end_move(name, "DONE", "OK", "", {"xt": 1})
            record.end_procedure(procedure, "done", {})
            record.append_event("noted", {"number": number}, source="test")
    return folder


def contents(folder: Path) -> list[tuple]:
    with CaseRecord(folder, read_only=True) as record:
        return [
            row
            for table in SEALED
            for row in map(tuple, record._db.execute(f'SELECT rowid, * FROM "{table}"'))
        ]


def is_found_out(folder: Path) -> bool:
    try:
        with CaseRecord(folder, read_only=True) as record:
            record.verify()
    except (CaseRecordError, sqlite3.Error, UnicodeDecodeError):
        return True
    return False


def flips(case_dir: Path, tmp_path: Path, count: int) -> tuple[int, int]:
    """(bits whose flip changes what is read, those of them that are not found out)"""
    whole, wanted = (case_dir / FILE_NAME).read_bytes(), contents(case_dir)
    rng, changed, silent = random.Random(count), 0, 0
    for _ in range(count):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        (tmp_path / FILE_NAME).write_bytes(damaged)
        try:
            differs = contents(tmp_path) != wanted
        except (CaseRecordError, sqlite3.Error, UnicodeDecodeError, OverflowError):
            differs = True
        changed += differs
        silent += differs and not is_found_out(tmp_path)
    return changed, silent


def test_no_flipped_bit_changes_data_silently(case_dir, tmp_path):
    changed, silent = flips(case_dir, tmp_path, 300)
    assert changed > 50
    assert silent == 0


@pytest.mark.soak
def test_no_flipped_bit_of_many_changes_data_silently(case_dir, tmp_path):
    changed, silent = flips(case_dir, tmp_path, 5000)
    assert changed > 500
    assert silent == 0


def test_the_whole_record_verifies_and_its_head_grows_with_it(case_dir, tmp_path):
    shutil.copy(case_dir / FILE_NAME, tmp_path)
    with CaseRecord(tmp_path) as record:
        before = record.verify()
        assert before.events == 31
        assert before.head == record.head()
        record.append_event("noted", {}, source="test")
        after = record.verify()
    assert after.seals == before.seals + 1
    assert after.head != before.head


@pytest.mark.parametrize(
    ("statement", "where"),
    [
        ("UPDATE slice SET hold_id = 2 WHERE slice_id = 7", "slice 7"),
        ("UPDATE hold SET readback_um = '{}' WHERE hold_id = 3", "hold 3"),
        ("UPDATE event SET seq = seq + 1 WHERE event_id = 9", "event 9"),
        ("UPDATE measurement SET result = '{}' WHERE measurement_id = 5", "measurement 5"),
        ("DELETE FROM move WHERE rowid = 4", "move 4"),
        ("INSERT INTO event SELECT 99, 0, 0, '', '', 'needle_out', '{}', '', 'h', 9", "event 99"),
        ("DELETE FROM seal WHERE seal_id = 20", "seal 20"),
        ("DELETE FROM seal WHERE seal_id > 200", "was changed"),
        ("UPDATE sequence SET last = 3", "order"),
    ],
)
def test_what_another_program_changes_is_named(case_dir, tmp_path, statement, where):
    """It has to take the triggers away first: they call functions that it does not have."""
    shutil.copy(case_dir / FILE_NAME, tmp_path)
    db = sqlite3.connect(tmp_path / FILE_NAME)
    for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
        db.execute(f"DROP TRIGGER {name}")
    db.execute(statement)
    db.commit()
    db.close()
    with CaseRecord(tmp_path) as record, pytest.raises(TamperedError, match=where):
        record.verify()


def test_rows_that_a_decision_rests_on_are_checked_alone(case_dir, tmp_path):
    shutil.copy(case_dir / FILE_NAME, tmp_path)
    with CaseRecord(tmp_path) as record:
        record.verify_rows([("slice", 1), ("measurement", 2), ("hold", 3)])
        record._db.execute("DROP TRIGGER hold_updated")
        record._db.execute("UPDATE hold SET shift_px = '[0, 0]' WHERE hold_id = 3")
        with pytest.raises(TamperedError, match="hold 3"):
            record.verify_rows([("hold", 3)])
        with pytest.raises(TamperedError, match="hold 77"):
            record.verify_rows([("hold", 77)])
