"""What allows a motion besides the insertion lock: the work phase, the arming, no latched stop.

Changed by the bridge alone; the lock is the journal's, the rules that weigh all of it are in
`rules`.
"""

from robot_bridge.daemon.journal import LatchedStop
from robot_bridge.protocol.messages import Code
from robot_bridge.protocol.phases import WorkPhase


class Arming:
    """A stop stays latched until an operator re-arms."""

    def __init__(self, stop: LatchedStop) -> None:
        """`stop`: the newest one in the journal."""
        self.phase = WorkPhase.START_UP
        self.armed = False
        self.stopped = stop.latched
        self.stop_reason = stop.code if stop.latched else ""
        self.stop_count = stop.number
        if self.stopped:  # a restart is no re-arm
            self.phase = WorkPhase.EMERGENCY if stop.emergency else WorkPhase.STOP

    def latch(self, code: Code, *, emergency: bool) -> LatchedStop:
        """An emergency stays one, whatever stops follow it. Returns what the journal keeps."""
        self.armed = False
        self.stopped = True
        self.stop_reason = code.value
        self.stop_count += 1
        emergency = emergency or self.phase is WorkPhase.EMERGENCY
        self.phase = WorkPhase.EMERGENCY if emergency else WorkPhase.STOP
        return LatchedStop(self.stop_count, code.value, emergency, True)

    def rearm(self, next_phase: WorkPhase) -> None:
        self.stopped = False
        self.stop_reason = ""
        self.phase = next_phase
        self.armed = True
