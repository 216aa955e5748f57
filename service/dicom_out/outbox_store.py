"""What became of every output at every destination, on disk beside the outputs themselves.

A table of its own and not the case record's: what is tried again and again is no part of what
happened in the case, and each write into the record would make the control loop publish anew.
A commit is on disk when the method returns. Use a store in the thread that opened it.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from case_record.cases import Cases
from service.dicom_out.make import FOLDER

FILE_NAME = "outbox.sqlite"
PRESENCE = "outbox"
State = Literal["waiting", "sent", "refused", "not_made"]
STATES: tuple[State, ...] = ("waiting", "sent", "refused", "not_made")
_BUSY_TIMEOUT_S = 10.0
_CASES_LOOKED_AT = 20
_SCHEMA = """
CREATE TABLE IF NOT EXISTS output (
    output_id        INTEGER PRIMARY KEY,
    name             TEXT NOT NULL UNIQUE,
    kind             TEXT NOT NULL,
    sop_instance_uid TEXT NOT NULL,
    written_s        REAL NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS delivery (
    name        TEXT NOT NULL REFERENCES output (name),
    destination TEXT NOT NULL,
    state       TEXT NOT NULL CHECK (state IN ('waiting', 'sent', 'refused', 'not_made')),
    attempts    INTEGER NOT NULL DEFAULT 0,
    reason      TEXT NOT NULL DEFAULT '',
    changed_s   REAL NOT NULL,
    PRIMARY KEY (name, destination)
) STRICT;
CREATE TABLE IF NOT EXISTS destination (
    name            TEXT PRIMARY KEY,
    failing_since_s REAL,
    reason          TEXT NOT NULL,
    last_sent_s     REAL
) STRICT;
"""
_DELIVERIES = """
SELECT output.name, output.kind, output.sop_instance_uid, destination, state, attempts, reason,
       changed_s
FROM delivery JOIN output USING (name)
"""


@dataclass(frozen=True)
class Delivery:
    """One output on its way to one destination; `reason` says why it is not there yet."""

    name: str
    kind: str
    sop_instance_uid: str
    destination: str
    state: State
    attempts: int
    reason: str
    changed_s: float


@dataclass(frozen=True)
class DestinationLine:
    """How a destination does; failing_since_s None: it answers, or was not tried yet."""

    name: str
    failing_since_s: float | None
    reason: str
    last_sent_s: float | None


def outbox_file(case_dir: Path) -> Path:
    """Where a case keeps what became of its outputs."""
    return case_dir / FOLDER / FILE_NAME


class OutboxStore:
    def __init__(self, case_dir: Path) -> None:
        folder = case_dir / FOLDER
        folder.mkdir(exist_ok=True)
        self._db = sqlite3.connect(
            folder / FILE_NAME, timeout=_BUSY_TIMEOUT_S, isolation_level=None
        )
        self._db.row_factory = sqlite3.Row
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.executescript(_SCHEMA)

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # The maker's side

    def known(self) -> set[str]:
        """Names of the outputs that were made, or cannot be made."""
        return {row["name"] for row in self._db.execute("SELECT name FROM output")}

    def add(
        self,
        name: str,
        kind: str,
        sop_instance_uid: str,
        destinations: Sequence[str],
        problem: str = "",
    ) -> None:
        """Queue an output whose file is on disk; `problem` says why there is none, if so."""
        state, now_s = "not_made" if problem else "waiting", time.time()
        self._db.execute("BEGIN IMMEDIATE")
        self._db.execute(
            "INSERT INTO output (name, kind, sop_instance_uid, written_s) VALUES (?, ?, ?, ?)"
            " ON CONFLICT DO NOTHING",
            (name, kind, sop_instance_uid, now_s),
        )
        self._db.executemany(
            "INSERT INTO delivery (name, destination, state, reason, changed_s)"
            " VALUES (?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
            [(name, destination, state, problem, now_s) for destination in destinations],
        )
        self._db.execute("COMMIT")

    def prepare(self, kinds: Mapping[str, Sequence[str]]) -> None:
        """At the start: a destination that is new gets what others got; what could not be made is
        forgotten, so that it is tried again. kinds: of each configured destination.
        """
        self._db.execute("BEGIN IMMEDIATE")
        self._db.execute("DELETE FROM delivery WHERE state = 'not_made'")
        self._db.execute("DELETE FROM output WHERE sop_instance_uid = ''")
        for destination, wanted in kinds.items():
            self._db.execute(
                "INSERT INTO delivery (name, destination, state, changed_s)"
                " SELECT name, ?, 'waiting', ? FROM output"
                f" WHERE kind IN ({','.join('?' * len(wanted))}) ON CONFLICT DO NOTHING",
                (destination, time.time(), *wanted),
            )
        self._db.execute("COMMIT")

    # The senders' side

    def open_deliveries(self, destination: str) -> list[Delivery]:
        """What is not stored there yet, in the order in which it was made."""
        rows = self._db.execute(
            f"{_DELIVERIES} WHERE destination = ? AND state IN ('waiting', 'refused')"
            " ORDER BY output_id",
            (destination,),
        )
        return [Delivery(**row) for row in rows]

    def has_open_deliveries(self) -> bool:
        """Whether anything is not stored yet at any destination."""
        row = self._db.execute(
            "SELECT 1 FROM delivery WHERE state IN ('waiting', 'refused') LIMIT 1"
        ).fetchone()
        return row is not None

    def tried(self, name: str, destination: str, state: State, reason: str = "") -> None:
        """What came of one attempt."""
        self._db.execute(
            "UPDATE delivery SET state = ?, reason = ?, attempts = attempts + 1, changed_s = ?"
            " WHERE name = ? AND destination = ?",
            (state, reason, time.time(), name, destination),
        )

    def note_line(self, destination: str, problem: str = "") -> None:
        """Whether the destination could be reached; the first failure of a row is remembered."""
        now_s = time.time()
        since_s, sent_s = (now_s, None) if problem else (None, now_s)
        self._db.execute(
            "INSERT INTO destination VALUES (?1, ?2, ?3, ?4) ON CONFLICT (name) DO UPDATE SET"
            " failing_since_s = CASE WHEN ?2 IS NULL THEN NULL"
            "                   ELSE COALESCE(failing_since_s, ?2) END,"
            " reason = ?3, last_sent_s = COALESCE(?4, last_sent_s)",
            (destination, since_s, problem, sent_s),
        )

    # Looking at it

    def deliveries(self, limit: int, state: str | None = None) -> list[Delivery]:
        """The newest ones first."""
        rows = self._db.execute(
            f"{_DELIVERIES} WHERE state = COALESCE(?, state)"
            " ORDER BY output_id DESC, destination LIMIT ?",
            (state, limit),
        )
        return [Delivery(**row) for row in rows]

    def counts(self) -> dict[tuple[str, str], int]:
        """How many deliveries by (destination, state)."""
        rows = self._db.execute(
            "SELECT destination, state, count(*) AS n FROM delivery GROUP BY destination, state"
        )
        return {(row["destination"], row["state"]): int(row["n"]) for row in rows}

    def lines(self) -> dict[str, DestinationLine]:
        rows = self._db.execute("SELECT * FROM destination")
        return {row["name"]: DestinationLine(**row) for row in rows}


def cases_with_open_deliveries(cases: Cases) -> list[Path]:
    """The newest of the room's cases of which something is still to be sent."""
    found = []
    for folder in cases.folders()[-_CASES_LOOKED_AT:]:
        if not outbox_file(folder).is_file():
            continue
        with OutboxStore(folder) as store:
            if store.has_open_deliveries():
                found.append(folder)
    return found
