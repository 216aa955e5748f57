"""Whose slice is it? The first used slice binds a case to patient, study, frame of reference.

Slices of another patient, study or frame of reference never count in this case. A person may say
that a further study belongs to it (the technologist began another one for the same patient), or
that a new frame of reference is the one from now on (the table was moved): what rested on the
former one is void then. Pure: no file, no record.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from dicom_slice.header import Slice
from dicom_slice.reasons import Reason, SetAside

BOUND, ACCEPTED = "case_bound", "study_accepted"


@dataclass(frozen=True)
class Binding:
    """What a case is bound to; `patient` tells patients apart, names nobody; empty: not known."""

    patient: str
    studies: frozenset[str]
    frame_of_reference: str

    @classmethod
    def of_slice(cls, slice_: Slice) -> Binding:
        return cls(
            slice_.patient_digest,
            frozenset({slice_.study_instance_uid}),
            slice_.frame_of_reference_uid,
        )

    def with_study(self, study: str, frame_of_reference: str) -> Binding:
        """A person says that this study belongs to the case, too; its frame of reference holds."""
        return replace(self, studies=self.studies | {study}, frame_of_reference=frame_of_reference)


def why_not_of(binding: Binding | None, slice_: Slice) -> SetAside | None:
    """Why the slice does not belong to what is bound, or None. An unbound case takes any."""
    if binding is None:
        return None
    if _differ(binding.patient, slice_.patient_digest):
        return SetAside(Reason.OTHER_PATIENT, "it is of another patient than this case")
    if slice_.study_instance_uid not in binding.studies:
        return SetAside(Reason.OTHER_STUDY, "it is of another study than this case")
    if _differ(binding.frame_of_reference, slice_.frame_of_reference_uid):
        return SetAside(
            Reason.OTHER_FRAME,
            "its frame of reference is another one: the table or the patient was moved",
        )
    return None


def _differ(bound: str, found: str) -> bool:
    """A slice that does not say is no other one; the study still has to agree."""
    return bool(bound) and bool(found) and bound != found


def binding_of(bodies: Iterable[tuple[str, Mapping[str, Any]]]) -> Binding | None:
    """The binding as the events of a case tell it: (kind, body), oldest first."""
    binding = None
    for kind, body in bodies:
        if kind == BOUND:
            binding = Binding(
                body["patient"], frozenset({body["study"]}), body["frame_of_reference"]
            )
        elif kind == ACCEPTED and binding is not None:
            binding = binding.with_study(body["study"], body["frame_of_reference"])
    return binding


def bound_body(slice_: Slice) -> dict[str, Any]:
    """What the event of the first used slice says."""
    return {
        "patient": slice_.patient_digest,
        "study": slice_.study_instance_uid,
        "frame_of_reference": slice_.frame_of_reference_uid,
    }
