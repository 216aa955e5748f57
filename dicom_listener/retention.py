"""Files that were set aside are removed after a time; what was used never is."""

from case_record.record import CaseRecord


def remove_old(record: CaseRecord, retention_s: float, now_s: float) -> int:
    """Remove set-aside files older than `retention_s` (0: keep all); rows and events stay.

    Return how many were removed.
    """
    if not retention_s > 0:
        return 0
    rows = record.slices()
    kept = {row.path for row in rows if row.state != "quarantined"}
    old = {
        row.path
        for row in rows
        if row.state == "quarantined" and row.received_s < now_s - retention_s
    }
    removed = [name for name in sorted(old - kept) if (record.case_dir / name).exists()]
    for name in removed:
        (record.case_dir / name).unlink()
    if removed:
        body = {"count": len(removed), "paths": removed[:100]}
        record.append_event("files_removed", body, source="listener")
    return len(removed)
