"""The messages between service and bridge: frozen records, packed as CBOR arrays.

No number on the wire is a float: positions are integer micrometres, times integer milliseconds,
so neither NaN nor infinity can be said. Packing and unpacking are strict: a field of another type,
a missing or an extra field is a MessageError. The order and the types of all fields make the
schema hash, which every frame's checksum covers.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any, ClassVar

import cbor2

PROTOCOL_VERSION = 1
TEXT_MAX = 240
NAME_MAX = 120
INT_MAX = 2**53
SETPOINT_MAX_UM = 2**31 - 1


class MessageError(ValueError):
    """The payload is not a message of this schema."""


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


# --- packing ----------------------------------------------------------------------------------


def _integer(value: Any) -> int:
    if type(value) is not int or not -INT_MAX <= value <= INT_MAX:
        raise MessageError(f"{value!r} is not an integer in range")
    return value


def _boolean(value: Any) -> bool:
    if type(value) is not bool:
        raise MessageError(f"{value!r} is not a boolean")
    return value


def _text(value: Any) -> str:
    if type(value) is not str or len(value) > TEXT_MAX:
        raise MessageError(f"{str(value)[:40]!r} is not text of at most {TEXT_MAX} characters")
    return value


def _text_or_none(value: Any) -> str | None:
    return None if value is None else _text(value)


def _positions(value: Any) -> dict[str, int]:
    if not isinstance(value, Mapping) or len(value) > 32:
        raise MessageError("positions are not a map of at most 32 axes")
    for axis, position_um in value.items():
        _text(axis)
        if type(position_um) is not int or not abs(position_um) <= SETPOINT_MAX_UM:
            raise MessageError(f"axis {axis[:40]}: {position_um!r} is not an integer micrometre")
    return dict(value)


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or len(value) > 32:
        raise MessageError("names are not a list of at most 32")
    return tuple(_text(name) for name in value)


def _axes(value: Any) -> tuple[AxisTravel, ...]:
    if not isinstance(value, list | tuple) or any(len(axis) != 4 for axis in value):
        raise MessageError("axes are not a list of (name, min, max, tolerance)")
    return tuple(
        AxisTravel(_text(n), _integer(lo), _integer(hi), _integer(tolerance))
        for n, lo, hi, tolerance in value
    )


_CHECKS: dict[Any, Callable[[Any], Any]] = {
    int: _integer,
    bool: _boolean,
    str: _text,
    str | None: _text_or_none,
    dict[str, int]: _positions,
    tuple[AxisTravel, ...]: _axes,
    tuple[str, ...]: _names,
}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and value and isinstance(value[0], str):
        return [str(name) for name in value]
    if isinstance(value, tuple):
        return [[axis.name, axis.min_um, axis.max_um, axis.tolerance_um] for axis in value]
    return str(value) if isinstance(value, StrEnum) else value


def pack(message: Message) -> bytes:
    """The CBOR payload. Raises MessageError if a field is not what the schema says."""
    plain = [_plain(getattr(message, column.name)) for column in fields(message)]
    for column, value in zip(fields(message), plain, strict=True):
        _checked(type(message), column.name, column.type, value)
    return cbor2.dumps(plain)


def unpack(kind: int, payload: bytes) -> Message:
    """The message of type `kind`. Raises MessageError for anything that is not exactly one."""
    cls = MESSAGES.get(kind)
    if cls is None:
        raise MessageError(f"message type 0x{kind:02x} is not known")
    try:
        values = cbor2.loads(payload)
    except Exception as error:  # cbor2 raises several unrelated types on bad input
        raise MessageError(f"{cls.__name__}: payload is not CBOR ({error})") from error
    names = fields(cls)
    if not isinstance(values, list) or len(values) != len(names):
        raise MessageError(f"{cls.__name__}: payload is not a list of {len(names)} fields")
    checked = [_checked(cls, f.name, f.type, v) for f, v in zip(names, values, strict=True)]
    return cls(*checked)


def _checked(cls: type[Message], name: str, kind: Any, value: Any) -> Any:
    try:
        return _CHECKS[kind](value)
    except MessageError as error:
        raise MessageError(f"{cls.__name__}.{name}: {error}") from None


def schema_text() -> str:
    """One line a message: type byte, name, fields in order with their types."""
    lines = [f"protocol {PROTOCOL_VERSION}"]
    for kind, cls in sorted(MESSAGES.items()):
        columns = ", ".join(f"{column.name}: {_type_name(column.type)}" for column in fields(cls))
        lines.append(f"0x{kind:02x} {cls.__name__}({columns})")
    return "\n".join(lines)


def _type_name(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


SCHEMA_HASH = hashlib.sha256(schema_text().encode()).digest()[:8]
SCHEMA = SCHEMA_HASH.hex()
