"""Open-loop runs as the host sees them: how far a run has gone that was cut short.

A board counts microsteps within one waveform step only. But a run has one speed, so the time in
which it was seen to turn tells its length, between two bounds; and what a set speed really amounts
to is learned from runs that came to their end.
"""

import math
from dataclasses import dataclass, field

from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP

# The controller's state settles some milliseconds after a command (25 ms in public drivers).
SETTLE_S = 0.025
PACE_MARGIN = 0.01


@dataclass
class Run:
    """Microsteps are signed, forward positive. Times are the clock's, infinite if not known."""

    from_um: float
    microsteps: int
    speed_hz: int
    sent_s: float  # it has not begun before
    begun_by_s: float = math.inf
    turned_s: float = -math.inf  # it was seen to turn then
    stood_s: float = math.inf  # it was seen to stand then, and did not turn any more

    @property
    def duration_s(self) -> float:
        return abs(self.microsteps) / MICROSTEPS_PER_STEP / self.speed_hz

    def saw(self, turning: bool, asked_s: float, answered_s: float) -> None:
        """What an answer said that was asked for and came at these times."""
        if turning:
            self.begun_by_s = min(self.begun_by_s, answered_s)
            self.turned_s, self.stood_s = asked_s, math.inf
        else:
            self.stood_s = min(self.stood_s, answered_s)

    def lasted_s(self) -> tuple[float, float]:
        """At least, at most."""
        least_s = self.turned_s - self.begun_by_s - SETTLE_S
        most_s = self.stood_s - self.sent_s + SETTLE_S
        return (max(0.0, least_s) if math.isfinite(least_s) else 0.0), most_s


@dataclass
class Pace:
    """What a set speed amounts to: between which fractions of it the motor is seen to run."""

    speed_hz: int = 0
    slowest: float = 0.0
    fastest: float = field(default=math.inf)

    def learn(self, run: Run) -> None:
        """From a run that came to its end."""
        if run.speed_hz != self.speed_hz:
            self.speed_hz, self.slowest, self.fastest = run.speed_hz, 0.0, math.inf
        least_s, most_s = run.lasted_s()
        slowest = (1 - PACE_MARGIN) * run.duration_s / most_s
        fastest = (1 + PACE_MARGIN) * run.duration_s / least_s if least_s else math.inf
        if slowest > self.fastest or fastest < self.slowest:  # it is not always the same
            self.slowest, self.fastest = min(slowest, self.slowest), max(fastest, self.fastest)
        else:
            self.slowest, self.fastest = max(slowest, self.slowest), min(fastest, self.fastest)

    def microsteps_gone(self, run: Run) -> tuple[float, float]:
        """At least, at most, with the sign of the run."""
        slowest, fastest = 0.0, math.inf
        if run.speed_hz == self.speed_hz:
            slowest, fastest = self.slowest, self.fastest
        least_s, most_s = run.lasted_s()
        whole = abs(run.microsteps)
        rate = run.speed_hz * MICROSTEPS_PER_STEP
        sign = math.copysign(1.0, run.microsteps)
        return (
            sign * min(whole, slowest * rate * least_s),
            sign * min(whole, fastest * rate * most_s),
        )
