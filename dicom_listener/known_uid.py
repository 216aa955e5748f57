"""An instance that is here already, with other bytes: a copy in another encoding, or another image.

Archives and routers re-encode what they pass on. The same pixels at the same place of the same
acquisition are the slice that is known; anything else under a known UID is an alarm.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from dicom_listener.slice_rows import header_for_record
from dicom_slice.decode_guard import DecodeGuard
from dicom_slice.header import Slice
from dicom_slice.reasons import Reason, SetAside, UnusableError

# what a change of the encoding changes, and what is only said about reading it
_OF_THE_ENCODING = ("transfer_syntax_uid", "warnings", "rescale", "photometric")
_CONFLICT = SetAside(
    Reason.UID_CONFLICT, "an instance with this UID but different bytes is already here"
)
_COPY = SetAside(
    Reason.REENCODED_COPY, "the same pixels are already here under this UID, encoded differently"
)


def what_it_is(
    record: CaseRecord,
    decoder: DecodeGuard,
    path: Path,
    slices: Sequence[Slice],
    before: Sequence[SliceRow],
) -> SetAside:
    """before: the rows of the instance that has the UID; slices: of the new file."""
    first = [row for row in before if row.path == before[0].path]
    known = {row.frame: row for row in first if "sop_class_uid" in row.header}
    if set(known) != {slice_.frame for slice_ in slices}:
        return _CONFLICT
    for slice_ in slices:
        if _without_encoding(header_for_record(slice_)) != _without_encoding(
            known[slice_.frame].header
        ):
            return _CONFLICT
    try:
        here = decoder.digests(record.case_dir / first[0].path)
        same = decoder.digests(path) == here
    except (UnusableError, OSError):
        return _CONFLICT
    return _COPY if same else _CONFLICT


def _without_encoding(header: Mapping[str, Any]) -> dict[str, Any]:
    """As the record gives it back: tuples are lists there."""
    beside = (*_OF_THE_ENCODING, "envelope", "heeded_event")
    kept = {name: value for name, value in header.items() if name not in beside}
    plain: dict[str, Any] = json.loads(json.dumps(kept))
    return plain
