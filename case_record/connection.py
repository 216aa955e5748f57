"""One connection to a case record: opened, brought to the present schema, and its transactions."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from case_record import seal_triggers
from case_record.sql import MIGRATIONS, SCHEMA_VERSION

FILE_NAME = "case.sqlite"
_BUSY_TIMEOUT_S = 10.0


class CaseRecordError(Exception):
    """The case directory cannot be used; the text says why and names it."""

    exit_code = 2


class RecordUnavailableError(CaseRecordError):
    """The record cannot be opened now: locked by another, a full disk, a mount that is gone."""

    exit_code = 3


class Connection:
    """What every part of the record stands on. Use it in the thread that opened it.

    read_only: nothing is written, not even a migration: of a record of an older schema a copy in
    memory is brought to the present one.
    busy_timeout_s: so long a statement waits for another writer before it is an error.
    """

    def __init__(
        self,
        case_dir: Path,
        *,
        create: bool = False,
        read_only: bool = False,
        busy_timeout_s: float = _BUSY_TIMEOUT_S,
    ) -> None:
        self.case_dir = Path(case_dir)
        self.read_only = read_only
        self.was_older = False
        path = self.case_dir / FILE_NAME
        if create:
            self.case_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
        elif not path.is_file():
            raise CaseRecordError(f"{self.case_dir}: no case record ({FILE_NAME}) in this folder")
        if create:
            _for_its_owner_alone(self.case_dir, path)
        where = _read_only_uri(path) if read_only else path.absolute().as_uri()
        self._db = sqlite3.connect(where, timeout=busy_timeout_s, isolation_level=None, uri=True)
        self._db.row_factory = sqlite3.Row
        seal_triggers.prepare(self._db)
        try:
            if read_only:
                self._bring_copy_up()
            else:
                self._prepare()
        except sqlite3.OperationalError as error:
            self._db.close()
            raise RecordUnavailableError(f"{path}: {error}") from error
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
            self._migrate(self._version())

    def _version(self) -> int:
        """Of the record's schema. CaseRecordError for one that this program is too old for."""
        version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
        if version > SCHEMA_VERSION:
            raise CaseRecordError(
                f"{self.case_dir}: the case record has schema version {version}, newer than "
                f"this program's {SCHEMA_VERSION}; it was left unchanged"
            )
        return version

    def _migrate(self, version: int) -> None:
        for number in range(version, SCHEMA_VERSION):
            # executescript would commit the surrounding transaction; the pieces do not
            for statement in _statements(MIGRATIONS[number]):
                self._db.execute(statement)
            self._db.execute(f"PRAGMA user_version = {number + 1}")
        seal_triggers.seal_everything(self._db)

    def _bring_copy_up(self) -> None:
        version = self._version()
        self.was_older = version < SCHEMA_VERSION
        if not self.was_older:
            return
        copy = sqlite3.connect(":memory:", isolation_level=None)
        copy.row_factory = sqlite3.Row
        seal_triggers.prepare(copy)
        self._db.backup(copy)
        self._db.close()
        self._db = copy
        with self.transaction():
            self._migrate(version)

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> Self:
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
            self._db.execute("COMMIT")
        except BaseException:
            # SQLite has rolled back by itself where, for one, the disk was full
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise

    def _next_seq(self) -> int:
        """The next number in the order of all that happens; call it inside a transaction."""
        assert self._db.in_transaction
        row = self._db.execute("UPDATE sequence SET last = last + 1 RETURNING last").fetchone()
        return int(row[0])

    def data_version(self) -> int:
        """A number that changes when another connection has committed something."""
        return int(self._db.execute("PRAGMA data_version").fetchone()[0])

    def change_count(self) -> tuple[int, int]:
        """As `data_version`, and a number that also changes with what this connection wrote."""
        return self.data_version(), self._db.total_changes


def is_older(case_dir: Path) -> bool:
    """Whether a program before this one made the record; to write there would change it."""
    with Connection(case_dir, read_only=True) as found:
        return found.was_older


def _for_its_owner_alone(case_dir: Path, path: Path) -> None:
    """Patient data: nobody else may read what is in the folder, or was made by an older program."""
    with contextlib.suppress(OSError):  # not ours to change, or a disk that takes nothing
        if case_dir.stat().st_mode & 0o077:
            case_dir.chmod(0o700)
        if not path.exists():
            path.touch(0o600)
        elif path.stat().st_mode & 0o077:
            path.chmod(0o600)


def _read_only_uri(path: Path) -> str:
    """Without a write-ahead log nobody has the record open: it can be read without leaving one."""
    is_open = path.with_name(path.name + "-wal").exists()
    return f"{path.absolute().as_uri()}?mode=ro{'' if is_open else '&immutable=1'}"


def _statements(script: str) -> Iterator[str]:
    statement = ""
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""


def json_text(value: Any) -> str:
    # NaN would be written as a word that no JSON reader accepts: refuse it where it arises
    return json.dumps(value, allow_nan=False, separators=(",", ":"), sort_keys=True)


def decoded(row: sqlite3.Row, *json_columns: str) -> dict[str, Any]:
    values = dict(row)
    for name in json_columns:
        values[name] = None if values[name] is None else json.loads(values[name])
    return values
