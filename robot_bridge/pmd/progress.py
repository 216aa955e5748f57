"""Whether an encoder follows its motor: over a short run, and on the way to a target."""

import math
from dataclasses import dataclass

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.setup import MIN_SPEED_HZ

# An encoder that shows no progress: far from the setpoint, where the motor runs fast, it is missed
# at once; near it the controller may well take its time.
STALL_WINDOW_S, FAR_WINDOW_S = 0.5, 0.15
FAR_TOLERANCES, LOOKS_MIN = 10, 4
STALE_S = 0.12
RUNAWAY_MARGIN_UM = 100.0
STAND_WINDOW_S, STANDS = 0.05, 0.2  # of the way that the motor's steps should make
# Of the way that the steps should make: load and frequency change a step by a quarter, and a wrong
# scale is most often one of two.
FOLLOWS = 0.6


def agrees(moved_um: float, distance_um: float) -> bool:
    """Whether an encoder's way fits the way that the motor's steps should have made."""
    return FOLLOWS < moved_um / distance_um < 1 / FOLLOWS


def disagreement(moved_um: float, distance_um: float) -> str:
    return (
        f"the motor moved {distance_um:+.0f} um by its steps but {moved_um:+.0f} um by the "
        "encoder: the encoder, its direction, counts_per_mm or the step lengths are wrong"
    )


@dataclass
class CutLeg:
    """A way in closed loop that was cut short; its encoder may have died since it last moved.

    at_um: where it was seen last; at_s: when it was seen to come nearer. way_um: the whole way.
    stale: no progress was seen for long. refuted: what the encoder says is not believed.
    """

    at_um: float
    at_s: float
    way_um: float
    speed_um_s: float
    stale: bool = False
    refuted: bool = False
    stood_s: float = math.inf  # it was seen to stand then

    def gone_um(self, now_um: float) -> float:
        return (now_um - self.at_um) * math.copysign(1.0, self.way_um)

    def unsure_um(self, now_um: float) -> float:
        """What it may have gone that the encoder did not see.

        A motor whose encoder is dead does not end at its target.
        """
        most_um = self.speed_um_s * (self.stood_s - self.at_s) if self.speed_um_s else 0.0
        if self.refuted:
            return abs(now_um - self.at_um) + max(most_um, abs(self.way_um))
        return max(0.0, most_um - self.gone_um(now_um))


class StandWatch:
    """Tells that an encoder no longer follows a run in open loop: at a hard stop, or dead."""

    def __init__(self, speed_um_s: float, jitter_um: float) -> None:
        self._speed_um_s, self._at_um, self._since_s = speed_um_s, 0.0, math.inf
        self._window_s = max(STAND_WINDOW_S, 4 * jitter_um / (STANDS * speed_um_s))

    def stands(self, at_um: float, now_s: float) -> bool:
        if math.isinf(self._since_s):  # before the first look it may not have begun
            self._at_um, self._since_s = at_um, now_s
        lasted_s = now_s - self._since_s
        if abs(at_um - self._at_um) > STANDS * self._speed_um_s * max(lasted_s, self._window_s):
            self._at_um, self._since_s = at_um, now_s
        return now_s - self._since_s > self._window_s


class ProgressWatch:
    """Tells a motor that does not come nearer (stalled, encoder lost) or runs away."""

    def __init__(self, config: AxisConfig, distance_um: float, now_s: float) -> None:
        self._best_um = self._last_um = distance_um
        self._best_s = self.best_look_s = self.last_look_s = now_s
        step_um = max(config.step_um_forward, config.step_um_reverse)
        self._nominal_um_s = config.speed_hz * step_um
        self._seen_um_s = 0.0
        self._looks = 0
        self._bound_um = distance_um + RUNAWAY_MARGIN_UM
        slowest_um_s = MIN_SPEED_HZ * config.step_um_forward
        self._resolution_s = 3 * pmd_units.um_per_count(config) / slowest_um_s
        self._far_um = FAR_TOLERANCES * config.tolerance_um

    def is_stale(self, now_s: float) -> bool:
        return now_s - self._best_s > STALE_S

    def is_away(self, error_um: float) -> bool:
        return error_um > self._bound_um

    @property
    def fastest_um_s(self) -> float:
        """Steps may be longer than set, and it may be ramping up."""
        return max(self._nominal_um_s, 1.5 * self._seen_um_s) / FOLLOWS

    def what_is_wrong(
        self, error_um: float, asked_s: float, now_s: float
    ) -> tuple[str, str] | None:
        """A code and a text, or None. asked_s: the encoder was asked not before."""
        self._looks += 1
        if asked_s > self.last_look_s:
            gone_um = abs(self._last_um - error_um)
            self._seen_um_s = max(self._seen_um_s, gone_um / (asked_s - self.last_look_s))
        self._last_um, self.last_look_s = error_um, asked_s
        if error_um < self._best_um:
            self._best_um, self._best_s, self._looks = error_um, now_s, 0
            self.best_look_s = asked_s
        if self.is_away(error_um):
            return "runaway", f"is moving away, {error_um:.0f} um from the setpoint"
        far = error_um > self._far_um and self._looks >= LOOKS_MIN
        window_s = (FAR_WINDOW_S if far else STALL_WINDOW_S) + self._resolution_s
        if now_s - self._best_s > window_s:
            return "stalled", f"stalled {error_um:.0f} um from the setpoint"
        return None
