"""What is said of targets, measurements and cases when one looks back."""

from __future__ import annotations

from pydantic import BaseModel

PointMm = tuple[float, float, float]


class KnownTarget(BaseModel):
    """A target of the case; `number` is that of the event by which it was set."""

    number: int
    patient_mm: PointMm
    label: str
    in_water: bool
    current: bool
    set_s: float
    who: str
    approaches: list[int]


class MeasurementBody(BaseModel):
    """`error_mm` is the distance, in the image plane, to the target that was set at that time.

    by_hand: it rests on a slice that a person assigned against the listener.
    """

    measurement_id: int
    state: str
    method: str
    requested_s: float
    finished_s: float | None
    reason_code: str
    reason: str
    hold_ids: list[int]
    n_frames: int
    patient_mm: PointMm | None
    sigma_mm: float | None
    error_mm: float | None
    snr: float | None
    has_reconstruction: bool
    by_hand: bool = False


class CaseSummary(BaseModel):
    """One case folder beside the present one."""

    folder: str
    case_uid: str
    label: str
    created_s: float
    slices: int
    measurements: int
    punctures: int
    current: bool
