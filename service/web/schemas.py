"""What the API takes and gives, apart from the state."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.room.summaries import PointMm

_WHO = (
    "Who asks; recorded with the event. Where tokens are used, the token's name is recorded "
    "instead."
)


LONGEST_JOG_UM = 5000


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Ask(_Body):
    by: str = Field(default="operator", min_length=1, max_length=64, description=_WHO)


class FinishBody(Ask):
    park: bool = Field(default=False, description="True: also park the drives.")


class ResetBody(Ask):
    positions_um: dict[str, int] | None = Field(
        default=None,
        max_length=32,
        description="Positions of the axes whose position is uncertain, as someone has checked: "
        "as shown in robot.taken_um, or better.",
        examples=[{"xt": 5000, "yt": -3000}],
    )


class PointBody(Ask):
    """A point in the patient, LPS mm."""

    patient_mm: PointMm = Field(examples=[[12.0, -40.0, 7.5]])


class ProcedureBody(Ask):
    """Which degrees of freedom are driven."""

    guide: bool | None = Field(
        default=None,
        description="True: both fiducials and four axes; false: one fiducial and two axes; null: "
        "as the room is configured.",
    )


class TargetHereBody(Ask):
    """The place where the fiducial is now."""

    label: str = Field(default="", max_length=80)


class TargetBody(PointBody):
    """Where the fiducial is to be."""

    label: str = Field(default="", max_length=80)
    in_water: bool = Field(
        default=False,
        description="True: a point in tissue; the oil-water shift of the slices is corrected for.",
    )


class ReachAsk(PointBody):
    """A point that might become the target."""

    in_water: bool = False


class ReachBody(BaseModel):
    """Whether the robot could bring the guide there, and why not, or why nobody can tell."""

    verdict: Literal["within", "out", "unknown"]
    text: str


class TakeBody(Ask):
    """Take a proposal over; what only the operator can say must be said."""

    in_water: bool = Field(
        description="True: the target is a point in tissue; false: where the fiducial is to be."
    )
    label: str = Field(default="", max_length=80)


class AnswerBody(Ask):
    """The answer to the question that the state shows, named by its id."""

    question_id: str = Field(min_length=1, max_length=200)
    choice: str = Field(min_length=1, max_length=40, examples=["confirm"])
    plan_id: str | None = Field(
        default=None,
        max_length=200,
        description="The plan being confirmed; refused if it is not the one in question.",
    )


class PunctureBody(Ask):
    insertion_depth_mm: float | None = Field(default=None, ge=0, le=500, examples=[62.5])


class StopBody(_Body):
    """May be left out: a STOP needs no body."""

    model_config = ConfigDict(extra="ignore")
    by: str = Field(default="operator", max_length=200)
    emergency: bool = Field(default=False, description="True: also park the drives.")


class StopAnswer(BaseModel):
    """What became of a STOP by the time of the answer."""

    outcome: Literal["stopped", "on_its_way", "not_delivered"]


class JogBody(Ask):
    axis: str = Field(min_length=1, max_length=32, examples=["xt"])
    distance_um: int = Field(
        ge=-LONGEST_JOG_UM, le=LONGEST_JOG_UM, examples=[100], description="At most 5 mm."
    )


class CaseBody(Ask):
    """No patient's name: the record is exported as it is."""

    label: str = Field(default="", max_length=200, examples=["Facet joint L4/5 left"])
    operator: str = Field(default="", max_length=200)
    note: str = Field(default="", max_length=2000)


class CaseBegun(BaseModel):
    """The name of the case's folder."""

    folder: str


class StudyBody(Ask):
    study: str = Field(
        min_length=1,
        max_length=64,
        pattern=r"^[0-9.]+$",
        description="StudyInstanceUID of slices listed by /api/v1/holding.",
        examples=["1.2.826.0.1.3680043.8.498.1"],
    )


class SettingsBody(Ask):
    """Strategy and goal of the present case; the room's file bounds them."""

    strategy: str = Field(min_length=1, max_length=32, examples=["adaptive"])
    tolerance_mm: float = Field(gt=0, le=100, examples=[0.06])
    confidence: float = Field(gt=0.5, lt=1, examples=[0.95])
    most_slices: int = Field(ge=1, le=32, examples=[6], description="At one position.")


class ClockBody(Ask):
    """A comparison of the two clocks, made now: the room's minus the scanner's."""

    offset_s: float = Field(ge=-86_400 * 366, le=86_400 * 366, examples=[-37.2])
    uncertainty_s: float = Field(gt=0, le=60, examples=[0.5])


class AssignmentBody(Ask):
    """Overrule the listener: the slice belongs to this hold, or (null) to none."""

    hold_id: int | None = Field(ge=1, le=2**53, examples=[12])
    why: str = Field(default="", max_length=500)


class ReasonBody(Ask):
    why: str = Field(default="", max_length=500, examples=["the scan was cancelled"])


class HoldBody(Ask):
    hold_id: int = Field(ge=1, le=2**53)


class LoginBody(_Body):
    token: str = Field(min_length=1, max_length=200)


class Started(BaseModel):
    procedure_id: int


class SessionBody(BaseModel):
    """Who the caller is to the service; `csrf` goes into X-CSRF-Token where a cookie is used."""

    name: str
    role: Literal["viewer", "operator"]
    csrf: str
    needs_token: bool


class EventBody(BaseModel):
    event_id: int
    wall_s: float
    source: str
    who: str
    kind: str
    body: dict[str, Any]


class SliceBody(BaseModel):
    slice_id: int
    sop_instance_uid: str
    frame: int
    sha256: str
    state: str
    hold_id: int | None
    reason_code: str
    reason: str
    decided_by: str
    received_s: float
    acquired_from_s: float | None
    acquired_to_s: float | None
    time_source: str
    series_description: str
    geometry: dict[str, Any] | None
    offered_hold_id: int | None = Field(
        default=None,
        description="The hold to which a person may assign this slice.",
    )


class Health(BaseModel):
    """Every part, `ok` or what is wrong with it."""

    status: Literal["ok", "degraded"]
    parts: dict[str, str]
