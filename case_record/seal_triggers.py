"""How rows are sealed: the triggers, and the two functions that they call; see `seal_chain`."""

from __future__ import annotations

import hashlib
import sqlite3
from typing import Any

SEALED = ("case", "event", "hold", "slice", "measurement", "procedure", "step", "move")
FIRST = bytes(32)


def prepare(db: sqlite3.Connection) -> None:
    """Make the functions known that the triggers call."""
    db.create_function("row_digest", -1, row_digest, deterministic=True)
    db.create_function("next_seal", 4, next_seal, deterministic=True)


def seal_everything(db: sqlite3.Connection) -> None:
    """(Re)make the triggers for the columns that there are, and seal the rows as they stand.

    Called inside the transaction of a migration: what an older program wrote is believed once.
    """
    db.execute("DELETE FROM seal")
    for table in SEALED:
        for made in ("inserted", "updated", "deleted"):
            db.execute(f"DROP TRIGGER IF EXISTS {table}_{made}")
        columns = [row[1] for row in db.execute(f'PRAGMA table_info("{table}")')]
        new = ", ".join(f"NEW.{name}" for name in columns)
        insert = (
            "INSERT INTO seal (tbl, row, digest, hash) SELECT '{t}', {row}, made, next_seal("
            "(SELECT hash FROM seal ORDER BY seal_id DESC LIMIT 1), '{t}', {row}, made)"
            " FROM (SELECT {digest} AS made)"
        )
        now = insert.format(t=table, row="NEW.rowid", digest=f"row_digest({new})")
        gone = insert.format(t=table, row="OLD.rowid", digest="zeroblob(32)")
        for made, when, what in (
            ("inserted", "INSERT", now),
            ("updated", "UPDATE", now),
            ("deleted", "DELETE", gone),
        ):
            db.execute(f'CREATE TRIGGER {table}_{made} AFTER {when} ON "{table}" BEGIN {what}; END')
    _seal_rows(db)


def _seal_rows(db: sqlite3.Connection) -> None:
    previous: bytes | None = None
    for table in SEALED:
        for row, *values in db.execute(f'SELECT rowid, * FROM "{table}" ORDER BY rowid').fetchall():
            digest = row_digest(*values)
            previous = next_seal(previous, table, row, digest)
            db.execute(
                "INSERT INTO seal (tbl, row, digest, hash) VALUES (?, ?, ?, ?)",
                (table, row, digest, previous),
            )


def row_digest(*values: Any) -> bytes:
    """SHA-256 of a row's values in the order of its columns."""
    # to the last bit of a number, and the same in every version of Python
    return hashlib.sha256(ascii(values).encode()).digest()


def next_seal(previous: bytes | None, table: str, row: int, digest: bytes) -> bytes:
    """The hash of a seal: of the one before it (None: the first), of which row, and how that is."""
    made = hashlib.sha256(previous or FIRST)
    made.update(f"{table}\0{row}\0".encode())
    made.update(digest)
    return made.digest()
