"""Whose slice is it? The first used slice binds a case to patient, study, frame of reference.

Slices of another patient, study or frame of reference never count in this case. A person may say
that a further study belongs to it (the technologist began another one for the same patient), or
that a new frame of reference is the one from now on (the table was moved): what rested on the
former one is void then. Pure: no file, no record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dicom_slice.patient import Identity
from dicom_slice.reasons import Reason, SetAside

BOUND, ACCEPTED = "case_bound", "study_accepted"
# a slice that waits outside of the case; of another case's study it is said whether it may be of
# this patient
HELD, SAME_PATIENT = "slice_held", "same_patient"


@dataclass(frozen=True)
class Binding:
    """What a case is bound to; `patient` tells patients apart, names nobody; empty: not known."""

    patient: str
    studies: frozenset[str]
    frame_of_reference: str

    @classmethod
    def to(cls, whose: Identity) -> Binding:
        return cls(whose.patient, frozenset({whose.study}), whose.frame_of_reference)

    def with_study(self, whose: Identity) -> Binding:
        """A person says that this study belongs to the case, too; its frame of reference holds."""
        return replace(
            self,
            studies=self.studies | {whose.study},
            frame_of_reference=whose.frame_of_reference,
        )


def after_event(binding: Binding | None, kind: str, body: Mapping[str, Any]) -> Binding | None:
    """The binding after an event of the case, which may be of any kind."""
    if kind == BOUND:
        return Binding.to(_identity(body))
    if kind == ACCEPTED and binding is not None:
        return binding.with_study(_identity(body))
    return binding


def event_body(whose: Identity) -> dict[str, Any]:
    """What an event that binds, or accepts a study, says."""
    return {
        "patient": whose.patient,
        "study": whose.study,
        "frame_of_reference": whose.frame_of_reference,
    }


def _identity(body: Mapping[str, Any]) -> Identity:
    return Identity(body["patient"], body["study"], body["frame_of_reference"])


def why_not_of(binding: Binding | None, whose: Identity) -> SetAside | None:
    """Why a slice does not belong to what is bound, or None. An unbound case takes any."""
    if binding is None:
        return None
    if _differ(binding.patient, whose.patient):
        return SetAside(Reason.OTHER_PATIENT, "it belongs to a different patient")
    if whose.study not in binding.studies:
        return SetAside(Reason.OTHER_STUDY, "it belongs to a different study")
    if _differ(binding.frame_of_reference, whose.frame_of_reference):
        return SetAside(
            Reason.OTHER_FRAME,
            "it has a different frame of reference: the table or the patient was moved",
        )
    return None


def may_be_same_patient(binding: Binding | None, whose: Identity) -> bool:
    """False only where both are known, and are two."""
    return binding is not None and not _differ(binding.patient, whose.patient)


def _differ(bound: str, found: str) -> bool:
    """A slice that does not say is no other one; the study still has to agree."""
    return bool(bound) and bool(found) and bound != found
