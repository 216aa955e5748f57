"""The measurements of a case: asked for by the service, answered by the worker."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping, Sequence
from typing import Any

from case_record.connection import CaseRecordError, Connection, decoded, json_text
from case_record.rows import Measurement


class Measurements(Connection):
    """Requested, then done or failed, once."""

    def request_measurement(
        self, method: str, hold_ids: Sequence[int], request: Mapping[str, Any]
    ) -> int:
        with self.transaction():
            cursor = self._db.execute(
                "INSERT INTO measurement (state, method, hold_ids, request, requested_s,"
                " requested_seq) VALUES ('requested', ?, ?, ?, ?, ?)",
                (
                    method,
                    json_text(list(hold_ids)),
                    json_text(request),
                    time.time(),
                    self._next_seq(),
                ),
            )
        return int(cursor.lastrowid or 0)

    def requested_measurements(self) -> list[Measurement]:
        rows = self._db.execute(
            "SELECT * FROM measurement WHERE state = 'requested' ORDER BY measurement_id"
        )
        return [_measurement(row) for row in rows]

    def finish_measurement(self, measurement_id: int, result: Mapping[str, Any]) -> None:
        with self.transaction():
            self._db.execute(
                "UPDATE measurement SET state = 'done', finished_s = ?, result = ?,"
                " finished_seq = ? WHERE measurement_id = ? AND state = 'requested'",
                (time.time(), json_text(result), self._next_seq(), measurement_id),
            )

    def fail_measurement(self, measurement_id: int, reason_code: str, reason: str) -> None:
        with self.transaction():
            self._db.execute(
                "UPDATE measurement SET state = 'failed', finished_s = ?, reason_code = ?,"
                " reason = ?, finished_seq = ? WHERE measurement_id = ? AND state = 'requested'",
                (time.time(), reason_code, reason, self._next_seq(), measurement_id),
            )

    def measurement(self, measurement_id: int) -> Measurement:
        row = self._db.execute(
            "SELECT * FROM measurement WHERE measurement_id = ?", (measurement_id,)
        ).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: no measurement {measurement_id}")
        return _measurement(row)

    def last_measurement(self, state: str | None = None) -> Measurement | None:
        """Return the newest measurement; without a state the newest that is not just requested."""
        row = self._db.execute(
            "SELECT * FROM measurement WHERE state = COALESCE(?, state) AND state != 'requested'"
            " ORDER BY measurement_id DESC LIMIT 1",
            (state,),
        ).fetchone()
        return _measurement(row) if row else None

    def first_measurement_since(self, seq: int) -> Measurement | None:
        """The first one that was asked for after `seq` and found something."""
        row = self._db.execute(
            "SELECT * FROM measurement WHERE requested_seq > ? AND state = 'done'"
            " ORDER BY measurement_id LIMIT 1",
            (seq,),
        ).fetchone()
        return _measurement(row) if row else None

    def measurements(self, state: str | None = None) -> list[Measurement]:
        where = "state = ?" if state else "1"
        rows = self._db.execute(
            f"SELECT * FROM measurement WHERE {where} ORDER BY measurement_id",
            (state,) if state else (),
        )
        return [_measurement(row) for row in rows]

    def count_measurements(self) -> int:
        return int(self._db.execute("SELECT COUNT(*) FROM measurement").fetchone()[0])

    def page_of_measurements(self, *, after_id: int, limit: int, newest: bool) -> list[Measurement]:
        """Return measurements in pages by id: upwards from `after_id`, or the newest ones first."""
        order = "DESC" if newest else "ASC"
        beyond = "measurement_id < ?1" if newest and after_id else "measurement_id > ?1"
        rows = self._db.execute(
            f"SELECT * FROM measurement WHERE {beyond} ORDER BY measurement_id {order} LIMIT ?2",
            (after_id, limit),
        )
        return [_measurement(row) for row in rows]


def _measurement(row: sqlite3.Row) -> Measurement:
    values = decoded(row, "hold_ids", "request", "result")
    values["hold_ids"] = tuple(values["hold_ids"])
    return Measurement(**values)
