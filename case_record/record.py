"""The case record: one SQLite file a case directory, shared by listener, worker and service.

Every process (and every thread) opens its own `CaseRecord`; transactions are short, writers wait
for each other. A commit is on disk when the method returns (`synchronous=FULL`). The tables and
their migrations stand in `sql`, the rows in `rows`, and the statements of each table in a module
of its own.
"""

from __future__ import annotations

import time
import uuid

from case_record.connection import FILE_NAME, CaseRecordError, RecordUnavailableError
from case_record.holds import Holds
from case_record.measurements import Measurements
from case_record.moves import Moves
from case_record.procedures import Procedures
from case_record.rows import Case
from case_record.seal_chain import Seals
from case_record.slices import Slices

__all__ = ["FILE_NAME", "CaseRecord", "CaseRecordError", "RecordUnavailableError"]


class CaseRecord(Holds, Slices, Measurements, Procedures, Moves, Seals):
    """One connection to the record of a case. Use it in the thread that opened it."""

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
