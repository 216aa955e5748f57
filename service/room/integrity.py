"""Is the record still what was written? Asked when a case is opened, and before READY."""

from __future__ import annotations

import structlog

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from case_record.seal_chain import TamperedError
from dicom_listener.inbox import NotFromInboxError, data_set_bytes, sha256_of

log = structlog.get_logger()


def doubt_of(record: CaseRecord) -> str:
    """Why nothing may rest on this record, or an empty text; looks at all of it."""
    try:
        whole = record.verify()
    except TamperedError as error:
        log.error("record", error=str(error))
        return str(error)
    log.info("record", events=whole.events, head=whole.head)
    return ""


def doubt_of_arrival(record: CaseRecord, procedure_id: int, measurement_id: int) -> str:
    """As `doubt_of`, of what an approach that came to its end rests on: rows and slices."""
    measurement = record.measurement(measurement_id)
    slices = [
        row for hold in measurement.hold_ids for row in record.slices(hold_id=hold) if row.hold_id
    ]
    rows = [("procedure", procedure_id), ("measurement", measurement_id)]
    rows += [("hold", hold) for hold in measurement.hold_ids]
    rows += [("slice", row.slice_id) for row in slices]
    try:
        record.verify_rows(rows)
        for row in slices:
            check_slice_file(record, row)
    except TamperedError as error:
        log.error("record", error=str(error))
        return str(error)
    log.info("record", approach=procedure_id, head=record.head())
    return ""


def check_slice_file(record: CaseRecord, row: SliceRow) -> None:
    """TamperedError unless the file of a slice, if it is there, is what the record says it was."""
    path = record.case_dir / row.path
    if not path.exists():
        return
    try:
        content = data_set_bytes(path)
    except NotFromInboxError:
        content = path.read_bytes()
    if sha256_of(content) != row.sha256:
        raise TamperedError(f"{path}: not the file that was received")
