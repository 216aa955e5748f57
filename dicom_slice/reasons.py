"""Every reason for which a slice is set aside, by name, and the error that carries one."""

from dataclasses import dataclass
from enum import StrEnum


class Reason(StrEnum):
    """Codes as they stand in the record, the API and the page."""

    # The file
    NOT_DICOM = "not_dicom"
    UNREADABLE = "unreadable"
    TOO_LARGE = "too_large"
    NOT_MR = "not_mr"
    NO_PIXELS = "no_pixels"
    UNDECODABLE = "undecodable_pixels"
    BLANK = "blank"
    COLOUR = "colour"
    NO_GEOMETRY = "no_geometry"
    BAD_GEOMETRY = "bad_geometry"
    UID_CONTRADICTION = "uid_contradiction"
    # The kind of image
    MOSAIC = "mosaic"
    PHASE = "phase"
    REAL = "real"
    IMAGINARY = "imaginary"
    NOT_MAGNITUDE = "not_magnitude"
    LOCALIZER = "localizer"
    SCREEN_SAVE = "screen_save"
    DERIVED = "derived"
    WRONG_ORIENTATION = "wrong_orientation"
    # The time
    NO_TIME = "no_acquisition_time"
    IMPLAUSIBLE_TIME = "implausible_time"
    FUTURE = "acquired_after_receipt"
    LATE = "late_or_clock_jump"
    CLOCK_UNKNOWN = "clock_unknown"
    # The hold
    NO_HOLD = "no_open_hold"
    RECEIVED_AFTER_HOLD = "received_after_hold"
    OUTSIDE_HOLD = "outside_hold"
    NOT_EXPECTED = "not_expected"
    AFTER_INCOMPLETE_HOLD = "may_belong_to_incomplete_hold"
    OUT_OF_ORDER = "acquisition_out_of_order"
    GEOMETRY_DIFFERS = "geometry_differs_from_set"
    DISTORTION_TWIN = "distortion_twin"
    NOT_CONFIRMED = "not_confirmed"
    # The identity
    UID_CONFLICT = "same_uid_other_bytes"
    REENCODED_COPY = "same_slice_other_encoding"
    OTHER_PATIENT = "other_patient"
    OTHER_STUDY = "other_study"
    OTHER_FRAME = "other_frame_of_reference"
    # Why it waits in the holding area, besides
    NO_CASE = "no_case_open"
    OTHER_CASE = "other_case"
    UNKNOWN_STUDY = "unknown_study"
    NO_SLICE_USED = "no_slice_used_yet"


@dataclass(frozen=True)
class SetAside:
    """Why a slice is not used: a code for machines, a line for people."""

    code: Reason
    text: str

    def __str__(self) -> str:
        return f"{self.code}: {self.text}"


class UnusableError(ValueError):
    """A file or frame from which no usable slice can be made."""

    def __init__(self, code: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = SetAside(code, text)
