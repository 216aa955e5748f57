"""The slices of a case, and what was decided about each."""

from __future__ import annotations

import sqlite3
from dataclasses import asdict
from typing import Any

from case_record.connection import CaseRecordError, Connection, decoded, json_text
from case_record.rows import NewSlice, SliceRow

_SCAN = (
    "study_instance_uid",
    "frame_of_reference_uid",
    "imaging_frequency_mhz",
    "pixel_bandwidth_hz",
    "phase_encoding_direction",
)


class Slices(Connection):
    """A row a frame: assigned, pending or quarantined."""

    def add_slice(self, new: NewSlice) -> SliceRow:
        """Store a slice row. A row with the same UID, frame and bytes is returned unchanged."""
        with self.transaction():
            values = {**asdict(new), "header": json_text(new.header), "seq": self._next_seq()}
            columns = ", ".join(values)
            marks = ", ".join("?" * len(values))
            self._db.execute(
                f"INSERT INTO slice ({columns}) VALUES ({marks})"
                " ON CONFLICT (sop_instance_uid, frame, sha256) DO NOTHING",
                tuple(values.values()),
            )
            row = self._db.execute(
                "SELECT * FROM slice WHERE sop_instance_uid = ? AND frame = ? AND sha256 = ?",
                (new.sop_instance_uid, new.frame, new.sha256),
            ).fetchone()
        return _slice(row)

    def decide_slice(
        self,
        slice_id: int,
        *,
        state: str,
        hold_id: int | None,
        reason_code: str,
        reason: str,
        decided_by: str,
    ) -> None:
        """Assign, quarantine or re-assign a slice that the record already has."""
        self._db.execute(
            "UPDATE slice SET state = ?, hold_id = ?, reason_code = ?, reason = ?, decided_by = ?"
            " WHERE slice_id = ?",
            (state, hold_id, reason_code, reason, decided_by, slice_id),
        )

    def slices(
        self,
        *,
        hold_id: int | None = None,
        state: str | None = None,
        sop_instance_uid: str | None = None,
        sha256: str | None = None,
    ) -> list[SliceRow]:
        wanted = {
            "hold_id": hold_id,
            "state": state,
            "sop_instance_uid": sop_instance_uid,
            "sha256": sha256,
        }
        given = {name: value for name, value in wanted.items() if value is not None}
        where = " AND ".join(f"{name} = ?" for name in given) or "1"
        rows = self._db.execute(
            f"SELECT * FROM slice WHERE {where} ORDER BY slice_id", tuple(given.values())
        )
        return [_slice(row) for row in rows]

    def slice(self, slice_id: int) -> SliceRow:
        row = self._db.execute("SELECT * FROM slice WHERE slice_id = ?", (slice_id,)).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: no slice {slice_id}")
        return _slice(row)

    def slices_by_hand(self) -> frozenset[int]:
        """Ids of the used slices that a person assigned."""
        rows = self._db.execute(
            "SELECT slice_id FROM slice WHERE state = 'assigned' AND decided_by != 'listener'"
        )
        return frozenset(int(row["slice_id"]) for row in rows)

    def last_slice(self, state: str | None = None) -> SliceRow | None:
        where = "state = ?" if state else "1"
        row = self._db.execute(
            f"SELECT * FROM slice WHERE {where} ORDER BY slice_id DESC LIMIT 1",
            (state,) if state else (),
        ).fetchone()
        return _slice(row) if row else None

    def last_slice_with_reason(self, reason_code: str) -> SliceRow | None:
        """The newest slice that lies aside for this reason."""
        row = self._db.execute(
            "SELECT * FROM slice WHERE state = 'quarantined' AND reason_code = ?"
            " ORDER BY slice_id DESC LIMIT 1",
            (reason_code,),
        ).fetchone()
        return _slice(row) if row else None

    def scans_since(self, seq: int) -> list[dict[str, Any]]:
        """The kinds of slices that came later: state, reason_code, and of the header study, frame
        of reference and what shifts oil against water.
        """
        parts = ", ".join(f"json_extract(header, '$.{name}') AS {name}" for name in _SCAN)
        rows = self._db.execute(
            f"SELECT DISTINCT state, reason_code, {parts} FROM slice WHERE seq > ?"
            " AND json_extract(header, '$.study_instance_uid') IS NOT NULL",
            (seq,),
        )
        return [dict(row) for row in rows]

    def page_of_slices(
        self, *, after_id: int, limit: int, newest: bool, state: str | None
    ) -> list[SliceRow]:
        """Return slices in pages by id: upwards from `after_id`, or the newest ones first."""
        order = "DESC" if newest else "ASC"
        beyond = "slice_id < ?2" if newest and after_id else "slice_id > ?2"
        rows = self._db.execute(
            "SELECT * FROM slice WHERE (?1 IS NULL OR state = ?1)"
            f" AND {beyond} ORDER BY slice_id {order} LIMIT ?3",
            (state, after_id, limit),
        )
        return [_slice(row) for row in rows]

    def count_slices_after(self, slice_id: int, state: str) -> int:
        row = self._db.execute(
            "SELECT COUNT(*) FROM slice WHERE slice_id > ? AND state = ?", (slice_id, state)
        ).fetchone()
        return int(row[0])

    def count_slices(self) -> dict[str, int]:
        rows = self._db.execute("SELECT state, COUNT(*) AS n FROM slice GROUP BY state")
        return {row["state"]: row["n"] for row in rows}


def _slice(row: sqlite3.Row) -> SliceRow:
    return SliceRow(**decoded(row, "header"))
