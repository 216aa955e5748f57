"""The journal after crashes, damage, a full disk and a second owner."""

import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from robot_bridge.daemon.journal import FILE_NAME, CommandRecord, Journal, JournalError, LatchedStop
from robot_bridge.protocol.messages import CommandState

SETPOINTS = {"xt": 1, "yt": 2}


def record(name: str) -> CommandRecord:
    return CommandRecord(name, "move", SETPOINTS, f"m-{name}", "boot:1")


def done(name: str) -> CommandRecord:
    return replace(record(name), state=CommandState.DONE, readback_um=SETPOINTS)


def filled(folder: Path) -> bytes:
    journal = Journal(folder)
    journal.begin(record("a"), 1.0)
    journal.end(done("a"), 2.0)
    journal.lock(True, "operator", 3.0)
    journal.latch_stop(LatchedStop(1, "operator_stop", True, True), "STOP", 3.5)
    refused = replace(record("b"), state=CommandState.REFUSED, code="not_armed", text="no")
    journal.refuse(refused, 4.0)
    journal.note("anything", 4.5, detail="ümläut")
    journal.begin(record("c"), 5.0)
    journal.close()
    return (folder / FILE_NAME).read_bytes()


def test_what_was_written_is_there_after_opening_again(tmp_path: Path):
    filled(tmp_path)
    journal = Journal(tmp_path)
    assert journal.commands["a"] == done("a")
    assert journal.commands["b"].state is CommandState.REFUSED
    assert [unfinished.command_id for unfinished in journal.unfinished()] == ["c"]
    assert journal.insertion_locked
    assert journal.stop == LatchedStop(1, "operator_stop", True, True)
    assert journal.measurements_used == {"m-a", "m-c"}  # a refused move rests on nothing
    journal.close()


def test_a_crash_at_any_byte_leaves_a_journal_that_knows_all_whole_lines(tmp_path: Path):
    data = filled(tmp_path / "whole")
    for size in range(len(data) + 1):
        folder = tmp_path / str(size)
        folder.mkdir()
        (folder / FILE_NAME).write_bytes(data[:size])
        journal = Journal(folder, sync=lambda descriptor: None)
        lines = data[:size].count(b"\n")
        assert ("a" in journal.commands) == (lines >= 1)
        assert journal.insertion_locked == (lines >= 3)
        journal.begin(record("next"), 9.0)  # and it goes on, on a line of its own
        journal.close()
        again = Journal(folder)
        assert "next" in again.commands
        again.close()


def test_damage_in_the_middle_is_an_error_that_names_file_and_line(tmp_path: Path):
    data = bytearray(filled(tmp_path / "whole"))
    second = data.index(b"\n") + 20
    data[second] ^= 1
    folder = tmp_path / "damaged"
    folder.mkdir()
    (folder / FILE_NAME).write_bytes(data)
    with pytest.raises(JournalError, match=r"bridge_journal\.jsonl: line 2 is damaged"):
        Journal(folder)


def test_two_bridges_cannot_share_a_journal(tmp_path: Path):
    first = Journal(tmp_path)
    with pytest.raises(JournalError, match="another bridge is using it"):
        Journal(tmp_path)
    first.close()
    Journal(tmp_path).close()


def test_a_folder_that_cannot_be_made_is_an_error_that_names_it(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="file/state"):
        Journal(tmp_path / "file" / "state")


FULL_DISK = """
import resource, sys
from pathlib import Path
sys.path.insert(0, {here!r})
from test_journal import record, done
from robot_bridge.daemon.journal import Journal, JournalError
journal = Journal(Path({folder!r}))
journal.begin(record("a"), 1.0)
size = journal.path.stat().st_size
resource.setrlimit(resource.RLIMIT_FSIZE, (size + 50, resource.RLIM_INFINITY))
for _ in range(3):
    try:
        journal.begin(record("b"), 2.0)
    except JournalError as error:
        assert "cannot be written" in str(error), error
    else:
        raise AssertionError("written beyond the limit")
assert "b" not in journal.commands
assert journal.path.stat().st_size == size, "half a line was left behind"
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
journal.begin(record("b"), 3.0)
print("ok")
"""


def test_a_full_disk_is_an_error_and_leaves_no_half_line(tmp_path: Path):
    assert resource.RLIMIT_FSIZE is not None
    code = FULL_DISK.format(here=str(Path(__file__).parent), folder=str(tmp_path))
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert ended.stdout == "ok\n", ended.stderr
    journal = Journal(tmp_path)
    assert set(journal.commands) == {"a", "b"}
    journal.close()
