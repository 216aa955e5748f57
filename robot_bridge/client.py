"""The service's end of the line to the bridge, pumped by one control thread.

The control loop that calls `pump` is what the bridge's deadman listens to: heartbeats leave only
from inside `pump` and the calls that block (`open`, `move`, ...), never from a thread of their own.
`request_stop` alone may be called from any thread.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robot_bridge.messages import AxisTravel, CommandState
from robot_bridge.phases import WorkPhase


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


class BridgeClient:
    """One session after the other over one line. Not thread-safe except `request_stop`."""

    def __init__(
        self,
        url: str,
        *,
        name: str = "service",
        baud: int = 115200,
        heartbeat_s: float = 0.2,
        deadman_s: float = 1.0,
    ) -> None: ...

    def open(self, timeout_s: float = 5.0) -> Hello:
        """Open the port and a session (again). Raises LinkLostError or IncompatibleError.

        A session begins disarmed. Opening one ends any other and stops its motion.
        """
        raise NotImplementedError

    def pump(self, wait_s: float = 0.0) -> None:
        """Receive for `wait_s` and send what is due. Raises LinkLostError when the bridge is silent
        for longer than `deadman_s`, or says that the session ended.
        """
        raise NotImplementedError

    @property
    def status(self) -> BridgeStatus:
        """The newest status. Raises LinkLostError before the first `open`."""
        raise NotImplementedError

    @property
    def is_open(self) -> bool:
        raise NotImplementedError

    @property
    def counters(self) -> LinkCounters:
        raise NotImplementedError

    def arm(self, by: str) -> None:
        """Allow motion. Refused while a stop is latched (then `rearm`) or a fault stands."""
        raise NotImplementedError

    def disarm(self, by: str) -> None:
        """Forbid motion; a running one is stopped. Always accepted."""
        raise NotImplementedError

    def rearm(self, by: str) -> None:
        """Operator only: clear the latched stop that `status` shows, and arm. Phase: START_UP."""
        raise NotImplementedError

    def set_phase(self, phase: WorkPhase, by: str) -> None:
        """Change the work phase as phases.ALLOWED allows; refused during a motion."""
        raise NotImplementedError

    def set_insertion_lock(self, locked: bool, by: str) -> None:
        """Lock before READY, unlock when the needle is out. Locking stops a running motion."""
        raise NotImplementedError

    def move(
        self,
        command_id: str,
        setpoints_um: Mapping[str, int],
        measurement_id: str | None,
        on_state: Callable[[CommandState, BridgeStatus], None] | None = None,
        *,
        based_on_motion: str | None = None,
    ) -> MoveOutcome:
        """Move all axes to absolute setpoints; block, pumping, until the command has ended.

        command_id is unique for ever: asking again for one that the bridge knows answers from its
        journal and moves nothing. measurement_id: the measurement that the plan rests on (None for
        moves that rest on none); a measurement is outdated once a motion rested on it.
        based_on_motion: `last_motion` as it stood when that measurement was taken (default: the
        last motion this client knows of); the bridge refuses the move if anything moved since.

        Returns the final outcome, refusals included. Raises LinkLostError if the link is lost
        first: open() again, then ask for the same command_id.
        """
        raise NotImplementedError

    def home(self, command_id: str, by: str) -> MoveOutcome:
        """Search the axes' references; afterwards positions are certain. Blocks like `move`."""
        raise NotImplementedError

    def declare_position(self, positions_um: Mapping[str, int], by: str) -> None:
        """The robot stands at these positions (measured); positions are certain afterwards."""
        raise NotImplementedError

    def request_stop(self, *, emergency: bool = False) -> None:
        """From any thread, with or without a session: send STOP now and repeat it until the bridge
        acknowledged it. EMERGENCY also parks the drives. Returns at once.
        """
        raise NotImplementedError

    @property
    def stop_acknowledged(self) -> bool:
        """Whether every stop that was requested has been acknowledged."""
        raise NotImplementedError

    def close(self) -> None:
        """Disarm if possible, release the port. Idempotent."""
        raise NotImplementedError
