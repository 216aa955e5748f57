"""What the room knows of its robot from the cases before: the last image Jacobian."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from case_record.cases import Cases
from case_record.record import CaseRecord, CaseRecordError
from service.procedure.scan_frame import calibration_good_since

_CASES_LOOKED_AT = 5


def last_jacobian(
    record: CaseRecord, cases: Cases, name: str
) -> tuple[Mapping[str, Any] | None, bool]:
    """Of the robot's last calibration of this name (JSON), and whether it was in this case."""
    row = record.last_procedure(name, "done")
    here = _jacobian(record, name)
    if row is not None and here is not None:
        return here, row.begun_seq > calibration_good_since(record)
    if cases.only is not None:
        return None, False
    for folder in reversed(cases.folders()[-_CASES_LOOKED_AT:]):
        if folder == record.case_dir:
            continue
        try:
            with CaseRecord(folder, read_only=True) as before:
                found = _jacobian(before, name)
        except CaseRecordError:
            continue
        if found is not None:
            return found, False
    return None, False


def _jacobian(record: CaseRecord, name: str) -> Mapping[str, Any] | None:
    row = record.last_procedure(name, "done")
    return None if row is None or row.result is None else row.result["jacobian"]
