"""What people say of slices that wait, or lie aside: that they are of the open case after all."""

from __future__ import annotations

from pathlib import Path

from case_record.connection import CaseRecordError
from case_record.holding import HeldStudy, Holding
from case_record.record import CaseRecord
from dicom_listener.belonging import ACCEPTED, BOUND, event_body
from dicom_listener.case_gate import TAKEN, recorded_binding
from dicom_slice.patient import Identity
from dicom_slice.reasons import Reason

_SOURCE = "operator"


class TakingError(ValueError):
    """They cannot be taken in; the text says why."""


def take_study(record: CaseRecord, home: Path, study: str, who: str) -> None:
    """The slices of a study that wait belong to this case; the listener brings them in.

    A case without any used slice is bound to the study by that; one that is bound accepts it as a
    further study of the same patient. Raises TakingError for another patient's.
    """
    waiting = _waiting(home, study)
    whose = Identity(waiting.patient, waiting.study, waiting.frame_of_reference)
    binding = recorded_binding(record)
    if binding is not None and binding.patient and whose.patient not in ("", binding.patient):
        raise TakingError(
            "These slices belong to a different patient from the open case: finish it and start "
            "a new case for them."
        )
    with record.transaction():
        if binding is None:
            record.append_event(BOUND, event_body(whose), source=_SOURCE, who=who)
        elif study not in binding.studies:
            record.append_event(ACCEPTED, event_body(whose), source=_SOURCE, who=who)
        record.append_event(TAKEN, {"study": study}, source=_SOURCE, who=who)


def _waiting(home: Path, study: str) -> HeldStudy:
    try:
        with Holding(home, read_only=True) as holding:
            for waiting in holding.studies():
                if waiting.study == study and study:
                    return waiting
    except CaseRecordError as error:
        raise TakingError(f"The holding area cannot be read: {error}.") from error
    raise TakingError(f"There are no slices of study {study[:64]!r} in the holding area.")


def accept_frame(record: CaseRecord, who: str) -> None:
    """The table was moved: from now on the frame of reference of the newest slice that was set
    aside for another one is the case's. What was measured and set before is void.
    """
    aside = record.last_slice_with_reason(Reason.OTHER_FRAME)
    binding = recorded_binding(record)
    frame = "" if aside is None else str(aside.header["frame_of_reference_uid"])
    if aside is None or binding is None or frame == binding.frame_of_reference:
        raise TakingError("No slice was set aside for a different frame of reference.")
    whose = Identity(binding.patient, str(aside.header["study_instance_uid"]), frame)
    record.append_event(ACCEPTED, event_body(whose), source=_SOURCE, who=who)
