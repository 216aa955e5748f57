"""What the record swears to: every row of every table is part of one chain of hashes.

Triggers write a seal with each row that is made or changed: the digest of the row as it is now, and
a hash that covers the seal before it. Whoever changes a row, a seal, or takes one away without this
program breaks the chain. The newest hash, the head, is said outside of the record (log, report,
export): with it also a whole forged chain, or an older copy of the file, is found out.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from case_record.connection import CaseRecordError
from case_record.events import Events
from case_record.seal_triggers import FIRST, SEALED, next_seal, row_digest

FILE_SEALED = "file_sealed"


class TamperedError(CaseRecordError):
    """The record is not as this program wrote it; the text says where."""


@dataclass(frozen=True)
class Verified:
    """How far a record was found whole. head: the newest hash, hexadecimal."""

    events: int
    seals: int
    head: str


class Seals(Events):
    """Checks of the chain. They read; nothing is mended.

    doubt: why nothing may rest on this record, as whoever opened it found; empty: nothing known.
    """

    doubt = ""

    def head(self) -> str:
        """The newest hash: write it down where this file is not."""
        row = self._db.execute("SELECT hash FROM seal ORDER BY seal_id DESC LIMIT 1").fetchone()
        return (bytes(row[0]) if row else FIRST).hex()

    def verify(self) -> Verified:
        """Everything there is. Raises TamperedError, which names the first thing that is wrong."""
        self._check_file()
        latest: dict[tuple[str, int], bytes] = {}
        number, previous = 0, None
        for seal in self._rows("SELECT tbl, row, digest, hash FROM seal ORDER BY seal_id"):
            number += 1
            table, row, digest, said = seal
            if said != next_seal(previous, table, row, digest):
                raise self._tampered(f"the chain is broken at seal {number} ({table} {row})")
            previous = said
            latest[table, row] = digest
        for table in SEALED:
            for row, *values in self._rows(f'SELECT rowid, * FROM "{table}"'):
                if latest.pop((table, row), None) != row_digest(*values):
                    raise self._tampered(f"{table} {row} was changed")
        for (table, row), digest in latest.items():
            if any(digest):
                raise self._tampered(f"{table} {row} was removed")
        events = int(self._db.execute("SELECT COUNT(*) FROM event").fetchone()[0])
        return Verified(events, number, (previous or FIRST).hex())

    def verify_rows(self, rows: Iterable[tuple[str, int]]) -> None:
        """Some rows by table and row id, quick enough for the control loop. TamperedError."""
        for table, row in rows:
            seal = self._db.execute(
                "SELECT digest FROM seal WHERE tbl = ? AND row = ? ORDER BY seal_id DESC LIMIT 1",
                (table, row),
            ).fetchone()
            found = self._db.execute(f'SELECT * FROM "{table}" WHERE rowid = ?', (row,)).fetchone()
            values = () if found is None else tuple(found)
            if seal is None or bytes(seal[0]) != row_digest(*values):
                raise self._tampered(f"{table} {row} was changed")

    def seal_file(self, name: str, content: bytes) -> None:
        """Swear to a file that is about to be written: `name`, below the case's folder."""
        body = {"name": name, "sha256": hashlib.sha256(content).hexdigest()}
        self.append_event(FILE_SEALED, body, source="outputs")

    def is_sealed(self, name: str) -> bool:
        """Whether the record swears to a file of this name. TamperedError if it is another one."""
        sealed = self.events_of_kind(FILE_SEALED)
        digests = {event.body["sha256"] for event in sealed if event.body["name"] == name}
        if not digests:
            return False
        with (self.case_dir / name).open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() not in digests:
                raise self._tampered(f"{name} is not the file that was made")
        return True

    def _check_file(self) -> None:
        """Indexes say what the tables say, and no page is damaged."""
        found = self._rows("PRAGMA integrity_check(1)")
        if found and found[0][0] != "ok":
            raise self._tampered(str(found[0][0]))
        last, highest = self._rows(
            "SELECT (SELECT last FROM sequence), MAX(COALESCE((SELECT MAX(seq) FROM event), 0),"
            " COALESCE((SELECT MAX(seq) FROM slice), 0))"
        )[0]
        if last is None or last < highest:
            raise self._tampered("the order of events does not match")

    def _rows(self, statement: str) -> list[tuple[Any, ...]]:
        try:
            cursor = self._db.cursor()
            cursor.row_factory = None  # plain tuples: there may be hundreds of thousands
            return cursor.execute(statement).fetchall()
        except sqlite3.OperationalError:
            raise
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            raise self._tampered(f"it cannot be read ({error})") from error

    def _tampered(self, what: str) -> TamperedError:
        return TamperedError(f"{self.case_dir}: the record was changed from outside: {what}")
