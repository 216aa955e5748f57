"""What an emulated controller is busy with: a run of microsteps, the position loop, a log.

Only arithmetic over time: how many microsteps a tick brings. The controller drives its motor.
"""

import math
from dataclasses import dataclass, field

from robot_bridge.emulator import settings as y
from robot_bridge.emulator.settings import EmulatedSettings
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP, SPEED_PARAMETER_PER_COUNT

LOG_POSITIONS_MAX = 100


@dataclass
class OpenRun:
    """A run of microsteps without regard to the encoder."""

    remaining: int  # microsteps, unsigned
    direction: int
    frequency_hz: float
    until_index: bool = False
    script: bool = False
    due: float = 0.0  # microsteps, fraction carried between ticks

    def advance(self, speed_hz: float, tick_s: float) -> int:
        """The microsteps of this tick, signed."""
        self.due += speed_hz * MICROSTEPS_PER_STEP * tick_s
        microsteps = min(int(self.due), self.remaining)
        self.due -= microsteps
        self.remaining -= microsteps
        return self.direction * microsteps


@dataclass
class TargetRun:
    """The position loop; it stays on after arrival until something ends it."""

    target_count: int
    start_count: int
    speed_hz: float
    frequency_hz: float = 0.0
    timer_s: float = 0.0
    reached: bool = False
    idle: bool = False  # stands inside the stop range, or at a target limit
    due: float = 0.0

    def arrive(self) -> None:
        self.reached = self.idle = True
        self.frequency_hz = self.due = 0.0

    def beyond_limit(self, count: int, settings: EmulatedSettings) -> bool:
        """Beyond a target limit, and not on the way back from there."""
        error, outwards = self.target_count - count, count - self.start_count
        if count >= settings[y.LIMIT_B]:
            return error > 0 or outwards > 0
        return count <= settings[y.LIMIT_A] and (error < 0 or outwards < 0)

    def regulate(
        self, error: int, settings: EmulatedSettings, ceiling_hz: float, tick_s: float
    ) -> int:
        """The microsteps of this tick, signed, towards a target that is `error` counts away."""
        gain = settings[y.STEPS_PER_COUNT] / SPEED_PARAMETER_PER_COUNT  # microsteps a count
        remaining = abs(error) * gain
        self.frequency_hz = self._ramped_hz(
            settings, ceiling_hz, remaining / MICROSTEPS_PER_STEP, tick_s
        )
        self.due += min(self.frequency_hz * MICROSTEPS_PER_STEP * tick_s, remaining)
        microsteps = int(self.due)
        self.due -= microsteps
        return microsteps if error > 0 else -microsteps

    def _ramped_hz(
        self, settings: EmulatedSettings, ceiling_hz: float, remaining_steps: float, tick_s: float
    ) -> float:
        up_hz_s = settings[y.RAMP_UP] * 1000.0
        down_hz_s = settings[y.RAMP_DOWN] * 1000.0
        ramped = self.frequency_hz + up_hz_s * tick_s if up_hz_s else ceiling_hz
        braked = math.sqrt(2 * down_hz_s * remaining_steps) if down_hz_s else ceiling_hz
        floor = min(max(1, settings[y.MIN_SPEED]), ceiling_hz)
        return max(floor, min(ceiling_hz, ramped, braked))


@dataclass
class PositionLog:
    period_s: float
    started_at_ms: int
    positions: list[int] = field(default_factory=list)
    waited_s: float = 0.0

    def tick(self, tick_s: float, count: int) -> None:
        self.waited_s += tick_s
        if self.waited_s + 1e-9 >= self.period_s and len(self.positions) < LOG_POSITIONS_MAX:
            self.waited_s = 0.0
            self.positions.append(count)
