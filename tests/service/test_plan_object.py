"""The plan that is sent out says what held when it was decided, in the frame that held then."""

import pydicom
import pytest
from recorded_case import make_case

from case_record.record import CaseRecord
from dicom_listener.belonging import ACCEPTED, BOUND, event_body
from dicom_slice.patient import Identity
from dicom_slice.plan import plan_in
from service.dicom_out.content import plan_events
from service.dicom_out.errors import OutputError
from service.dicom_out.make import make_output, plans_to_send
from service.dicom_out.plan_object import plan_of
from service.procedure.targets import ENTRY_SET, TARGET_SET, TARGET_WITHDRAWN


@pytest.fixture
def record(tmp_path):
    with CaseRecord(make_case(tmp_path)) as opened:
        yield opened


def test_after_the_table_moved_the_plan_has_no_place_of_before_and_names_the_new_frame(record):
    header = record.last_slice("assigned").header
    study, frame = header["study_instance_uid"], header["frame_of_reference_uid"]

    def note(kind, body):
        return record.append_event(kind, body, source="service", who="Olga")

    note(BOUND, event_body(Identity("p", study, frame)))
    note(ENTRY_SET, {"patient_mm": [9.0, 9.0, 99.0]})
    before = note(TARGET_SET, {"patient_mm": [1.0, 2.0, 3.0]})
    note(ACCEPTED, event_body(Identity("p", "1.2.3.1", "1.2.3.7")))
    after = note(TARGET_SET, {"patient_mm": [4.0, 5.0, 6.0]})
    for event, labels, in_frame in (
        (before, ["TARGET", "ENTRY"], frame),
        (after, ["TARGET"], "1.2.3.7"),
    ):
        (group,) = plan_of(record, event).FiducialSetSequence
        assert [point.FiducialIdentifier for point in group.FiducialSequence] == labels
        assert group.FrameOfReferenceUID == in_frame


@pytest.mark.parametrize(
    ("charset", "name"),
    [
        ("ISO_IR 100", "Müller^Jörg"),
        ("ISO_IR 192", "Müller^Jörg=山田"),
        (["", "ISO 2022 IR 87"], "Yamada^Tarou=山田^太郎"),
    ],
)
def test_the_plan_writes_the_patients_name_as_the_slices_do(record, tmp_path, charset, name):
    for row in record.slices(state="assigned"):
        path = record.case_dir / row.path
        source = pydicom.dcmread(path)
        source.SpecificCharacterSet, source.PatientName = charset, name
        source.save_as(path)
    event = record.append_event(
        TARGET_SET, {"patient_mm": [1.0, 2.0, 3.0]}, source="service", who="Olga"
    )
    made = plan_of(record, event)
    made.save_as(tmp_path / "plan.dcm", enforce_file_format=True)
    assert str(pydicom.dcmread(tmp_path / "plan.dcm").PatientName) == name


def test_a_target_that_was_withdrawn_is_contradicted_and_what_was_never_set_is_not(record):
    def note(kind, body):
        return record.append_event(kind, body, source="service", who="Olga")

    (set_before,) = record.events_of_kind(TARGET_SET) or [None]
    assert set_before is None
    never_set = note(TARGET_WITHDRAWN, {})
    assert plan_events(record) == []
    note(TARGET_SET, {"patient_mm": [1.0, 2.0, 3.0]})
    withdrawn = note(TARGET_WITHDRAWN, {})
    note(ENTRY_SET, {"patient_mm": [9.0, 9.0, 99.0]})
    assert never_set not in [event.event_id for event in plan_events(record)]
    (last,) = [o for o in plans_to_send(record) if o.number == withdrawn]
    path = make_output(record, last)
    (group,) = pydicom.dcmread(path).FiducialSetSequence
    assert [point.FiducialIdentifier for point in group.FiducialSequence] == ["WITHDRAWN"]
    told = plan_in(path, made_by_us="somebody else")
    assert told is None, "it proposes nothing"
    with pytest.raises(OutputError, match="not a change of the plan"):
        plan_of(record, never_set)
