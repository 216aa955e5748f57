"""Distortion-corrected slices and originals of one case are never mixed, whichever comes first."""

from made_slices import a_slice

from dicom_listener.assign import Assigned, AssignRules, HoldWindow, Known, Quarantined, assign
from dicom_listener.clock_offset import OffsetBounds
from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.reasons import Reason

FIRST = HoldWindow(1, 1, 900.0, 950.0, 0)
STANDING = HoldWindow(2, 2, 990.0, None, 2)


def decide(known: list[Known], **changes: object) -> object:
    slice_ = a_slice(acquisition_number=7, **changes)
    return assign(
        slice_, 1003.0, [FIRST, STANDING], known, OffsetBounds(-0.05, 0.05), AssignRules()
    )


def test_the_first_slice_used_in_a_case_decides_for_all_sets():
    corrected = Known(a_slice(sop_instance_uid="1.2.9", distortion_corrected=True), 940.0, 1)
    refused = decide([corrected], distortion_corrected=False)
    assert isinstance(refused, Quarantined)
    assert refused.code == Reason.DISTORTION_TWIN
    assert isinstance(decide([corrected], distortion_corrected=True), Assigned)


def test_a_slice_that_was_set_aside_decides_nothing():
    aside = Known(a_slice(sop_instance_uid="1.2.9", distortion_corrected=True), 940.0, None, "late")
    assert isinstance(decide([aside], distortion_corrected=False), Assigned)


def test_a_room_that_says_which_it_uses_sets_the_other_aside_by_name():
    originals = SliceRules(distortion_corrected=False)
    assert why_not_usable(a_slice(distortion_corrected=False), originals) is None
    reason = why_not_usable(a_slice(distortion_corrected=True), originals)
    assert reason is not None
    assert reason.code == Reason.DISTORTION_TWIN
