"""A case takes slices of its own patient, study and frame of reference, and of no other one."""

from dataclasses import replace

import pytest
from made_slices import a_slice, mr_data_set

from dicom_listener.assign import Assigned, AssignRules, HoldWindow, Known, Quarantined, assign
from dicom_listener.belonging import (
    ACCEPTED,
    BOUND,
    Binding,
    after_event,
    event_body,
    why_not_of,
)
from dicom_listener.clock_offset import OffsetBounds
from dicom_listener.slice_rows import header_for_record, slice_from_record
from dicom_slice.header import slices_of
from dicom_slice.reasons import Reason

FIRST = a_slice(patient_digest="a")
HOLDS = [HoldWindow(1, 1, 990.0, 1005.0, 1), HoldWindow(2, 1, 1010.0, None, 1)]


def decided(slice_, binding=None):
    """About a slice acquired at hold 2, where hold 1 has its slice."""
    at_hold_2 = replace(
        slice_,
        sop_instance_uid="1.2.9",
        interval=replace(FIRST.interval, start_s=1020.0, end_s=1022.0),
        acquisition_number=2,
    )
    known = [Known(FIRST, 1003.0, 1)]
    return assign(at_hold_2, 1023.0, HOLDS, known, OffsetBounds(-0.1, 0.1), AssignRules(), binding)


def test_the_next_slice_of_the_same_examination_is_used():
    assert isinstance(decided(FIRST), Assigned)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"patient_digest": "b"}, Reason.OTHER_PATIENT),
        ({"patient_digest": "b", "study_instance_uid": "9", "frame_of_reference_uid": "9"},
         Reason.OTHER_PATIENT),
        ({"study_instance_uid": "9"}, Reason.OTHER_STUDY),
        ({"frame_of_reference_uid": "9"}, Reason.OTHER_FRAME),
        ({"patient_digest": "", "study_instance_uid": "9"}, Reason.OTHER_STUDY),
    ],
)  # fmt: skip
def test_another_ones_slice_is_set_aside_with_the_reason(changes, code):
    decision = decided(replace(FIRST, **changes))
    assert isinstance(decision, Quarantined)
    assert decision.code == code


def test_a_person_can_say_that_a_further_study_belongs_to_the_case():
    split = replace(FIRST, study_instance_uid="9", frame_of_reference_uid="8")
    binding = after_event(None, BOUND, event_body(FIRST.identity))
    binding = after_event(binding, ACCEPTED, event_body(split.identity))
    assert isinstance(decided(split, binding), Assigned)
    # the table was moved: what comes late of before is in the way of it
    assert why_not_of(binding, FIRST.identity).code == Reason.OTHER_FRAME


def test_an_unbound_case_takes_any():
    assert after_event(None, ACCEPTED, event_body(FIRST.identity)) is None
    assert why_not_of(None, FIRST.identity) is None


def test_patients_are_told_apart_and_not_named():
    def digest_of(**changes):
        data_set = mr_data_set()
        for name, value in changes.items():
            setattr(data_set, name, value)
        return slices_of(data_set)[0].patient_digest

    jane = digest_of()
    assert jane == digest_of(PatientName="Doe^Jane^^^", StudyInstanceUID="1.2.3")
    assert jane != digest_of(PatientID="secret-4712")
    assert digest_of(PatientID="", PatientName="Doe^Jane") != digest_of(
        PatientID="", PatientName="Doe^John"
    )
    assert digest_of(PatientID="", PatientName="") == ""
    assert "secret" not in jane
    assert "Doe" not in jane


def test_a_record_from_before_is_read_without_it():
    header = header_for_record(FIRST)
    assert slice_from_record(header) == FIRST
    del header["patient_digest"]
    assert slice_from_record(header) == replace(FIRST, patient_digest="")
    assert Binding.to(slice_from_record(header).identity).patient == ""
