"""The values in which `service.room.belief.describe` says what the system believes."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True)


class AxisBelief(_Frozen):
    """How an axis moves the fiducial: mm per mm of its setpoint, and the direction in the slice.

    angle_deg: from growing columns towards growing rows; column_mm: (row, col) mm per mm.
    """

    scale: float
    scale_sigma: float
    angle_deg: float
    column_mm: tuple[float, float]


class CalibrationBelief(_Frozen):
    at_s: float
    per_axis: dict[str, AxisBelief]


class GoalBelief(_Frozen):
    """When the approach says READY."""

    strategy: str
    tolerance_mm: float
    confidence: float
    most_slices: int


class HoldBelief(_Frozen):
    """The hold that stands: its place (from 1) in a shift set of `of` holds."""

    hold_id: int
    place: int
    of: int


class FiducialBelief(_Frozen):
    """Where a fiducial was last seen; name: `upper` or `lower` of two, else empty."""

    name: str
    measurement_id: int
    patient_mm: tuple[float, float, float]
    sigma_row_mm: float
    sigma_col_mm: float


class SettingsBounds(_Frozen):
    """What may be changed for the case: lowest and highest value."""

    strategies: list[str]
    tolerance_mm: tuple[float, float]
    confidence: tuple[float, float]
    most_slices: tuple[int, int]


class BeliefState(_Frozen):
    """What the system believes; made_of, why: for people."""

    calibration: CalibrationBelief | None
    goal: GoalBelief
    hold: HoldBelief | None
    fiducials: list[FiducialBelief]
    made_of: str
    why: str
    settings: SettingsBounds
