"""The holds of a case: where the robot stood settled, from when to when."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping
from typing import Any

from case_record.connection import CaseRecordError, Connection, decoded, json_text
from case_record.rows import Hold


class Holds(Connection):
    """At most one of them is open."""

    def begin_hold(
        self,
        *,
        set_id: int,
        place: int,
        setpoints_um: Mapping[str, int],
        readback_um: Mapping[str, int],
        shift_um: Mapping[str, int],
        shift_px: tuple[float, float],
        settled_at_s: float,
        expected_slices: int = 0,
        bridge: Mapping[str, Any] | None = None,
    ) -> Hold:
        """The robot stands settled from `settled_at_s` on. There is at most one open hold.

        bridge: how the robot's bridge stood then, see `service.room.validity`.
        """
        with self.transaction():
            cursor = self._db.execute(
                "INSERT INTO hold (set_id, place, setpoints_um, readback_um, shift_um, shift_px,"
                " settled_at_s, expected_slices, begun_seq, settled_monotonic_s, bridge)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    set_id,
                    place,
                    json_text(setpoints_um),
                    json_text(readback_um),
                    json_text(shift_um),
                    json_text(list(shift_px)),
                    settled_at_s,
                    expected_slices,
                    self._next_seq(),
                    time.monotonic(),
                    json_text(bridge or {}),
                ),
            )
        return self.hold(int(cursor.lastrowid or 0))

    def end_open_hold(self, ended_at_s: float) -> None:
        """Call this before a motion is asked for: from `ended_at_s` on nothing stands."""
        self._db.execute("UPDATE hold SET ended_at_s = ? WHERE ended_at_s IS NULL", (ended_at_s,))

    def expect_slices(self, hold_id: int, count: int) -> None:
        """Say how many slices in all are wanted at this hold."""
        self._db.execute("UPDATE hold SET expected_slices = ? WHERE hold_id = ?", (count, hold_id))

    def hold(self, hold_id: int) -> Hold:
        row = self._db.execute("SELECT * FROM hold WHERE hold_id = ?", (hold_id,)).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: no hold {hold_id}")
        return _hold(row)

    def open_hold(self) -> Hold | None:
        row = self._db.execute("SELECT * FROM hold WHERE ended_at_s IS NULL").fetchone()
        return _hold(row) if row else None

    def holds(self, set_id: int | None = None, since_s: float | None = None) -> list[Hold]:
        """Holds in their order; of one set, or those that had not ended by `since_s`."""
        where, values = ["1"], []
        if set_id is not None:
            where.append("set_id = ?")
            values.append(float(set_id))
        if since_s is not None:
            where.append("(ended_at_s IS NULL OR ended_at_s >= ?)")
            values.append(since_s)
        rows = self._db.execute(
            f"SELECT * FROM hold WHERE {' AND '.join(where)} ORDER BY hold_id", values
        )
        return [_hold(row) for row in rows]

    def newest_holds(self, limit: int) -> list[Hold]:
        """The newest ones, oldest first."""
        rows = self._db.execute("SELECT * FROM hold ORDER BY hold_id DESC LIMIT ?", (limit,))
        return [_hold(row) for row in rows][::-1]

    def next_set_id(self) -> int:
        return int(self._db.execute("SELECT COALESCE(MAX(set_id), 0) + 1 FROM hold").fetchone()[0])


def _hold(row: sqlite3.Row) -> Hold:
    values = decoded(row, "setpoints_um", "readback_um", "shift_um", "shift_px", "bridge")
    values["shift_px"] = tuple(values["shift_px"])
    return Hold(**values)
