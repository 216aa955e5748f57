"""Plans that workstations send to the listener: noted in the record, for the service to propose.

Every point is in a frame of reference: its own, or that of the slices it was made on. One of which
nobody can tell is no plan, and the reason is noted in its place.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import SliceRow
from dicom_listener.inbox import Envelope
from dicom_slice.geometry import SliceGeometry
from dicom_slice.plan import ENTRY, TARGET, OnImage, PlanObject, PlanPoint, plan_in
from dicom_slice.reasons import Reason, UnusableError

PLAN_RECEIVED = "plan_received"
_MAKER = "AutoSPINe Navigator"
_NOT_OURS = (Reason.OTHER_PATIENT, Reason.OTHER_STUDY, Reason.OTHER_FRAME)

Place = tuple[tuple[float, float, float], str]


class _NoPlaceError(Exception):
    """Why a point is nowhere in this case; what follows its name."""


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
    if plan.why:
        return {"why": plan.why}
    places: dict[str, Any] = {}
    frames = set()
    for name, label in (("target_mm", TARGET), ("entry_mm", ENTRY)):
        same = [point for point in plan.points if point.label == label]
        try:
            found = {_in_patient(record, point) for point in _placed(same)}
        except _NoPlaceError as error:
            return {"why": f"its {label} {error}"}
        if len(found) > 1:
            return {"why": f"{len(found)} points are labelled {label}"}
        for place, frame in found:
            places[name] = list(place)
            frames.add(frame)
    if len(frames) > 1:
        return {"why": "its points are given in two frames of reference"}
    places["frame_of_reference_uid"] = frame = frames.pop()
    if not frame:  # then when its images came has to tell whether the table has moved since
        places["slice_ids"] = [row.slice_id for row in _slices_named(record, plan.points)]
    return places


def _slices_named(record: CaseRecord, points: Sequence[PlanPoint]) -> list[SliceRow]:
    on_images = {point.on_image.sop_instance_uid for point in points if point.on_image}
    uids = on_images.union(*(point.images for point in points))
    return [row for uid in sorted(uids) for row in record.slices(sop_instance_uid=uid)]


def _placed(same: list[PlanPoint]) -> list[PlanPoint]:
    """Those that are points, or else circles; what is drawn besides under the same label does not
    matter then.
    """
    placed = [point for point in same if not point.why]
    if same and not placed:
        raise _NoPlaceError(same[0].why)
    return [point for point in placed if not point.is_circle] or placed


def _in_patient(record: CaseRecord, point: PlanPoint) -> Place:
    if point.on_image is not None:
        place, frame = _on_slice(record, point.on_image)
    else:
        assert point.patient_mm is not None
        place = point.patient_mm
        frame = point.frame_of_reference_uid or _frame_of_images(record, point.images)
    if not all(math.isfinite(value) for value in place):
        raise _NoPlaceError("is not three finite numbers")
    return place, frame


def _on_slice(record: CaseRecord, at: OnImage) -> Place:
    rows = record.slices(sop_instance_uid=at.sop_instance_uid)
    if at.frame is None and len({row.frame for row in rows}) > 1:
        raise _NoPlaceError("lies on an image of several frames and names none of them")
    wanted = [row for row in rows if at.frame in (None, row.frame)]
    if any(row.reason_code == Reason.MOSAIC for row in wanted):
        raise _NoPlaceError("lies on a mosaic of several slices")
    known = [row for row in wanted if row.header.get("geometry")]
    _check_ours(known)
    geometries = {_geometry(row) for row in known}
    if len(geometries) != 1:
        raise _NoPlaceError("lies on an image whose UID is not unique in this case")
    geometry = geometries.pop()
    n_rows, n_cols = geometry.shape
    if not (-0.5 <= at.row_px <= n_rows - 0.5 and -0.5 <= at.col_px <= n_cols - 0.5):
        raise _NoPlaceError(f"lies outside its image of {n_rows} x {n_cols} pixels")
    x, y, z = geometry.patient_from_pixel([at.row_px, at.col_px]).tolist()
    return (x, y, z), _frame_of(known)


def _frame_of_images(record: CaseRecord, uids: tuple[str, ...]) -> str:
    """Of coordinates without a frame of reference: that of the images they were made on."""
    if not uids:
        raise _NoPlaceError(
            "has no frame of reference and names no image: send it with its FrameOfReferenceUID"
        )
    frames = set()
    for uid in uids:
        known = record.slices(sop_instance_uid=uid)
        _check_ours(known)
        frames.add(_frame_of(known))
    if len(frames) > 1:
        raise _NoPlaceError("has no frame of reference, and its images have two")
    return frames.pop()


def _check_ours(known: list[SliceRow]) -> None:
    if not known:
        raise _NoPlaceError("lies on an image that is not in this case")
    if any(row.reason_code in _NOT_OURS for row in known):
        raise _NoPlaceError("lies on an image that does not belong to this case")


def _frame_of(known: list[SliceRow]) -> str:
    """A slice that was used is the case's own, though its scanner names no frame of reference."""
    frames = {str(row.header.get("frame_of_reference_uid") or "") for row in known}
    frame = frames.pop()
    if frames or not (frame or any(row.state == "assigned" for row in known)):
        raise _NoPlaceError("lies on an image whose frame of reference is not known")
    return frame


def _geometry(row: SliceRow) -> SliceGeometry:
    values = row.header["geometry"]
    return SliceGeometry(**{name: tuple(value) for name, value in values.items()})
