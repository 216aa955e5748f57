"""The events of a case: append-only, each carrying the hash of the one before it."""

from __future__ import annotations

import hashlib
import sqlite3
import time
from collections.abc import Mapping
from typing import Any

from case_record.connection import CaseRecordError, Connection, decoded, json_text
from case_record.rows import Event

_FIRST_HASH = "0" * 64


class Events(Connection):
    """What happened, who did it, by both clocks."""

    def append_event(
        self, kind: str, body: Mapping[str, Any], *, source: str, who: str = "-"
    ) -> int:
        text = json_text(body)
        wall_s, monotonic_s = time.time(), time.monotonic()
        with self.transaction():
            last = self._db.execute(
                "SELECT hash FROM event ORDER BY event_id DESC LIMIT 1"
            ).fetchone()
            previous = last["hash"] if last else _FIRST_HASH
            digest = _event_hash(previous, wall_s, monotonic_s, source, who, kind, text)
            cursor = self._db.execute(
                "INSERT INTO event (wall_s, monotonic_s, source, who, kind, body, previous_hash,"
                " hash, seq) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    wall_s,
                    monotonic_s,
                    source,
                    who,
                    kind,
                    text,
                    previous,
                    digest,
                    self._next_seq(),
                ),
            )
        return int(cursor.lastrowid or 0)

    def events(self, after_id: int = 0, limit: int = 1000) -> list[Event]:
        rows = self._db.execute(
            "SELECT * FROM event WHERE event_id > ? ORDER BY event_id LIMIT ?", (after_id, limit)
        )
        return [_event(row) for row in rows]

    def newest_events(self, limit: int, before_id: int | None = None) -> list[Event]:
        """Return the newest events (before one of them), newest first."""
        rows = self._db.execute(
            "SELECT * FROM event WHERE event_id < ? ORDER BY event_id DESC LIMIT ?",
            (before_id if before_id is not None else 2**62, limit),
        )
        return [_event(row) for row in rows]

    def events_of_kind(self, kind: str, after_id: int = 0, after_seq: int = 0) -> list[Event]:
        """Return all events of a kind, oldest first, after one of them or after a `seq`."""
        rows = self._db.execute(
            "SELECT * FROM event WHERE kind = ? AND event_id > ? AND seq > ? ORDER BY event_id",
            (kind, after_id, after_seq),
        )
        return [_event(row) for row in rows]

    def last_event(self, kind: str) -> Event | None:
        """Return the newest event of a kind."""
        row = self._db.execute(
            "SELECT * FROM event WHERE kind = ? ORDER BY event_id DESC LIMIT 1", (kind,)
        ).fetchone()
        return _event(row) if row else None

    def last_event_id(self) -> int:
        return int(self._db.execute("SELECT COALESCE(MAX(event_id), 0) FROM event").fetchone()[0])

    def verify_events(self) -> int:
        """Return the number of events; CaseRecordError names the first that was tampered with."""
        previous, number = _FIRST_HASH, 0
        for row in self._db.execute("SELECT * FROM event ORDER BY event_id"):
            number += 1
            fields = (row[k] for k in ("wall_s", "monotonic_s", "source", "who", "kind", "body"))
            digest = _event_hash(previous, *fields)
            if row["previous_hash"] != previous or row["hash"] != digest:
                raise CaseRecordError(
                    f"{self.case_dir}: the event chain is broken at event {row['event_id']}"
                )
            previous = digest
        return number


def _event_hash(previous: str, *fields: Any) -> str:
    return hashlib.sha256(json_text([previous, *fields]).encode()).hexdigest()


def _event(row: sqlite3.Row) -> Event:
    return Event(**decoded(row, "body"))
