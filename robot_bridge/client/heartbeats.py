"""When the client sends its next heartbeat, and for how long the bridge has been silent.

`now_s` is the client's monotonic clock.
"""

MOTION_HEARTBEAT_S = 0.05


class Heartbeats:
    """`hastily`: a motion is watched, so beat faster."""

    def __init__(self, heartbeat_s: float) -> None:
        self.hastily = False
        self._heartbeat_s = heartbeat_s
        self._sent_s = 0.0
        self._waiting_since_s: float | None = None

    @property
    def period_s(self) -> float:
        return min(self._heartbeat_s, MOTION_HEARTBEAT_S) if self.hastily else self._heartbeat_s

    def due(self, now_s: float, *, awaits_answer: bool) -> bool:
        # While the bridge may be speaking, wait; but not for ever, it must hear from us.
        patience_s = 2 * self._heartbeat_s if awaits_answer else self.period_s
        return now_s - self._sent_s >= patience_s

    def sent(self, now_s: float) -> None:
        self._sent_s = now_s

    def hurry(self) -> None:
        """The next one is due at once."""
        self._sent_s = -1e9

    # How long we have waited

    def wait_from(self, now_s: float) -> None:
        """Something was sent that has to be answered; an older wait goes on."""
        if self._waiting_since_s is None:
            self._waiting_since_s = now_s

    def heard(self) -> None:
        self._waiting_since_s = None

    def silent_s(self, now_s: float) -> float:
        """0 while nothing is waited for."""
        return 0.0 if self._waiting_since_s is None else now_s - self._waiting_since_s
