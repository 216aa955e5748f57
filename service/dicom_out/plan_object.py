"""The plan of a case, target and entry point, as a Spatial Fiducials object: what workstations send
us as a proposal goes back to them as it was decided.

Labels and places are those that `dicom_slice.plan` reads: TARGET and ENTRY, points in patient mm.
There is no such object without a point: where a target was withdrawn, its place is labelled
WITHDRAWN, so that who was sent it before is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import pydicom
from highdicom.base import SOPClass
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid
from pydicom.valuerep import format_number_as_ds

from case_record.record import CaseRecord
from case_record.rows import Event, SliceRow
from dicom_slice.plan import ENTRY, SPATIAL_FIDUCIALS, TARGET
from service.dicom_out.content import plan_events
from service.dicom_out.errors import OutputError
from service.dicom_out.identity import MAKER, SERIES_NUMBERS, software_version
from service.dicom_out.source import frame_of_reference, tidy_patient
from service.procedure.scan_frame import STUDY_ACCEPTED, places_good_since
from service.procedure.targets import ENTRY_SET, TARGET_SET, TARGET_WITHDRAWN

_WITHDRAWN = "WITHDRAWN"


def plan_of(record: CaseRecord, event_id: int) -> Dataset:
    """The plan as it was from an event on; the same for the same record. Raises OutputError."""
    event = next((e for e in plan_events(record) if e.event_id == event_id), None)
    case = record.case()
    if event is None or case is None:
        raise OutputError(f"event {event_id} is not a change of the plan")
    source = pydicom.dcmread(
        record.case_dir / _slice_of(record, event).path, stop_before_pixels=True
    )
    tidy_patient(source)
    frame = _frame_at(record, event) or frame_of_reference(source)
    at = datetime.fromtimestamp(event.wall_s)
    begun = datetime.fromtimestamp(case.created_s)
    study = str(source.StudyInstanceUID)
    series = [case.case_uid, "series", "plan", study, frame, software_version()]
    made = SOPClass(
        study_instance_uid=study,
        series_instance_uid=generate_uid(entropy_srcs=series),
        series_number=SERIES_NUMBERS["plan"],
        sop_instance_uid=generate_uid(entropy_srcs=[case.case_uid, f"plan-{event_id}"]),
        sop_class_uid=SPATIAL_FIDUCIALS,
        instance_number=event_id,
        modality="FID",
        manufacturer=MAKER,
        manufacturer_model_name=MAKER,
        software_versions=software_version(),
        transfer_syntax_uid=ExplicitVRLittleEndian,
        series_description="AutoSPINe plan (research)",
        series_date=begun.date(),
        series_time=begun.time(),
        content_date=at.date(),
        content_time=at.time(),
    )
    made.copy_patient_and_study_information(source)
    for keyword in ("SpecificCharacterSet", "BodyPartExamined", "Laterality"):
        if keyword in source:
            made[keyword] = source[keyword]
    made.InstanceCreationDate, made.InstanceCreationTime = made.ContentDate, made.ContentTime
    made.ContentLabel, made.ContentCreatorName = "AUTOSPINE", None
    made.ContentDescription = "Target and entry point (research)"
    if event.kind == TARGET_WITHDRAWN:
        made.ContentDescription = "The target was withdrawn (research)"
    points = [_point(*one) for one in _places(record, event)]
    group = Dataset()
    group.FrameOfReferenceUID, group.FiducialSequence = frame, points
    made.FiducialSetSequence = [group]
    return made


def _slice_of(record: CaseRecord, event: Event) -> SliceRow:
    """The newest slice when the plan was made, else the first: whose patient and frame it is in."""
    rows = record.slices(state="assigned")
    before = [row for row in rows if row.received_s <= event.wall_s]
    return before[-1] if before else rows[0]


def _frame_at(record: CaseRecord, event: Event) -> str:
    """The frame of reference that a person accepted for the case before the event, if one did."""
    accepted = [e for e in record.events_of_kind(STUDY_ACCEPTED) if e.seq <= event.seq]
    return str(accepted[-1].body.get("frame_of_reference") or "") if accepted else ""


def _places(record: CaseRecord, event: Event) -> list[tuple[str, Sequence[float]]]:
    """What held right after the event, nothing of before the table moved; the operator's words for
    the target are no label.
    """
    places, good_since = [], places_good_since(record, event.seq)
    for label, kinds in ((TARGET, (TARGET_SET, TARGET_WITHDRAWN)), (ENTRY, (ENTRY_SET,))):
        known = [e for kind in kinds for e in record.events_of_kind(kind)]
        last = max(
            (e for e in known if e.event_id <= event.event_id),
            key=lambda e: e.event_id,
            default=None,
        )
        if last is not None and last.seq > good_since and "patient_mm" in last.body:
            places.append((label, last.body["patient_mm"]))
    if event.kind == TARGET_WITHDRAWN:
        before = [e for e in record.events_of_kind(TARGET_SET) if e.event_id < event.event_id]
        places.append((_WITHDRAWN, before[-1].body["patient_mm"]))
    return places


def _point(label: str, patient_mm: Sequence[float]) -> Dataset:
    point, code = Dataset(), Dataset()
    code.CodeValue, code.CodingSchemeDesignator, code.CodeMeaning = label, "99AUTOSPINE", label
    point.FiducialIdentifier, point.FiducialIdentifierCodeSequence = label, [code]
    point.ShapeType, point.NumberOfContourPoints = "POINT", 1
    point.ContourData = [format_number_as_ds(float(value)) for value in patient_mm]
    return point
