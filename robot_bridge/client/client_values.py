"""What the client tells and raises."""

from collections.abc import Mapping
from dataclasses import dataclass, field

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
class Hello:
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


def hello_of(hello: messages.Hello, changed: bool) -> Hello:
    return Hello(
        axes=hello.axes,
        boot_id=hello.boot_id,
        position_certain=hello.position_certain,
        last_motion=hello.last_motion,
        protocol=hello.protocol,
        schema=hello.schema,
        software=hello.software,
        boot_id_changed=changed,
    )


def status_of(status: messages.Status, age_s: float) -> BridgeStatus:
    state = status.command_state
    return BridgeStatus(
        age_s=age_s,
        phase=WorkPhase(status.phase),
        armed=status.armed,
        stopped=status.stopped,
        stop_reason=status.stop_reason,
        stop_count=status.stop_count,
        insertion_locked=status.insertion_locked,
        moving=status.moving,
        parked=status.parked,
        positions_um=status.positions_um,
        position_certain=status.position_certain,
        last_motion=status.last_motion,
        boot_id=status.boot_id,
        fault=status.fault,
        command_id=status.command_id,
        command_state=CommandState(state) if state else None,
        command_code=status.command_code,
        command_text=status.command_text,
        refused=status.refused,
        certain_axes=status.certain_axes,
        bound_um=status.bound_um,
        remembered_um=status.remembered_um,
        correction_um=status.correction_um,
        motions=status.motions,
    )
