"""Telling patients apart without keeping who they are."""

from __future__ import annotations

import hashlib

from dicom_slice.elements import Elements

_DIGITS = 24


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
