"""Plans that workstations send to the listener: noted in the record, for the service to propose."""

import math
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from dicom_listener.inbox import Envelope
from dicom_slice.geometry import SliceGeometry
from dicom_slice.plan import ENTRY, TARGET, PlanObject, PlanPoint, plan_in
from dicom_slice.reasons import UnusableError

PLAN_RECEIVED = "plan_received"
_MAKER = "AutoSPINe Navigator"


def plan_event(record: CaseRecord, path: Path, envelope: Envelope) -> dict[str, Any] | None:
    """What the record is to say of a plan in a received file; None if it holds none."""
    try:
        plan = plan_in(path, _MAKER)
    except (UnusableError, OSError):
        return None
    if plan is None:
        return None
    sender = f"{envelope.calling_ae_title} {envelope.peer_address}".strip()
    body: dict[str, Any] = {
        "sender": sender,
        "name": plan.name,
        "via": f"DICOM {plan.kind}",
        "sop_instance_uid": envelope.sop_instance_uid,
    }
    return {**body, **_places(record, plan)}


def _places(record: CaseRecord, plan: PlanObject) -> dict[str, Any]:
    """Target and entry in patient mm and their frame of reference, or why they are not known."""
    places: dict[str, Any] = {}
    frames = set()
    for name, label in (("target_mm", TARGET), ("entry_mm", ENTRY)):
        same = [point for point in plan.points if point.label == label]
        found = {_in_patient(record, point) for point in same}
        if None in found:
            return {"why": f"its {label} lies on an image that is not in this case"}
        if not all(math.isfinite(value) for place, _ in filter(None, found) for value in place):
            return {"why": f"its {label} is not three finite numbers"}
        if len(found) > 1:
            return {"why": f"{len(found)} points are labelled {label}"}
        for place, frame in filter(None, found):
            places[name] = list(place)
            frames.add(frame)
    if len(frames) > 1:
        return {"why": "its points are given in two frames of reference"}
    return {**places, "frame_of_reference_uid": frames.pop() if frames else ""}


def _in_patient(
    record: CaseRecord, point: PlanPoint
) -> tuple[tuple[float, float, float], str] | None:
    if point.patient_mm is not None:
        return point.patient_mm, point.frame_of_reference_uid
    at = point.on_image
    if at is None:
        return None
    rows = record.slices(sop_instance_uid=at.sop_instance_uid)
    known = [row for row in rows if row.frame == at.frame and row.header.get("geometry")]
    if not known:
        return None
    x, y, z = _geometry(known[0]).patient_from_pixel([at.row_px, at.col_px]).tolist()
    return (x, y, z), str(known[0].header.get("frame_of_reference_uid") or "")


def _geometry(row: SliceRow) -> SliceGeometry:
    values = row.header["geometry"]
    return SliceGeometry(**{name: tuple(value) for name, value in values.items()})
