"""What the room is doing now, in one value: the page and the virtual scanner read it."""

from __future__ import annotations

import time
import uuid
from typing import Any

from pydantic import BaseModel, ConfigDict

from room_config.load import Config
from service.room.belief.state import BeliefState
from service.room.proposals import ProposalState


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True)


class RobotState(_Frozen):
    """The bridge as it last said it was; `linked` False: what follows is old.

    taken_um: where axes that are not certain are taken to stand, `taken_from` what; to be confirmed
    by whoever arms.
    """

    linked: bool = False
    problem: str = "not connected yet"
    phase: str = "START_UP"
    armed: bool = False
    stopped: bool = False
    stop_reason: str = ""
    insertion_locked: bool = False
    moving: bool = False
    position_certain: bool = False
    positions_um: dict[str, int] = {}
    travel_um: dict[str, tuple[int, int]] = {}
    fault: str | None = None
    boot_id: str = ""
    taken_um: dict[str, int] = {}
    taken_from: str = ""


class AcquisitionState(_Frozen):
    """What the scanner operator is asked to acquire now."""

    request_id: str
    hold_id: int
    count: int
    slice_position_mm: float | None = None


class QuestionState(_Frozen):
    question_id: str
    question: str
    choices: list[str]
    plan: dict[str, Any] | None


class LostState(_Frozen):
    """Why something does not hold any more: `code` for programs, `text` for people."""

    code: str
    text: str


class MeasurementState(_Frozen):
    """The newest finished measurement: positions in the slice and in the patient.

    lost: why it does not say any more where the fiducial is; age_s: since it was asked for;
    by_hand: it rests on a slice that a person assigned against the listener.
    """

    measurement_id: int
    method: str
    state: str
    finished_s: float | None
    reason: str = ""
    slice_id: int | None = None
    centre_px: tuple[float, float] | None = None
    sigma_px: tuple[float, float] | None = None
    radius_px: float | None = None
    radius_mm: float | None = None
    covariance_mm2: tuple[tuple[float, float], tuple[float, float]] | None = None
    patient_mm: tuple[float, float, float] | None = None
    n_frames: int = 0
    snr: float | None = None
    chi2_per_dof: float | None = None
    has_reconstruction: bool = False
    age_s: float | None = None
    lost: LostState | None = None
    by_hand: bool = False


class FiducialState(_Frozen):
    """The guide's other fiducial, where it was last seen (in another slice than the newest)."""

    measurement_id: int
    patient_mm: tuple[float, float, float]
    radius_mm: float
    lost: LostState | None = None


class ClockState(_Frozen):
    """How the scanner's clock goes: ours minus the scanner's, as compared at `compared_s`."""

    offset_s: float
    uncertainty_s: float
    compared_s: float | None = None
    who: str = ""


class ErrorState(_Frozen):
    """How far the fiducial is from the target, in the image plane (row, col) mm."""

    row_mm: float
    col_mm: float
    error_mm: float
    sigma_mm: float
    probability_within_tolerance: float
    target_px: tuple[float, float] | None = None


class ArrivalState(_Frozen):
    """READY: how the needle guide came to the target, and how sure that is; only while it holds.

    With two fiducials the error is that of the needle's tip, and the last fields say where it is:
    (row, col) in the image plane, depth below the lower ball joint, both points in patient LPS mm.
    """

    procedure_id: int
    measurement_id: int
    error_mm: float
    sigma_mm: float
    probability: float
    iterations: int
    frames: int
    scan_s: float
    tip_error_mm: tuple[float, float] | None = None
    tip_covariance_mm2: tuple[tuple[float, float], tuple[float, float]] | None = None
    tip_below_joint_mm: float | None = None
    tip_mm: tuple[float, float, float] | None = None
    joint_mm: tuple[float, float, float] | None = None
    age_s: float | None = None
    by_hand: bool = False


class DriveState(_Frozen):
    """What a calibration drives: one axis from where it stands, stop by stop."""

    axis: str
    stops_mm: tuple[float, ...]


class SliceState(_Frozen):
    """The slice to show, and where its pixels are in the patient (LPS mm)."""

    slice_id: int
    state: str
    received_s: float
    acquired_to_s: float | None = None
    time_source: str = ""
    shape: tuple[int, int]
    position_mm: tuple[float, float, float]
    row_direction: tuple[float, float, float]
    col_direction: tuple[float, float, float]
    spacing_mm: tuple[float, float]


class ReconstructionState(_Frozen):
    """The newest super-resolution image, where its fiducial is, and its geometry."""

    measurement_id: int
    factor: int
    patient_mm: tuple[float, float, float]
    radius_mm: float
    shape: tuple[int, int]
    position_mm: tuple[float, float, float]
    row_direction: tuple[float, float, float]
    col_direction: tuple[float, float, float]
    spacing_mm: tuple[float, float]


class HoldState(_Frozen):
    """Where the robot stands settled; None in the state while nothing stands."""

    hold_id: int
    set_id: int
    settled_at_s: float


class CaseState(_Frozen):
    """What the operator wrote down about the case."""

    label: str = ""
    operator: str = ""
    note: str = ""


class HeldState(_Frozen):
    """Slices of one study that wait in the holding area; of another patient's no more than that.

    study: empty where it is not to be shown, or not known. code, reason: of the newest one.
    """

    study: str = ""
    code: str
    reason: str
    description: str = ""
    slices: int
    first_received_s: float
    last_received_s: float
    may_be_taken: bool = False


class ProcessState(_Frozen):
    """One of the room's processes: `up`, `old` (hangs or is quiet), `down`, `none` (not seen)."""

    name: str
    condition: str
    detail: str = ""


class AlarmState(_Frozen):
    """Something that needs the operator. severity: `alarm` or `warning`."""

    code: str
    severity: str
    text: str
    what_to_do: str
    since_s: float


class RoomState(_Frozen):
    """Everything that a screen needs to show what is going on."""

    revision: int
    at_s: float
    room: str
    virtual: bool
    case_uid: str = ""
    case_folder: str | None = None
    cases_begin_here: bool = False
    case_question: str = ""
    holding: list[HeldState] = []
    procedure: str | None = None
    procedure_id: int | None = None
    last_outcome: str = ""
    last_failure: str | None = None
    prompt: str = ""
    ready: bool = False
    ready_lost: LostState | None = None
    ready_valid_s: float
    next_action: str = ""
    calibration_drives: list[DriveState] = []
    arrival: ArrivalState | None = None
    robot: RobotState = RobotState()
    acquisition_request: AcquisitionState | None = None
    question: QuestionState | None = None
    last_slice_id: int | None = None
    last_slice_received_s: float | None = None
    slices: dict[str, int] = {}
    measurement: MeasurementState | None = None
    calibrated: bool = False
    guide: bool = False
    target_patient_mm: tuple[float, float, float] | None = None
    target_lost: LostState | None = None
    error: ErrorState | None = None
    error_reason: str = ""
    tolerance_mm: float
    event_id: int = 0
    service_id: str = ""
    case: CaseState | None = None
    slice: SliceState | None = None
    reconstruction: ReconstructionState | None = None
    other_fiducial: FiducialState | None = None
    clock: ClockState | None = None
    clock_doubted: str = ""
    clock_implies: str = ""
    hold: HoldState | None = None
    entry_patient_mm: tuple[float, float, float] | None = None
    punctured: bool = False
    jog_possible: bool = False
    arrival_mode: bool = False
    camera_preview_url: str = ""
    processes: list[ProcessState] = []
    alarms: list[AlarmState] = []
    belief: BeliefState | None = None
    proposals: list[ProposalState] = []

    @classmethod
    def initial(cls, config: Config) -> RoomState:
        return cls(
            revision=0,
            at_s=time.time(),
            service_id=uuid.uuid4().hex,
            room=config.room.name,
            cases_begin_here=config.room.cases_dir is not None,
            virtual=config.room.virtual,
            arrival_mode=config.listener.arrival_mode,
            camera_preview_url=config.service.camera_preview_url,
            guide=config.service.guide is not None,
            ready_valid_s=config.service.ready_valid_s,
            tolerance_mm=(config.service.guide or config.service).tolerance_mm,
        )
