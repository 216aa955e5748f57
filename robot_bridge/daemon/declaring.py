"""A declaration of positions, an axis or a few in every turn of the bridge's loop.

Each axis costs a handful of answers; four of them on a slow adapter would keep a STOP waiting for a
second. The request is answered when all are done.
"""

from collections.abc import Callable

from robot_bridge.daemon.bridge_journal import BridgeJournal
from robot_bridge.daemon.motion_in_flight import MotionInFlight
from robot_bridge.daemon.motor_watch import MotorWatch
from robot_bridge.protocol.messages import DeclarePosition

TURN_S = 0.05  # after that long no other axis is begun before the line was looked at
SETTING_UP_S = 1.5  # so long the polls may go on with setting up a board


class Declaring:
    """`under_way`: some of the named axes are still to be declared. `just_begun`: in this turn."""

    def __init__(
        self,
        motion: MotionInFlight,
        motors: MotorWatch,
        journal: BridgeJournal,
        clock: Callable[[], float],
    ) -> None:
        self._motion = motion
        self._motors = motors
        self._journal = journal
        self._clock = clock
        self._request: DeclarePosition | None = None
        self._left: list[str] = []
        self._begun_s = 0.0
        self.just_begun = False

    @property
    def under_way(self) -> bool:
        return bool(self._left)

    def begin(self, request: DeclarePosition) -> None:
        """Raises MotorError, JournalError; then it has ended."""
        self._request, self._left = request, list(request.positions_um)
        self._begun_s = self._clock()
        self.go_on()
        self.just_begun = True

    def go_on(self) -> None:
        """One turn. Raises like `begin`."""
        request, left = self._request, self._left
        assert request is not None
        if self._motors.status.setting_up and self._clock() < self._begun_s + SETTING_UP_S:
            return
        self._left = []  # what fails ends it
        until_s = self._clock() + TURN_S
        while left:
            axis, *left = left
            within_um = {axis: request.within_um[axis]} if axis in request.within_um else {}
            self._motion.declare_position({axis: request.positions_um[axis]}, within_um)
            if self._clock() >= until_s:
                break
        self._left = left
        if not left:
            self._journal.note("declare", positions_um=request.positions_um, by=request.by)

    def give_up(self) -> list[str]:
        """The axes that were not declared."""
        left, self._left = self._left, []
        return left
