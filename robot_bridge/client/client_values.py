"""What the client tells and raises."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from robot_bridge.protocol import messages
from robot_bridge.protocol.messages import AxisTravel, CommandState
from robot_bridge.protocol.phases import WorkPhase


class BridgeError(Exception):
    """Base of what the client raises."""


class LinkLostError(BridgeError):
    """The line cannot be opened, is silent, or its session ended: call `open` again.

    The bridge stops by itself. What became of a command in flight is learned by asking for the
    same command id after `open`.
    """


class IncompatibleError(BridgeError):
    """The bridge speaks another protocol or message schema."""


class RefusedError(BridgeError):
    """The bridge refused a request; `code` names the rule, `text` says what was wrong."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text


@dataclass(frozen=True)
class BridgeIdentity:
    """What the bridge said of itself when the session was opened."""

    axes: tuple[AxisTravel, ...]
    boot_id: str
    position_certain: bool
    last_motion: str
    protocol: int
    schema: str
    software: str
    boot_id_changed: bool


@dataclass(frozen=True)
class BridgeStatus:
    """The bridge as it last said it was, `age_s` seconds ago (field meanings: messages.Status)."""

    age_s: float
    phase: WorkPhase
    armed: bool
    stopped: bool
    stop_reason: str
    stop_count: int
    insertion_locked: bool
    moving: bool
    parked: bool
    positions_um: Mapping[str, int]
    position_certain: bool
    last_motion: str
    boot_id: str
    fault: str | None
    command_id: str | None
    command_state: CommandState | None
    command_code: str
    command_text: str
    refused: int
    certain_axes: tuple[str, ...] = ()
    bound_um: Mapping[str, int] = field(default_factory=dict)
    remembered_um: Mapping[str, int] = field(default_factory=dict)
    correction_um: Mapping[str, int] = field(default_factory=dict)
    motions: int = 0
    supply_mv: Mapping[str, int] = field(default_factory=dict)
    board_celsius: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class MoveOutcome:
    """How a command ended: DONE, REFUSED, STOPPED or FAILED, never anything in between.

    readback_um: where the axes stood when it ended ({} if it was refused).
    """

    command_id: str
    state: CommandState
    code: str
    text: str
    readback_um: Mapping[str, int]

    @property
    def done(self) -> bool:
        return self.state is CommandState.DONE


@dataclass(frozen=True)
class LinkCounters:
    """Since the client was made. round_trip_s is smoothed; None before the first answer."""

    frames_sent: int
    frames_received: int
    frames_bad: int
    frames_resent: int
    frames_stale: int
    own_echoes: int
    bridge_frames_bad: int
    bridge_refused: int
    sessions: int
    stops_sent: int
    round_trip_s: float | None


def _shared(message_kind: type[Any], kind: type[Any]) -> frozenset[str]:
    """The fields that a message and what the client tells have in common."""
    return frozenset(one.name for one in fields(message_kind)) & {one.name for one in fields(kind)}


_IN_HELLO = _shared(messages.Hello, BridgeIdentity)
_IN_STATUS = _shared(messages.Status, BridgeStatus)


def hello_of(hello: messages.Hello, changed: bool) -> BridgeIdentity:
    said = {name: getattr(hello, name) for name in _IN_HELLO}
    return BridgeIdentity(**said, boot_id_changed=changed)


def status_of(status: messages.Status, age_s: float) -> BridgeStatus:
    state = status.command_state
    said = {name: getattr(status, name) for name in _IN_STATUS}
    said["phase"] = WorkPhase(status.phase)
    said["command_state"] = CommandState(state) if state else None
    return BridgeStatus(age_s=age_s, **said)
