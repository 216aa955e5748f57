"""The case record: one SQLite file a case directory, shared by listener, worker and service.

Every process (and every thread) opens its own `CaseRecord`; transactions are short, writers wait
for each other. A commit is on disk when the method returns (`synchronous=FULL`).
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from case_record.rows import (
    Case,
    Event,
    Hold,
    Measurement,
    Move,
    NewSlice,
    Procedure,
    SliceRow,
    Step,
)
from case_record.sql import MIGRATIONS, SCHEMA_VERSION

FILE_NAME = "case.sqlite"
_FIRST_HASH = "0" * 64
_BUSY_TIMEOUT_S = 10.0


class CaseRecordError(Exception):
    """The case directory cannot be used; the text says why and names it."""

    exit_code = 2


class CaseRecord:
    """One connection to the record of a case. Use it in the thread that opened it.

    read_only: nothing is written, not even a migration; a record of another schema is refused.
    """

    def __init__(self, case_dir: Path, *, create: bool = False, read_only: bool = False) -> None:
        self.case_dir = Path(case_dir)
        path = self.case_dir / FILE_NAME
        if create:
            self.case_dir.mkdir(parents=True, exist_ok=True)
        elif not path.is_file():
            raise CaseRecordError(f"{self.case_dir}: no case record ({FILE_NAME}) in this folder")
        where = _read_only_uri(path) if read_only else path.absolute().as_uri()
        self._db = sqlite3.connect(where, timeout=_BUSY_TIMEOUT_S, isolation_level=None, uri=True)
        self._db.row_factory = sqlite3.Row
        try:
            if read_only:
                self._check_schema()
            else:
                self._prepare()
        except sqlite3.DatabaseError as error:
            self._db.close()
            raise CaseRecordError(f"{path}: not a usable case record ({error})") from error
        except CaseRecordError:
            self._db.close()
            raise

    def _prepare(self) -> None:
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.execute("PRAGMA foreign_keys = ON")
        if self._db.execute("PRAGMA user_version").fetchone()[0] == SCHEMA_VERSION:
            return  # the usual case: who only reads does not wait for a writer
        with self.transaction():
            version = self._db.execute("PRAGMA user_version").fetchone()[0]
            if version > SCHEMA_VERSION:
                raise CaseRecordError(
                    f"{self.case_dir}: the case record has schema version {version}, newer than "
                    f"this program's {SCHEMA_VERSION}; it was left untouched"
                )
            for number in range(version, SCHEMA_VERSION):
                # executescript would commit the surrounding transaction; the pieces do not
                for statement in _statements(MIGRATIONS[number]):
                    self._db.execute(statement)
                self._db.execute(f"PRAGMA user_version = {number + 1}")

    def _check_schema(self) -> None:
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if version != SCHEMA_VERSION:
            raise CaseRecordError(
                f"{self.case_dir}: the case record has schema version {version}, this program "
                f"reads {SCHEMA_VERSION}; it was left untouched"
            )

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> CaseRecord:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Make the enclosed calls one atomic, durable change. May be nested."""
        if self._db.in_transaction:
            yield
            return
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._db.execute("ROLLBACK")
            raise
        self._db.execute("COMMIT")

    def data_version(self) -> int:
        """A number that changes when another connection has committed something."""
        return int(self._db.execute("PRAGMA data_version").fetchone()[0])

    def change_count(self) -> tuple[int, int]:
        """As `data_version`, and a number that also changes with what this connection wrote."""
        return self.data_version(), self._db.total_changes

    # The case itself

    def start_case(self, name: str, seed: int) -> Case:
        """Return the case of this directory, made with this name and seed if there is none yet."""
        with self.transaction():
            known = self.case()
            if known is not None:
                return known
            case = Case(str(uuid.uuid4()), name, seed, time.time())
            self._db.execute(
                'INSERT INTO "case" VALUES (1, ?, ?, ?, ?)',
                (case.case_uid, case.name, case.seed, case.created_s),
            )
            self.append_event("case_started", {"name": name, "seed": seed}, source="record")
        return case

    def case(self) -> Case | None:
        row = self._db.execute('SELECT case_uid, name, seed, created_s FROM "case"').fetchone()
        return Case(**row) if row else None

    # Events: append-only, each carrying the hash of the one before it

    def append_event(
        self, kind: str, body: Mapping[str, Any], *, source: str, who: str = "-"
    ) -> int:
        text = _json(body)
        wall_s, monotonic_s = time.time(), time.monotonic()
        with self.transaction():
            last = self._db.execute(
                "SELECT hash FROM event ORDER BY event_id DESC LIMIT 1"
            ).fetchone()
            previous = last["hash"] if last else _FIRST_HASH
            digest = _event_hash(previous, wall_s, monotonic_s, source, who, kind, text)
            cursor = self._db.execute(
                "INSERT INTO event (wall_s, monotonic_s, source, who, kind, body, previous_hash,"
                " hash) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (wall_s, monotonic_s, source, who, kind, text, previous, digest),
            )
        return int(cursor.lastrowid or 0)

    def events(self, after_id: int = 0, limit: int = 1000) -> list[Event]:
        rows = self._db.execute(
            "SELECT * FROM event WHERE event_id > ? ORDER BY event_id LIMIT ?", (after_id, limit)
        )
        return [Event(**{**row, "body": json.loads(row["body"])}) for row in map(dict, rows)]

    def newest_events(self, limit: int, before_id: int | None = None) -> list[Event]:
        """Return the newest events (before one of them), newest first."""
        rows = self._db.execute(
            "SELECT * FROM event WHERE event_id < ? ORDER BY event_id DESC LIMIT ?",
            (before_id if before_id is not None else 2**62, limit),
        )
        return [Event(**{**row, "body": json.loads(row["body"])}) for row in map(dict, rows)]

    def events_of_kind(self, kind: str, after_id: int = 0) -> list[Event]:
        """Return all events of a kind, oldest first."""
        rows = self._db.execute(
            "SELECT * FROM event WHERE kind = ? AND event_id > ? ORDER BY event_id",
            (kind, after_id),
        )
        return [Event(**{**row, "body": json.loads(row["body"])}) for row in map(dict, rows)]

    def last_event(self, kind: str) -> Event | None:
        """Return the newest event of a kind."""
        row = self._db.execute(
            "SELECT * FROM event WHERE kind = ? ORDER BY event_id DESC LIMIT 1", (kind,)
        ).fetchone()
        return Event(**{**dict(row), "body": json.loads(row["body"])}) if row else None

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

    # Holds

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
    ) -> Hold:
        """The robot stands settled from `settled_at_s` on. There is at most one open hold."""
        cursor = self._db.execute(
            "INSERT INTO hold (set_id, place, setpoints_um, readback_um, shift_um, shift_px,"
            " settled_at_s, expected_slices) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (
                set_id,
                place,
                _json(setpoints_um),
                _json(readback_um),
                _json(shift_um),
                _json(list(shift_px)),
                settled_at_s,
                expected_slices,
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
            raise CaseRecordError(f"{self.case_dir}: there is no hold {hold_id}")
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

    def next_set_id(self) -> int:
        return int(self._db.execute("SELECT COALESCE(MAX(set_id), 0) + 1 FROM hold").fetchone()[0])

    # Slices

    def add_slice(self, new: NewSlice) -> SliceRow:
        """Store a slice row. A row with the same UID, frame and bytes is returned unchanged."""
        values = {**asdict(new), "header": _json(new.header)}
        columns = ", ".join(values)
        marks = ", ".join("?" * len(values))
        with self.transaction():
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
            raise CaseRecordError(f"{self.case_dir}: there is no slice {slice_id}")
        return _slice(row)

    def last_slice(self, state: str | None = None) -> SliceRow | None:
        where = "state = ?" if state else "1"
        row = self._db.execute(
            f"SELECT * FROM slice WHERE {where} ORDER BY slice_id DESC LIMIT 1",
            (state,) if state else (),
        ).fetchone()
        return _slice(row) if row else None

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

    # Measurements

    def request_measurement(
        self, method: str, hold_ids: Sequence[int], request: Mapping[str, Any]
    ) -> int:
        cursor = self._db.execute(
            "INSERT INTO measurement (state, method, hold_ids, request, requested_s)"
            " VALUES ('requested', ?, ?, ?, ?)",
            (method, _json(list(hold_ids)), _json(request), time.time()),
        )
        return int(cursor.lastrowid or 0)

    def requested_measurements(self) -> list[Measurement]:
        rows = self._db.execute(
            "SELECT * FROM measurement WHERE state = 'requested' ORDER BY measurement_id"
        )
        return [_measurement(row) for row in rows]

    def finish_measurement(self, measurement_id: int, result: Mapping[str, Any]) -> None:
        self._db.execute(
            "UPDATE measurement SET state = 'done', finished_s = ?, result = ?"
            " WHERE measurement_id = ? AND state = 'requested'",
            (time.time(), _json(result), measurement_id),
        )

    def fail_measurement(self, measurement_id: int, reason_code: str, reason: str) -> None:
        self._db.execute(
            "UPDATE measurement SET state = 'failed', finished_s = ?, reason_code = ?, reason = ?"
            " WHERE measurement_id = ? AND state = 'requested'",
            (time.time(), reason_code, reason, measurement_id),
        )

    def measurement(self, measurement_id: int) -> Measurement:
        row = self._db.execute(
            "SELECT * FROM measurement WHERE measurement_id = ?", (measurement_id,)
        ).fetchone()
        if row is None:
            raise CaseRecordError(f"{self.case_dir}: there is no measurement {measurement_id}")
        return _measurement(row)

    def last_measurement(self, state: str | None = None) -> Measurement | None:
        """Return the newest measurement; without a state the newest that is not just requested."""
        row = self._db.execute(
            "SELECT * FROM measurement WHERE state = COALESCE(?, state) AND state != 'requested'"
            " ORDER BY measurement_id DESC LIMIT 1",
            (state,),
        ).fetchone()
        return _measurement(row) if row else None

    def measurements(self, state: str | None = None) -> list[Measurement]:
        where = "state = ?" if state else "1"
        rows = self._db.execute(
            f"SELECT * FROM measurement WHERE {where} ORDER BY measurement_id",
            (state,) if state else (),
        )
        return [_measurement(row) for row in rows]

    def page_of_measurements(self, *, after_id: int, limit: int, newest: bool) -> list[Measurement]:
        """Return measurements in pages by id: upwards from `after_id`, or the newest ones first."""
        order = "DESC" if newest else "ASC"
        beyond = "measurement_id < ?1" if newest and after_id else "measurement_id > ?1"
        rows = self._db.execute(
            f"SELECT * FROM measurement WHERE {beyond} ORDER BY measurement_id {order} LIMIT ?2",
            (after_id, limit),
        )
        return [_measurement(row) for row in rows]

    # Procedures and their steps

    def begin_procedure(self, name: str, arguments: Mapping[str, Any]) -> int:
        cursor = self._db.execute(
            "INSERT INTO procedure (name, arguments, state, started_s) VALUES (?, ?, 'running', ?)",
            (name, _json(arguments), time.time()),
        )
        return int(cursor.lastrowid or 0)

    def end_procedure(self, procedure_id: int, state: str, result: Mapping[str, Any]) -> None:
        self._db.execute(
            "UPDATE procedure SET state = ?, result = ?, ended_s = ? WHERE procedure_id = ?",
            (state, _json(result), time.time(), procedure_id),
        )

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
                (procedure_id, number, kind, _json(body), time.time()),
            )
            row = self._db.execute(
                "SELECT * FROM step WHERE procedure_id = ? AND number = ?", (procedure_id, number)
            ).fetchone()
        return _step(row)

    def end_step(self, procedure_id: int, number: int, outcome: Mapping[str, Any]) -> None:
        self._db.execute(
            "UPDATE step SET outcome = ?, ended_s = ? WHERE procedure_id = ? AND number = ?",
            (_json(outcome), time.time(), procedure_id, number),
        )

    def steps(self, procedure_id: int) -> list[Step]:
        rows = self._db.execute(
            "SELECT * FROM step WHERE procedure_id = ? ORDER BY number", (procedure_id,)
        )
        return [_step(row) for row in rows]

    # Moves

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
                (command_id, measurement_id, purpose, _json(setpoints_um), time.time()),
            )
        return self.move(command_id)

    def end_move(
        self, command_id: str, state: str, code: str, text: str, readback_um: Mapping[str, int]
    ) -> None:
        self._db.execute(
            "UPDATE move SET state = ?, code = ?, text = ?, readback_um = ?, ended_s = ?"
            " WHERE command_id = ?",
            (state, code, text, _json(readback_um), time.time(), command_id),
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


def _statements(script: str) -> Iterator[str]:
    statement = ""
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""


def _json(value: Any) -> str:
    # NaN would be written as a word that no JSON reader accepts: refuse it where it arises
    return json.dumps(value, allow_nan=False, separators=(",", ":"), sort_keys=True)


def _event_hash(previous: str, *fields: Any) -> str:
    return hashlib.sha256(_json([previous, *fields]).encode()).hexdigest()


def _decoded(row: sqlite3.Row, *json_columns: str) -> dict[str, Any]:
    values = dict(row)
    for name in json_columns:
        values[name] = None if values[name] is None else json.loads(values[name])
    return values


def _hold(row: sqlite3.Row) -> Hold:
    values = _decoded(row, "setpoints_um", "readback_um", "shift_um", "shift_px")
    values["shift_px"] = tuple(values["shift_px"])
    return Hold(**values)


def _slice(row: sqlite3.Row) -> SliceRow:
    return SliceRow(**_decoded(row, "header"))


def _measurement(row: sqlite3.Row) -> Measurement:
    values = _decoded(row, "hold_ids", "request", "result")
    values["hold_ids"] = tuple(values["hold_ids"])
    return Measurement(**values)


def _procedure(row: sqlite3.Row) -> Procedure:
    return Procedure(**_decoded(row, "arguments", "result"))


def _step(row: sqlite3.Row) -> Step:
    return Step(**_decoded(row, "body", "outcome"))


def _move(row: sqlite3.Row) -> Move:
    return Move(**_decoded(row, "setpoints_um", "readback_um"))


def _read_only_uri(path: Path) -> str:
    """Without a write-ahead log nobody has the record open: it can be read without leaving one."""
    is_open = path.with_name(path.name + "-wal").exists()
    return f"{path.absolute().as_uri()}?mode=ro{'' if is_open else '&immutable=1'}"
