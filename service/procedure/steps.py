"""What a procedure may ask for, and what it gets back.

A procedure is a generator: it yields steps and receives outcomes, touches nothing itself, and draws
no random number that is not seeded by its arguments. Steps and outcomes are plain values with a
JSON form, so a recorded procedure can be fed its outcomes again and stands where it stood.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

from robot_bridge.protocol.phases import WorkPhase


@dataclass(frozen=True)
class MoveTo:
    """Go to absolute setpoints and settle: ends the hold before, begins a new one.

    shift_px is the displacement of the fiducial (row, col) that this place has from the reference
    of its shift set; rests_on names the measurement that the plan was made from, from_um where the
    robot stood then: elsewhere, or after a newer measurement, the plan is void. purpose is for
    people; phase: the work phase in which the bridge makes the move.
    """

    setpoints_um: Mapping[str, int]
    purpose: str
    rests_on: int | None = None
    new_set: bool = True
    place: int = 0
    shift_px: tuple[float, float] = (0.0, 0.0)
    shift_um: Mapping[str, int] = field(default_factory=dict)
    from_um: Mapping[str, int] | None = None
    phase: WorkPhase = WorkPhase.MOVE_TO_TARGET


@dataclass(frozen=True)
class Acquire:
    """Wait until `count` slices in all were acquired at the present hold.

    fresh: begin a new hold here first, without any motion, so that earlier slices do not count.
    slice_position_mm: where along the slice normal; None where the protocol has it. Slices at
    other positions do not count.
    """

    count: int
    fresh: bool = False
    slice_position_mm: float | None = None


@dataclass(frozen=True)
class HoldShift:
    """A hold, and the fiducial's displacement there (row, col) mm from the reference pose."""

    hold_id: int
    shift_mm: tuple[float, float]


@dataclass(frozen=True)
class Measure:
    """Localize the fiducial from all slices of the given holds.

    expected_plane_mm and gate_mm: where it must be (image plane), None when nothing is known.
    shift_sigma_mm: how far a hold may be from its shift, per axis (standard deviation).
    slice_position_mm: only slices at this place along their normal; None: all. template: method
    "template" learns the fiducial's image from these measurements. any_shape: what is no disc is
    found by its outline, roughly.
    """

    holds: tuple[HoldShift, ...]
    method: str
    expected_plane_mm: tuple[float, float] | None = None
    gate_mm: float | None = None
    shift_sigma_mm: float = 0.0
    slice_position_mm: float | None = None
    template: tuple[int, ...] = ()
    any_shape: bool = False


@dataclass(frozen=True)
class SeenBefore:
    """Where by its template the fiducial was in an earlier measurement, image plane mm."""

    measurement_id: int
    plane_mm: tuple[float, float]
    covariance_mm2: tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class AskOperator:
    """Wait for an answer: one of `choices`. `plan` is what CONFIRM MOVE would carry out."""

    question: str
    choices: tuple[str, ...]
    plan: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Moved:
    """How a move ended; `state` is DONE, STOPPED, REFUSED or FAILED, as the bridge says."""

    state: str
    code: str
    text: str
    hold_id: int
    readback_um: Mapping[str, int]


@dataclass(frozen=True)
class Acquired:
    hold_id: int
    count: int


@dataclass(frozen=True)
class Measured:
    """A measurement that succeeded (`reason_code` empty) or the reason why it did not.

    after_loss: a try before it, at the same place, did not find the fiducial. method: that
    answered. systematic_mm: std (row, col) of what is common to all places found so. own_mm: of
    that, how well the template's own place is known; views: of the measurements it is learnt from.
    common_mm: std of the part of covariance_mm2 that other looks do not average out.
    """

    measurement_id: int
    reason_code: str = ""
    reason: str = ""
    plane_mm: tuple[float, float] = (0.0, 0.0)
    covariance_mm2: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    plane: Mapping[str, Any] = field(default_factory=dict)
    frames: int = 0
    scan_s: float = 0.0
    after_loss: bool = False
    method: str = ""
    systematic_mm: tuple[float, float] = (0.0, 0.0)
    own_mm: tuple[float, float] = (0.0, 0.0)
    views: tuple[SeenBefore, ...] = ()
    common_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def ok(self) -> bool:
        return not self.reason_code


@dataclass(frozen=True)
class Answered:
    choice: str
    who: str


Step = MoveTo | Acquire | Measure | AskOperator
Outcome = Moved | Acquired | Measured | Answered
Result = TypeVar("Result")
ProcedureSteps = Generator[Step, Outcome, Result]
OneOutcome = TypeVar("OneOutcome", Moved, Acquired, Measured, Answered)

_OUTCOMES: dict[str, type[Outcome]] = {
    "MoveTo": Moved,
    "Acquire": Acquired,
    "Measure": Measured,
    "AskOperator": Answered,
}


def ask(step: Step, kind: type[OneOutcome]) -> ProcedureSteps[OneOutcome]:
    """Yield a step and return its outcome, which must be of the kind that belongs to the step."""
    outcome = yield step
    if not isinstance(outcome, kind):
        raise TypeError(f"{type(step).__name__} was answered by {type(outcome).__name__}")
    return outcome


def step_to_json(step: Step) -> tuple[str, dict[str, Any]]:
    return type(step).__name__, asdict(step)


def outcome_to_json(outcome: Outcome) -> dict[str, Any]:
    return asdict(outcome)


def seen_before(value: Mapping[str, Any]) -> SeenBefore:
    row, col = value["plane_mm"]
    (a, b), (c, d) = value["covariance_mm2"]
    return SeenBefore(value["measurement_id"], (row, col), ((a, b), (c, d)))


def outcome_from_json(kind: str, value: Mapping[str, Any]) -> Outcome:
    """Return the outcome of a step of this kind as it was recorded."""
    fields = dict(value)
    if kind == "Measure":
        first, second = fields["plane_mm"]
        fields["plane_mm"] = (first, second)
        (a, b), (c, d) = fields["covariance_mm2"]
        fields["covariance_mm2"] = ((a, b), (c, d))
        for name in ("systematic_mm", "own_mm", "common_mm"):
            fields[name] = tuple(fields.get(name, (0.0, 0.0)))
        fields["views"] = tuple(seen_before(view) for view in fields.get("views", ()))
    return _OUTCOMES[kind](**fields)
