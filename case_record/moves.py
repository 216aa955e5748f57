"""The moves of a case, each recorded before it goes onto the line."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping

from case_record.connection import CaseRecordError, Connection, decoded, json_text
from case_record.rows import Move


class Moves(Connection):
    """By command id, which makes each of them happen at most once."""

    def send_move(
        self,
        command_id: str,
        *,
        setpoints_um: Mapping[str, int],
        measurement_id: int | None,
        purpose: str,
    ) -> Move:
        """Record a move before it goes onto the line. The same command id again changes nothing."""
        with self.transaction():
            self._db.execute(
                "INSERT INTO move (command_id, measurement_id, purpose, setpoints_um, state, code,"
                " text, readback_um, sent_s, sent_seq)"
                " VALUES (?, ?, ?, ?, 'SENT', '', '', '{}', ?, ?) ON CONFLICT DO NOTHING",
                (
                    command_id,
                    measurement_id,
                    purpose,
                    json_text(setpoints_um),
                    time.time(),
                    self._next_seq(),
                ),
            )
        return self.move(command_id)

    def end_move(
        self, command_id: str, state: str, code: str, text: str, readback_um: Mapping[str, int]
    ) -> None:
        with self.transaction():
            self._db.execute(
                "UPDATE move SET state = ?, code = ?, text = ?, readback_um = ?, ended_s = ?,"
                " ended_seq = ? WHERE command_id = ?",
                (
                    state,
                    code,
                    text,
                    json_text(readback_um),
                    time.time(),
                    self._next_seq(),
                    command_id,
                ),
            )

    def move(self, command_id: str) -> Move:
        row = self._db.execute("SELECT * FROM move WHERE command_id = ?", (command_id,)).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: no move {command_id}")
        return _move(row)

    def has_move(self, command_id: str) -> bool:
        """True once the move was recorded, that is: it may have gone onto the line."""
        row = self._db.execute("SELECT 1 FROM move WHERE command_id = ?", (command_id,)).fetchone()
        return row is not None

    def last_sent_seq(self) -> int:
        """When the last move was sent, in the order of the case; 0 if none was."""
        return int(self._db.execute("SELECT COALESCE(MAX(sent_seq), 0) FROM move").fetchone()[0])

    def moves(self) -> list[Move]:
        return [_move(row) for row in self._db.execute("SELECT * FROM move ORDER BY rowid")]


def _move(row: sqlite3.Row) -> Move:
    return Move(**decoded(row, "setpoints_um", "readback_um"))
