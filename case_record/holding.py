"""The holding area of a room: slices that came with no case open, or belong to another case.

The files are the truth; this table says of each why it waits and what it belongs to, so that
nobody has to read headers to show it. The listener alone writes it, the service looks. No patient's
name or number is kept here. Use a holding area in the thread that opened it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self

from case_record.connection import CaseRecordError

FOLDER = "holding"
FILE_NAME = "holding.sqlite"
_BUSY_TIMEOUT_S = 10.0
_SCHEMA = """
CREATE TABLE IF NOT EXISTS held (
    name               TEXT PRIMARY KEY,
    sop_instance_uid   TEXT NOT NULL,
    sha256             TEXT NOT NULL,
    received_s         REAL NOT NULL,
    code               TEXT NOT NULL,
    reason             TEXT NOT NULL,
    patient            TEXT NOT NULL,
    study              TEXT NOT NULL,
    frame_of_reference TEXT NOT NULL,
    description        TEXT NOT NULL
) STRICT;
CREATE INDEX IF NOT EXISTS held_by_study ON held (study);
CREATE INDEX IF NOT EXISTS held_by_sha256 ON held (sha256);
CREATE TABLE IF NOT EXISTS study (
    study  TEXT PRIMARY KEY,
    folder TEXT NOT NULL
) STRICT;
"""


@dataclass(frozen=True)
class Held:
    """One file that waits. patient: tells patients apart; study empty: the header is unreadable."""

    name: str
    sop_instance_uid: str
    sha256: str
    received_s: float
    code: str
    reason: str
    patient: str
    study: str
    frame_of_reference: str
    description: str


@dataclass(frozen=True)
class HeldStudy:
    """All that waits of one study."""

    study: str
    patient: str
    frame_of_reference: str
    code: str
    reason: str
    description: str
    slices: int
    first_received_s: float
    last_received_s: float


class Holding:
    """The table and the folder of the files. read_only: whoever only looks."""

    def __init__(self, home: Path, *, read_only: bool = False) -> None:
        self.folder = home / FOLDER
        path = self.folder / FILE_NAME
        try:
            if read_only:
                if not path.is_file():
                    raise CaseRecordError(f"{self.folder}: nothing was ever held here")
                where = f"{path.absolute().as_uri()}?mode=ro"
                self._db = sqlite3.connect(where, timeout=_BUSY_TIMEOUT_S, uri=True)
            else:
                self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
                self._db = sqlite3.connect(path, timeout=_BUSY_TIMEOUT_S, isolation_level=None)
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = FULL")
                self._db.executescript(_SCHEMA)
        except OSError as error:
            raise CaseRecordError(f"{self.folder}: cannot be created ({error.strerror})") from error
        except sqlite3.DatabaseError as error:
            raise CaseRecordError(f"{path}: not a usable holding area ({error})") from error
        self._db.row_factory = sqlite3.Row

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def change(self) -> tuple[int, int]:
        """Something that changes with every change of the table."""
        version = int(self._db.execute("PRAGMA data_version").fetchone()[0])
        return version, self._db.total_changes

    # What waits

    def add(self, held: Held) -> None:
        """Keep a file that lies in the folder; what was said of it before is replaced."""
        values = asdict(held)
        marks = ", ".join("?" * len(values))
        self._db.execute(
            f"INSERT OR REPLACE INTO held ({', '.join(values)}) VALUES ({marks})",
            tuple(values.values()),
        )

    def remove(self, name: str) -> None:
        self._db.execute("DELETE FROM held WHERE name = ?", (name,))

    def has(self, sha256: str, sop_instance_uid: str) -> bool:
        row = self._db.execute(
            "SELECT 1 FROM held WHERE sha256 = ? AND sop_instance_uid = ?",
            (sha256, sop_instance_uid),
        ).fetchone()
        return row is not None

    def all(self, study: str | None = None) -> list[Held]:
        """What waits (of one study), in the order in which it came."""
        rows = self._db.execute(
            "SELECT * FROM held WHERE ?1 IS NULL OR study = ?1 ORDER BY received_s, name", (study,)
        )
        return [Held(**row) for row in rows]

    def studies(self) -> list[HeldStudy]:
        """What waits, by study, the newest first; reason and frame as of its newest slice."""
        # the bare columns of a query with one MAX() are those of its row (SQLite)
        rows = self._db.execute(
            "SELECT study, patient, frame_of_reference, code, reason, description,"
            " COUNT(*) AS slices, MIN(received_s) AS first_received_s,"
            " MAX(received_s) AS last_received_s"
            " FROM held GROUP BY study ORDER BY last_received_s DESC"
        )
        names = [one.name for one in fields(HeldStudy)]
        return [HeldStudy(**{name: row[name] for name in names}) for row in rows]

    # Whose study it is

    def bind(self, study: str, folder: str) -> None:
        """The study belongs to the case in this folder."""
        self._db.execute("INSERT OR REPLACE INTO study VALUES (?, ?)", (study, folder))

    def case_of(self, study: str) -> str | None:
        """The folder's name of the case to which the study belongs, if one is known."""
        row = self._db.execute("SELECT folder FROM study WHERE study = ?", (study,)).fetchone()
        return None if row is None else str(row["folder"])

    def knows_studies(self) -> bool:
        return self._db.execute("SELECT 1 FROM study LIMIT 1").fetchone() is not None


def move_file(source: Path, target: Path) -> None:
    """Move a file that is not to be lost, also to another file system; OSError: it is where it was.

    A crash leaves it under one of the two names, or (on another file system) under both.
    """
    try:
        source.rename(target)
        return
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
    part = target.with_name(target.name + ".part")
    try:
        with source.open("rb") as old, part.open("wb") as new:
            while block := old.read(1 << 20):
                new.write(block)
            new.flush()
            os.fsync(new.fileno())
        part.rename(target)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    source.unlink()
