"""The service's hold on the bridge: keeps the session open, and walks the work phases."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import structlog

from robot_bridge.client.client import (
    BridgeClient,
    BridgeError,
    BridgeStatus,
    LinkLostError,
    MoveOutcome,
)
from robot_bridge.protocol.phases import ALLOWED, WorkPhase

_REOPEN_EVERY_S = 0.5
_OPEN_TIMEOUT_S = 0.5


class PumpedClient(BridgeClient):
    """Calls `while_moving` again and again while a motion blocks the loop that asked for it."""

    while_moving: Callable[[], None] = staticmethod(lambda: None)
    _in_motion = False

    def move(self, *args: Any, **kwargs: Any) -> MoveOutcome:
        self._in_motion = True
        try:
            return super().move(*args, **kwargs)
        finally:
            self._in_motion = False

    def pump(self, wait_s: float = 0.0) -> None:
        super().pump(wait_s)
        if self._in_motion:
            self.while_moving()


class RoomLink:
    """A bridge client that is opened again by itself when the line or the bridge was lost."""

    def __init__(self, client: PumpedClient, on_change: Callable[[str], None]) -> None:
        self.client = client
        self._on_change = on_change
        self._next_open_s = 0.0
        self.is_up = False
        self.problem = "not connected yet"
        self.travel_um: dict[str, tuple[int, int]] = {}

    @property
    def status(self) -> BridgeStatus | None:
        """The bridge as it last said it was, or None while there is no session."""
        return self.client.status if self.is_up else None

    @property
    def travel_left_um(self) -> dict[str, tuple[int, int]]:
        """By axis, the counts at which it is sure to be within its travel.

        A count is off by what images last said of it, and known to within a bound only. The bridge
        refuses counts beyond the travel, wherever they truly are.
        """
        status, left = self.status, dict(self.travel_um)
        for axis, bound_um in (status.bound_um if status else {}).items():
            if status and axis in left and axis in status.certain_axes:
                (low_um, high_um), off_um = left[axis], status.correction_um.get(axis, 0)
                least_um, most_um = low_um + bound_um - off_um, high_um - bound_um - off_um
                left[axis] = (max(low_um, least_um), min(high_um, most_um))
        return left

    def pump(self, wait_s: float) -> None:
        """Serve the line for `wait_s`; opens it again, at most twice a second, when it is down."""
        if not self.is_up and time.monotonic() >= self._next_open_s:
            self._open()
        if not self.is_up:
            time.sleep(wait_s)
            return
        try:
            self.client.pump(wait_s)
        except BridgeError as error:
            self.lost(error)
        except Exception as error:
            structlog.get_logger().exception("robot link")
            self.lost(error)

    def lost(self, error: Exception) -> None:
        """Note that the session is gone; the bridge stops the robot by itself."""
        self.is_up = False
        self.problem = str(error)
        self._next_open_s = time.monotonic() + _REOPEN_EVERY_S
        self._on_change(f"link lost: {error}")

    def _open(self) -> None:
        try:
            hello = self.client.open(_OPEN_TIMEOUT_S)
        except Exception as error:
            if not isinstance(error, BridgeError):
                structlog.get_logger().exception("robot link")
            if str(error) != self.problem:
                self._on_change(f"no link: {error}")
            self.problem = str(error)
            self._next_open_s = time.monotonic() + _REOPEN_EVERY_S
            return
        self.is_up = True
        self.problem = ""
        self.travel_um = {axis.name: (axis.min_um, axis.max_um) for axis in hello.axes}
        self._on_change(
            f"link up: bridge {hello.software}, boot {hello.boot_id}, "
            f"positions {'certain' if hello.position_certain else 'uncertain'}"
        )

    def enter_phase(self, wanted: WorkPhase, by: str) -> None:
        """Ask the bridge for every phase on the shortest allowed way to `wanted`.

        Raises RefusedError if the bridge refuses one, LinkLostError without a session.
        """
        status = self.status
        if status is None:
            raise LinkLostError(self.problem)
        for phase in phases_between(status.phase, wanted):
            self.client.set_phase(phase, by)


def phases_between(now: WorkPhase, wanted: WorkPhase) -> list[WorkPhase]:
    """Return the phases to ask for, in order, to come from one to the other; [] if there."""
    came_from: dict[WorkPhase, WorkPhase] = {now: now}
    open_ends = deque([now])
    while open_ends and wanted not in came_from:
        phase = open_ends.popleft()
        for following in sorted(ALLOWED[phase].to):
            if following not in came_from:
                came_from[following] = phase
                open_ends.append(following)
    if wanted not in came_from:
        return [wanted]  # no way: let the bridge refuse it and say why
    way: list[WorkPhase] = []
    while wanted != now:
        way.append(wanted)
        wanted = came_from[wanted]
    return way[::-1]
