"""Whom a slice shows, told apart without keeping who they are."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from pathlib import Path

from pydicom import dcmread

from dicom_slice.elements import Elements

_DIGITS = 24
_TAGS = (
    "PatientID",
    "IssuerOfPatientID",
    "PatientName",
    "PatientBirthDate",
    "StudyInstanceUID",
    "FrameOfReferenceUID",
)


@dataclass(frozen=True)
class Identity:
    """Patient (a digest), study and frame of reference; empty: the header does not say."""

    patient: str = ""
    study: str = ""
    frame_of_reference: str = ""


def patient_digest(top: Elements) -> str:
    """Of the patient's number and who issued it; of name and birth date where there is none.

    Empty where the header names nobody. The same patient gives the same digest in every study.
    """
    number = top.text("PatientID")
    said = ("id", top.text("IssuerOfPatientID"), number)
    if not number:
        # a PersonName is no list of texts, though it can be gone through like one
        name = str(top.raw("PatientName") or "").strip(" ^\0").upper()
        if not name:
            return ""
        said = ("name", name, top.text("PatientBirthDate"))
    return hashlib.sha256("\0".join(said).encode()).hexdigest()[:_DIGITS]


def identity_of(path: Path) -> Identity:
    """Of any DICOM file, whatever else is wrong with it; empty where even that cannot be read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data_set = dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
            top = Elements(data_set)
            return Identity(
                patient_digest(top), top.text("StudyInstanceUID"), top.text("FrameOfReferenceUID")
            )
    except Exception:  # whatever pydicom raises for a damaged file
        return Identity()
