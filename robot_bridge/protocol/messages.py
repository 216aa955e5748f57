"""The messages between service and bridge: frozen records, packed as CBOR arrays (see packing).

No number on the wire is a float: positions are integer micrometres, times integer milliseconds,
so neither NaN nor infinity can be said. The order and the types of all fields make the schema.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar

PROTOCOL_VERSION = 1
TEXT_MAX = 240
NAME_MAX = 120


class CommandState(StrEnum):
    """ACCEPTED and RUNNING are on the way; the other four are final and never change."""

    ACCEPTED = "ACCEPTED"
    RUNNING = "RUNNING"
    DONE = "DONE"
    REFUSED = "REFUSED"
    STOPPED = "STOPPED"
    FAILED = "FAILED"

    @property
    def final(self) -> bool:
        return self not in (CommandState.ACCEPTED, CommandState.RUNNING)


class Code(StrEnum):
    """Why something was refused, stopped or failed. Texts explain, programs compare codes."""

    OK = "ok"
    # refusals
    MALFORMED = "malformed"
    SCHEMA_MISMATCH = "schema_mismatch"
    NO_SESSION = "no_session"
    STALE_COMMAND = "stale_command"
    NO_OPERATOR = "no_operator"
    STOP_LATCHED = "stop_latched"
    NOT_ARMED = "not_armed"
    WRONG_STOP = "wrong_stop"
    NOT_STOPPED = "not_stopped"
    WRONG_PHASE = "wrong_phase"
    PHASE_NOT_ALLOWED = "phase_not_allowed"
    INSERTION_LOCKED = "insertion_locked"
    UNKNOWN_AXIS = "unknown_axis"
    MISSING_AXIS = "missing_axis"
    BEYOND_TRAVEL = "beyond_travel"
    POSITION_UNCERTAIN = "position_uncertain"
    OUTDATED_MEASUREMENT = "outdated_measurement"
    MOTION_IN_FLIGHT = "motion_in_flight"
    COMMAND_ID_REUSED = "command_id_reused"
    MOTOR_FAULT = "motor_fault"
    JOURNAL = "journal"
    SHUTTING_DOWN = "shutting_down"
    # ends of a motion
    OPERATOR_STOP = "operator_stop"
    EMERGENCY_STOP = "emergency_stop"
    LINK_LOST = "link_lost"
    SESSION_ENDED = "session_ended"
    DISARMED = "disarmed"
    LOCKED_IN_MOTION = "locked_in_motion"
    MOTION_TIMEOUT = "motion_timeout"
    NOT_REACHED = "not_reached"
    BRIDGE_RESTARTED = "bridge_restarted"
    LOOP_STALLED = "loop_stalled"
    GUARDIAN_LOST = "guardian_lost"


@dataclass(frozen=True)
class AxisTravel:
    """An axis and its travel limits, both ends allowed, integer micrometres.

    tolerance_um: what two readings of an axis that stands may differ by; one that is asked to be
        where it stands, within this, is not moved.
    """

    name: str
    min_um: int
    max_um: int
    tolerance_um: int = 20


@dataclass(frozen=True)
class Message:
    """Base of all messages; `KIND` is the type byte of the frame (bit 7: from the bridge)."""

    KIND: ClassVar[int]


# --- service to bridge ------------------------------------------------------------------------


@dataclass(frozen=True)
class HelloRequest(Message):
    KIND = 0x01
    nonce: int
    name: str
    protocol: int
    schema: str


@dataclass(frozen=True)
class Heartbeat(Message):
    """Sent by the service's control loop. `seen_ms`: the newest bridge clock it has seen."""

    KIND = 0x02
    seen_ms: int


@dataclass(frozen=True)
class Arm(Message):
    KIND = 0x10
    by: str
    stop_count: int
    seen_ms: int


@dataclass(frozen=True)
class Disarm(Message):
    KIND = 0x11
    by: str


@dataclass(frozen=True)
class Rearm(Message):
    """Clears the latched stop number `stop_count`, no other."""

    KIND = 0x12
    by: str
    stop_count: int
    seen_ms: int


@dataclass(frozen=True)
class SetPhase(Message):
    KIND = 0x13
    phase: str
    by: str
    seen_ms: int


@dataclass(frozen=True)
class SetInsertionLock(Message):
    KIND = 0x14
    locked: bool
    by: str
    seen_ms: int


@dataclass(frozen=True)
class Move(Message):
    """Absolute setpoints of all axes. `based_on_motion`: the last motion the sender knows of."""

    KIND = 0x15
    command_id: str
    setpoints_um: dict[str, int]
    measurement_id: str | None
    based_on_motion: str
    seen_ms: int


@dataclass(frozen=True)
class Home(Message):
    """Of these axes; none named: all."""

    KIND = 0x16
    command_id: str
    by: str
    seen_ms: int
    axes: tuple[str, ...] = ()


@dataclass(frozen=True)
class DeclarePosition(Message):
    """The named axes, and no others, stand there, give or take `within_um`.

    Without a bound the word counts as exact, unless it only repeats what the bridge guessed.
    """

    KIND = 0x17
    positions_um: dict[str, int]
    by: str
    seen_ms: int
    within_um: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class CorrectPosition(Message):
    """What images say: the axis truly stands `correction_um` beyond its count, give or take
    `within_um`. Counts and setpoints stay what they are; only the travel that is left changes.
    `based_on_motion`: the last motion when that was seen.
    """

    KIND = 0x18
    correction_um: dict[str, int]
    within_um: dict[str, int]
    based_on_motion: str
    seen_ms: int


@dataclass(frozen=True)
class SetDrives(Message):
    """Power of the motors off (parked; they hold by friction) or on, for imaging."""

    KIND = 0x19
    on: bool
    by: str
    seen_ms: int


# --- bridge to service ------------------------------------------------------------------------


@dataclass(frozen=True)
class Hello(Message):
    """The bridge's answer to HelloRequest. `code` is "ok" or why there is no session."""

    KIND = 0x81
    nonce: int
    code: str
    text: str
    protocol: int
    schema: str
    software: str
    session: int
    boot_id: str
    now_ms: int
    axes: tuple[AxisTravel, ...]
    position_certain: bool
    last_motion: str


@dataclass(frozen=True)
class Status(Message):
    """The bridge as it stands at `now_ms` of its own clock (milliseconds since it booted).

    stop_count: the number of the newest stop (the journal counts them); `stopped`: it is latched.
    last_motion: names the last thing that changed where the robot stands (a command id, or
        "boot:…", "declared:…", "lost:…"); a move must be based on it.
    command_*: the command in flight, or the last one that ended.
    certain_axes: whose positions are known; `position_certain` says that all are.
    bound_um: of a certain axis, within how much of positions_um + correction_um it stands; of
        another one, within how much of remembered_um. An axis that is missing is simply unknown.
    remembered_um: where axes that are not certain stood when it was last known: a guess.
    correction_um: what images last said that the truth is beyond the count.
    motions: how many things since the boot have moved the robot, or may have: commands, parking,
        motions that nobody asked for.
    supply_mv, board_celsius: what each axis's controller measures of itself, where it tells.
    """

    KIND = 0x82
    now_ms: int
    boot_id: str
    phase: str
    armed: bool
    stopped: bool
    stop_reason: str
    stop_count: int
    insertion_locked: bool
    moving: bool
    parked: bool
    positions_um: dict[str, int]
    position_certain: bool
    last_motion: str
    fault: str | None
    command_id: str | None
    command_state: str | None
    command_code: str
    command_text: str
    command_readback_um: dict[str, int]
    frames_bad: int
    refused: int
    certain_axes: tuple[str, ...] = ()
    bound_um: dict[str, int] = field(default_factory=dict)
    remembered_um: dict[str, int] = field(default_factory=dict)
    correction_um: dict[str, int] = field(default_factory=dict)
    motions: int = 0
    supply_mv: dict[str, int] = field(default_factory=dict)
    board_celsius: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer(Message):
    """To every request but the first two kinds. `state` says how a command stands."""

    KIND = 0x83
    code: str
    text: str
    state: str | None
    readback_um: dict[str, int]


@dataclass(frozen=True)
class NoSession(Message):
    """The frame's session is not (or no longer) the bridge's."""

    KIND = 0x84
    boot_id: str


MESSAGES: dict[int, type[Message]] = {
    kind.KIND: kind
    for kind in (
        HelloRequest, Heartbeat, Arm, Disarm, Rearm, SetPhase, SetInsertionLock, Move, Home,
        DeclarePosition, CorrectPosition, SetDrives, Hello, Status, Answer, NoSession,
    )
}  # fmt: skip

FROM_BRIDGE = 0x80
# Checked with a checksum that leaves the schema out, so that two versions can tell they differ.
BOOTSTRAP_KINDS = frozenset({HelloRequest.KIND, Hello.KIND, NoSession.KIND})
