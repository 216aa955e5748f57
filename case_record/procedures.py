"""The procedures of a case and their steps: what a restart replays."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping
from typing import Any

from case_record.connection import CaseRecordError, Connection, decoded, json_text
from case_record.rows import Procedure, Step


class Procedures(Connection):
    """At most one procedure runs."""

    def begin_procedure(self, name: str, arguments: Mapping[str, Any]) -> int:
        with self.transaction():
            cursor = self._db.execute(
                "INSERT INTO procedure (name, arguments, state, started_s, begun_seq)"
                " VALUES (?, ?, 'running', ?, ?)",
                (name, json_text(arguments), time.time(), self._next_seq()),
            )
        return int(cursor.lastrowid or 0)

    def end_procedure(self, procedure_id: int, state: str, result: Mapping[str, Any]) -> None:
        with self.transaction():
            self._db.execute(
                "UPDATE procedure SET state = ?, result = ?, ended_s = ?, ended_seq = ?"
                " WHERE procedure_id = ?",
                (state, json_text(result), time.time(), self._next_seq(), procedure_id),
            )

    def procedure(self, procedure_id: int) -> Procedure:
        row = self._db.execute(
            "SELECT * FROM procedure WHERE procedure_id = ?", (procedure_id,)
        ).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: no procedure {procedure_id}")
        return _procedure(row)

    def running_procedure(self) -> Procedure | None:
        row = self._db.execute("SELECT * FROM procedure WHERE state = 'running'").fetchone()
        return _procedure(row) if row else None

    def last_procedure(self, name: str, state: str) -> Procedure | None:
        row = self._db.execute(
            "SELECT * FROM procedure WHERE name = ? AND state = ?"
            " ORDER BY procedure_id DESC LIMIT 1",
            (name, state),
        ).fetchone()
        return _procedure(row) if row else None

    def last_ended_procedure(self) -> Procedure | None:
        row = self._db.execute(
            "SELECT * FROM procedure WHERE state != 'running' ORDER BY procedure_id DESC LIMIT 1"
        ).fetchone()
        return _procedure(row) if row else None

    def procedures(self) -> list[Procedure]:
        rows = self._db.execute("SELECT * FROM procedure ORDER BY procedure_id")
        return [_procedure(row) for row in rows]

    def send_step(self, procedure_id: int, number: int, kind: str, body: Mapping[str, Any]) -> Step:
        """Record that a step is about to be carried out, unless it already was recorded as sent."""
        with self.transaction():
            self._db.execute(
                "INSERT INTO step (procedure_id, number, kind, body, sent_s)"
                " VALUES (?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
                (procedure_id, number, kind, json_text(body), time.time()),
            )
            row = self._db.execute(
                "SELECT * FROM step WHERE procedure_id = ? AND number = ?", (procedure_id, number)
            ).fetchone()
        return _step(row)

    def end_step(self, procedure_id: int, number: int, outcome: Mapping[str, Any]) -> None:
        self._db.execute(
            "UPDATE step SET outcome = ?, ended_s = ? WHERE procedure_id = ? AND number = ?",
            (json_text(outcome), time.time(), procedure_id, number),
        )

    def steps(self, procedure_id: int) -> list[Step]:
        rows = self._db.execute(
            "SELECT * FROM step WHERE procedure_id = ? ORDER BY number", (procedure_id,)
        )
        return [_step(row) for row in rows]


def _procedure(row: sqlite3.Row) -> Procedure:
    return Procedure(**decoded(row, "arguments", "result"))


def _step(row: sqlite3.Row) -> Step:
    return Step(**decoded(row, "body", "outcome"))
