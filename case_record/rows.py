"""What the case record holds, as frozen values.

Instants are seconds since the epoch (UTC) on the control room's wall clock unless a name says
otherwise. Setpoints and readbacks are integer micrometres by axis name. Pixel pairs are (row, col).

Every `seq` is a number in the one order of all that happened in the case: of two of them the larger
one is later, whatever the clocks say. 0: has not happened.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Case:
    case_uid: str
    name: str
    seed: int
    created_s: float


@dataclass(frozen=True)
class Event:
    event_id: int
    wall_s: float
    monotonic_s: float
    source: str
    who: str
    kind: str
    body: Mapping[str, Any]
    previous_hash: str
    hash: str
    seq: int = 0


@dataclass(frozen=True)
class Hold:
    """An interval in which the robot stands settled; `ended_at_s` None means: still standing.

    settled_monotonic_s: by the computer's clock that nobody sets; None in records of older
    programs. bridge: how the robot's bridge stood then.
    """

    hold_id: int
    set_id: int
    place: int
    setpoints_um: Mapping[str, int]
    readback_um: Mapping[str, int]
    shift_um: Mapping[str, int]
    shift_px: tuple[float, float]
    settled_at_s: float
    ended_at_s: float | None
    expected_slices: int
    begun_seq: int = 0
    settled_monotonic_s: float | None = None
    bridge: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class NewSlice:
    """A slice as the listener found it, before the record gives it an identity."""

    sop_instance_uid: str
    frame: int
    sha256: str
    path: str
    state: str
    hold_id: int | None
    reason_code: str
    reason: str
    received_s: float
    received_monotonic_s: float
    acquired_from_s: float | None
    acquired_to_s: float | None
    time_source: str
    header: Mapping[str, Any]
    decided_by: str = "listener"


@dataclass(frozen=True)
class SliceRow(NewSlice):
    slice_id: int = 0
    seq: int = 0


@dataclass(frozen=True)
class Measurement:
    """A request to localize the fiducial in the slices of some holds, and its result once there.

    `result` (state `done`) holds centre_px, covariance_px2, radius_px, snr, chi2_per_dof, n_frames,
    patient_mm, covariance_mm2, image (path) and more; see `sr_engine.worker`.
    """

    measurement_id: int
    state: str
    method: str
    hold_ids: tuple[int, ...]
    request: Mapping[str, Any]
    requested_s: float
    finished_s: float | None
    result: Mapping[str, Any] | None
    reason_code: str
    reason: str
    requested_seq: int = 0
    finished_seq: int = 0


@dataclass(frozen=True)
class Procedure:
    procedure_id: int
    name: str
    arguments: Mapping[str, Any]
    state: str
    result: Mapping[str, Any] | None
    started_s: float
    ended_s: float | None
    begun_seq: int = 0
    ended_seq: int = 0


@dataclass(frozen=True)
class Step:
    procedure_id: int
    number: int
    kind: str
    body: Mapping[str, Any]
    outcome: Mapping[str, Any] | None
    sent_s: float
    ended_s: float | None


@dataclass(frozen=True)
class Move:
    command_id: str
    measurement_id: int | None
    purpose: str
    setpoints_um: Mapping[str, int]
    state: str
    code: str
    text: str
    readback_um: Mapping[str, int] = field(default_factory=dict)
    sent_s: float = 0.0
    ended_s: float | None = None
    sent_seq: int = 0
    ended_seq: int = 0
