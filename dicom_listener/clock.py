"""How far the scanner's clock is from ours: an interval that never pretends to know more.

offset_s = our wall clock - the scanner's clock, at the same instant. A slice is received after its
acquisition ended, so every one of them gives an upper bound: receipt - end. The promptest of them
came within `prompt_delay_s` of its end, which gives the lower bound. An explicit sync narrows both.

The smallest lag is kept for as long as the case lasts and never rises by itself: an offset believed
too small makes acquisitions look earlier than they were, and those are refused, not misplaced.
"""

from dataclasses import dataclass, replace

from dicom_listener.times import AcquisitionInterval


@dataclass(frozen=True)
class ClockRules:
    """prompt_delay_s: the promptest slice of a session is here that soon after its acquisition.

    late_limit_s: a slice that seems to come later than this shows a clock that was set back, or a
    network that stood still, and nothing can tell which. drift_ppm widens an old sync.
    """

    prompt_delay_s: float = 3.0
    late_limit_s: float = 120.0
    jump_tolerance_s: float = 0.5
    drift_ppm: float = 50.0


@dataclass(frozen=True)
class Sync:
    """An explicit comparison of the two clocks, made at `at_s` (ours)."""

    offset_s: float
    uncertainty_s: float
    at_s: float


@dataclass(frozen=True)
class OffsetBounds:
    """The offset lies in [low_s, high_s]."""

    low_s: float
    high_s: float

    @property
    def middle_s(self) -> float:
        return (self.low_s + self.high_s) / 2

    @property
    def uncertainty_s(self) -> float:
        return (self.high_s - self.low_s) / 2


@dataclass(frozen=True)
class ScannerClock:
    """What is known of one scanner's clock. Values only; `observe` makes the next one.

    smallest_lag_s: least (receipt - certain end, or start where the end is not certain).
    smallest_prompt_lag_s: least (receipt - latest possible end), for the lower bound.
    """

    sync: Sync | None = None
    smallest_lag_s: float | None = None
    smallest_prompt_lag_s: float | None = None

    def bounds(self, now_s: float, rules: ClockRules) -> OffsetBounds | None:
        """None while nothing bounds the offset from below."""
        lows, highs = [], []
        if self.sync is not None:
            age_s = abs(now_s - self.sync.at_s)
            half_s = self.sync.uncertainty_s + age_s * rules.drift_ppm * 1e-6
            lows.append(self.sync.offset_s - half_s)
            highs.append(self.sync.offset_s + half_s)
        if self.smallest_prompt_lag_s is not None:
            lows.append(self.smallest_prompt_lag_s - rules.prompt_delay_s)
        if self.smallest_lag_s is not None:
            highs.append(self.smallest_lag_s)
        if not lows or not highs:
            return None
        return OffsetBounds(min(max(lows), min(highs)), min(highs))


@dataclass(frozen=True)
class Observation:
    """The clock after a slice was seen, and the alarm that it gave, if any."""

    clock: ScannerClock
    jump: str = ""
    late: str = ""


def observe(
    clock: ScannerClock, interval: AcquisitionInterval, received_s: float, rules: ClockRules
) -> Observation:
    """Take one more slice into account.

    A lag below what the bounds allow is impossible unless the scanner's clock was set forward:
    everything known is dropped, and this slice is the first evidence of the new time.
    """
    certain_end_s = interval.start_s if _is_uncertain(interval) else interval.end_s
    assert certain_end_s is not None
    lag_s = received_s - certain_end_s
    prompt_lag_s = None if interval.end_s is None else received_s - interval.end_s
    bounds = clock.bounds(received_s, rules)
    if bounds is not None and lag_s < bounds.low_s - rules.jump_tolerance_s:
        fresh = ScannerClock(smallest_lag_s=lag_s, smallest_prompt_lag_s=prompt_lag_s)
        jumped_s = bounds.low_s - lag_s
        return Observation(fresh, jump=f"the scanner's clock went forward by {jumped_s:.1f} s")
    late = ""
    if bounds is not None and prompt_lag_s is not None:
        delay_s = prompt_lag_s - bounds.high_s
        if delay_s > rules.late_limit_s:
            late = f"received {delay_s:.1f} s after the acquisition, or its clock was set back"
    return Observation(
        replace(
            clock,
            smallest_lag_s=_least(clock.smallest_lag_s, lag_s),
            smallest_prompt_lag_s=_least(clock.smallest_prompt_lag_s, prompt_lag_s),
        ),
        late=late,
    )


def _is_uncertain(interval: AcquisitionInterval) -> bool:
    return interval.end_s is None or interval.estimated


def _least(known: float | None, new: float | None) -> float | None:
    if known is None or new is None:
        return new if known is None else known
    return min(known, new)
