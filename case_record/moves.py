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
                "INSERT INTO move VALUES (?, ?, ?, ?, 'SENT', '', '', '{}', ?, NULL)"
                " ON CONFLICT DO NOTHING",
                (command_id, measurement_id, purpose, json_text(setpoints_um), time.time()),
            )
        return self.move(command_id)

    def end_move(
        self, command_id: str, state: str, code: str, text: str, readback_um: Mapping[str, int]
    ) -> None:
        self._db.execute(
            "UPDATE move SET state = ?, code = ?, text = ?, readback_um = ?, ended_s = ?"
            " WHERE command_id = ?",
            (state, code, text, json_text(readback_um), time.time(), command_id),
        )

    def move(self, command_id: str) -> Move:
        row = self._db.execute("SELECT * FROM move WHERE command_id = ?", (command_id,)).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: there is no move {command_id}")
        return _move(row)

    def has_move(self, command_id: str) -> bool:
        """True once the move was recorded, that is: it may have gone onto the line."""
        row = self._db.execute("SELECT 1 FROM move WHERE command_id = ?", (command_id,)).fetchone()
        return row is not None

    def moves(self) -> list[Move]:
        return [_move(row) for row in self._db.execute("SELECT * FROM move ORDER BY rowid")]


def _move(row: sqlite3.Row) -> Move:
    return Move(**decoded(row, "setpoints_um", "readback_um"))
