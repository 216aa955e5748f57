"""The service's end of the line to the bridge, pumped by one control thread.

The control loop that calls `pump` is what the bridge's deadman listens to: heartbeats leave only
from inside `pump` and the calls that block (`open`, `move`, ...), never from a thread of their own.
`request_stop` alone may be called from any thread.
"""

import secrets
import time
from collections.abc import Callable, Mapping, Sequence

from robot_bridge.client.client_motion import OnState, refused, see_through
from robot_bridge.client.client_values import (
    BridgeError,
    BridgeIdentity,
    BridgeStatus,
    IncompatibleError,
    LinkCounters,
    LinkLostError,
    MoveOutcome,
    RefusedError,
)
from robot_bridge.client.line import Line
from robot_bridge.client.session import Session
from robot_bridge.client.stopper import STOP_REPEAT_S, Stopper
from robot_bridge.protocol import messages
from robot_bridge.protocol.messages import (
    Code,
)
from robot_bridge.protocol.packing import SETPOINT_MAX_UM, MessageError
from robot_bridge.protocol.phases import WorkPhase
from robot_bridge.protocol.transport import SerialTransport, Transport

__all__ = [
    "BridgeClient",
    "BridgeError",
    "BridgeIdentity",
    "BridgeStatus",
    "IncompatibleError",
    "LinkCounters",
    "LinkLostError",
    "MoveOutcome",
    "RefusedError",
]

CLOSE_WAIT_S = 1.0


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
        open_transport: Callable[[], Transport] | None = None,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
        random_bits: Callable[[int], int] = secrets.randbits,
        stop_thread: bool = True,
    ) -> None:
        """The last five replace line, time and chance, for a client that lives in virtual time."""
        self._name = name
        self._clock = clock
        line = Line(
            url,
            open_transport or (lambda: SerialTransport(url, baud)),
            # STOP goes out even if another program has the line.
            open_transport or (lambda: SerialTransport(url, baud, exclusive=False)),
        )
        self._stopper = Stopper(line.write_stop, clock, random_bits, threaded=stop_thread)
        self._session = Session(
            line, self._stopper, name=name, heartbeat_s=heartbeat_s, deadman_s=deadman_s,
            clock=clock, pause=pause, random_bits=random_bits,
        )  # fmt: skip

    # --- session ------------------------------------------------------------------------------

    def open(self, timeout_s: float = 5.0) -> BridgeIdentity:
        """Open the port and a session (again). Raises LinkLostError or IncompatibleError.

        A session begins disarmed. Opening one ends any other and stops its motion.
        """
        return self._session.open(timeout_s)

    @property
    def is_open(self) -> bool:
        return self._session.is_open

    def close(self) -> None:
        """See a STOP through, disarm if possible, release the port. Idempotent."""
        try:
            until_s = self._clock() + CLOSE_WAIT_S
            while self.is_open and self._stopper.pending and self._clock() < until_s:
                self.pump(STOP_REPEAT_S)
            if self._session.is_armed:
                self._session.request(messages.Disarm(by=self._name))
        except BridgeError:
            pass  # the bridge's deadman does what the disarming would have done
        finally:
            self._stopper.close()
            self._session.close()

    # --- what the control loop calls ----------------------------------------------------------

    def pump(self, wait_s: float = 0.0) -> None:
        """Receive for `wait_s` and send what is due. Raises LinkLostError when the bridge is silent
        for longer than `deadman_s`, or says that the session ended.
        """
        self._session.pump(wait_s)

    @property
    def status(self) -> BridgeStatus:
        """The newest status. Raises LinkLostError before the first `open`."""
        return self._session.status

    @property
    def counters(self) -> LinkCounters:
        return self._session.counters

    # --- requests -----------------------------------------------------------------------------

    def arm(self, by: str) -> None:
        """Allow motion. Refused while a stop is latched (then `rearm`) or a fault stands."""
        self._refuse_while_stopping()
        seen_ms, stop_count = self._session.seen_ms(), self.status.stop_count
        self._ask(messages.Arm(by=by, stop_count=stop_count, seen_ms=seen_ms))

    def disarm(self, by: str) -> None:
        """Forbid motion; a running one is stopped. Always accepted."""
        self._ask(messages.Disarm(by=by))

    def rearm(self, by: str) -> None:
        """Operator only: clear the latched stop that `status` shows, and arm. Phase: START_UP."""
        self._refuse_while_stopping()
        seen_ms, stop_count = self._session.seen_ms(), self.status.stop_count
        self._ask(messages.Rearm(by=by, stop_count=stop_count, seen_ms=seen_ms))

    def set_phase(self, phase: WorkPhase, by: str) -> None:
        """Change the work phase as phases.ALLOWED allows; refused during a motion."""
        self._ask(messages.SetPhase(phase=str(phase), by=by, seen_ms=self._session.seen_ms()))

    def set_insertion_lock(self, locked: bool, by: str) -> None:
        """Lock before READY, unlock when the needle is out. Locking stops a running motion."""
        self._ask(messages.SetInsertionLock(locked=locked, by=by, seen_ms=self._session.seen_ms()))

    def declare_position(
        self,
        positions_um: Mapping[str, int],
        by: str,
        within_um: Mapping[str, int] | None = None,
    ) -> None:
        """The named axes, and no others, stand there, give or take `within_um`; certain afterwards.

        Without a bound the word counts as exact, unless it only repeats what `status` remembers.
        """
        self._ask(
            messages.DeclarePosition(
                positions_um=_checked_um(positions_um),
                by=by,
                seen_ms=self._session.seen_ms(),
                within_um=_checked_um(within_um or {}),
            )
        )
        self._session.known_motion = self.status.last_motion

    def set_drives(self, on: bool, by: str) -> None:
        """Power of all motors; `status.parked` follows. A move puts it on by itself."""
        self._ask(messages.SetDrives(on=on, by=by, seen_ms=self._session.seen_ms()))

    def correct_position(
        self,
        correction_um: Mapping[str, int],
        within_um: Mapping[str, int],
        *,
        based_on_motion: str | None = None,
    ) -> None:
        """Images say that axes stand `correction_um` beyond their count, give or take `within_um`.

        Counts and setpoints stay what they are; only the travel that is left changes.
        based_on_motion: `last_motion` when that was seen (default: the last one known here).
        """
        known = self._session.known_motion
        self._ask(
            messages.CorrectPosition(
                correction_um=_checked_um(correction_um),
                within_um=_checked_um(within_um),
                based_on_motion=known if based_on_motion is None else based_on_motion,
                seen_ms=self._session.seen_ms(),
            )
        )

    def _ask(self, request: messages.Message) -> None:
        """A request that is done or refused at once; afterwards `status` shows its effect."""
        try:
            answer = self._session.request(request)
        except MessageError as error:
            raise RefusedError(Code.MALFORMED, str(error)) from error
        self._session.refresh()
        if answer.code != Code.OK:
            raise RefusedError(answer.code, answer.text)

    def move(
        self,
        command_id: str,
        setpoints_um: Mapping[str, int],
        measurement_id: str | None,
        on_state: OnState | None = None,
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
        try:
            setpoints = _checked_um(setpoints_um)
        except RefusedError as error:
            return refused(command_id, error.code, error.text)
        known = self._session.known_motion
        request = messages.Move(
            command_id=command_id,
            setpoints_um=setpoints,
            measurement_id=measurement_id,
            based_on_motion=known if based_on_motion is None else based_on_motion,
            seen_ms=self._session.seen_ms(),
        )
        return see_through(self._session, request, self.pump, on_state)

    def home(self, command_id: str, by: str, axes: Sequence[str] = ()) -> MoveOutcome:
        """Search the references of these axes (none named: all), which are certain afterwards.

        Blocks like `move`.
        """
        request = messages.Home(
            command_id=command_id, by=by, seen_ms=self._session.seen_ms(), axes=tuple(axes)
        )
        return see_through(self._session, request, self.pump, None)

    # --- STOP ---------------------------------------------------------------------------------

    def request_stop(self, *, emergency: bool = False, nonce: int | None = None) -> None:
        """From any thread, with or without a session: send STOP now and repeat it until the bridge
        acknowledged it. EMERGENCY also parks the drives. Returns at once.

        nonce: of a STOP that was sent already by another way.
        """
        self._stopper.request(emergency, nonce)

    @property
    def stop_acknowledged(self) -> bool:
        """Whether every stop that was requested has been acknowledged."""
        return not self._stopper.pending

    def _refuse_while_stopping(self) -> None:
        if self._stopper.pending:
            raise RefusedError(
                Code.STOP_LATCHED, "a STOP is on its way; re-arm once it has arrived"
            )


def _checked_um(positions_um: Mapping[str, int]) -> dict[str, int]:
    """Whole micrometres that fit the wire. Raises RefusedError (NaN, floats, huge numbers)."""
    for axis, value in positions_um.items():
        if type(value) is not int or not abs(value) <= SETPOINT_MAX_UM:
            text = (
                f"axis {str(axis)[:40]!r}: {str(value)[:40]} is not a whole number of um in range"
            )
            raise RefusedError(Code.MALFORMED, text)
    return dict(positions_um)
