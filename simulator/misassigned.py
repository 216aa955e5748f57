"""Holds what the record says of each slice against the truth: which slice belongs to which hold."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from case_record.rows import SliceRow

_STANDING_MM = 0.002  # the shift of a drive that is parked or unparked stays below


@dataclass(frozen=True)
class Misassigned:
    """A slice that the record uses for a hold to which it does not belong."""

    sop_instance_uid: str
    hold_id: int
    why: str


def read_truth(path: Path) -> dict[str, dict[str, Any]]:
    """SOP Instance UID → the truth file's line about it; images of extra series among them."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {
        line["sop_instance_uid"]: line for line in lines if line["kind"] in ("acquisition", "extra")
    }


def misassigned(slices: Iterable[SliceRow], truth: dict[str, dict[str, Any]]) -> list[Misassigned]:
    """The slices that are assigned and should not be so; duplicates count once each."""
    return [
        Misassigned(row.sop_instance_uid, row.hold_id, why)
        for row in slices
        if row.state == "assigned" and row.hold_id is not None
        if (why := _why_not(truth.get(row.sop_instance_uid), row.hold_id))
    ]


def _why_not(line: dict[str, Any] | None, hold_id: int) -> str:
    if line is None:
        return "nobody acquired it"
    if line["kind"] == "extra":
        return f"it belongs to an extra series ({line['image_type']})"
    if line["hold_id"] is None:
        return "nobody requested it"
    if line["hold_id"] != hold_id:
        return f"it was acquired for hold {line['hold_id']}"
    if not line["travel_mm"] <= _STANDING_MM:
        return f"the stages moved by {line['travel_mm']:.3f} mm meanwhile"
    if "wrong_orientation" in line["faults"]:
        return "it is an axial slice"
    return ""
