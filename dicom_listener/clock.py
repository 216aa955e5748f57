"""How far the scanner's clock is from ours: an interval that never pretends to know more.

offset_s = our wall clock - the scanner's clock, at the same instant. A slice is received after its
acquisition ended, so every one of them gives an upper bound: receipt - end. The promptest of them
came within `prompt_delay_s` of its end, which gives the lower bound. An explicit sync bounds the
offset before the first slice comes, and replaces what was known when a clock was set.

The smallest lag is kept for as long as the case lasts and never rises by itself: an offset believed
too small makes acquisitions look earlier than they were, and those are refused, not misplaced.
"""

from dataclasses import dataclass, replace

from dicom_slice.times import AcquisitionInterval

_DRIFT_SLICES = 10


@dataclass(frozen=True)
class ClockRules:
    """What is taken for granted about a scanner and its network.

    prompt_delay_s: the promptest slice of a session is here that soon after its acquisition.
    longest_acquisition_s: no acquisition that comes without its duration lasts longer.
    largest_offset_s: without a sync, a clock further off than this is not believed to be a clock:
    it is an old slice sent again.
    late_limit_s: a slice that seems to come later than this shows a clock that was set back, or a
    network that stood still, and nothing can tell which.
    drift_ppm: widens a sync as it ages.
    drift_alarm_s: how far the least lag of late may be from that of the beginning.
    """

    prompt_delay_s: float = 3.0
    longest_acquisition_s: float = 30.0
    largest_offset_s: float = 600.0
    late_limit_s: float = 120.0
    jump_tolerance_s: float = 0.5
    drift_ppm: float = 50.0
    drift_alarm_s: float = 1.0


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

    least_lag_s: least (receipt - end), with the start in place of an end that is not certain: the
    offset cannot be larger. least_prompt_lag_s: least (receipt - certain end), and
    least_loose_lag_s: the same over ends that are estimated or assumed: less the prompt delay, the
    offset cannot be smaller.
    """

    sync: Sync | None = None
    least_lag_s: float | None = None
    least_prompt_lag_s: float | None = None
    least_loose_lag_s: float | None = None

    def bounds_for(
        self, interval: AcquisitionInterval, received_s: float, rules: ClockRules
    ) -> OffsetBounds | None:
        """The interval in which the offset lies for this slice; None where evidence contradicts.

        A sync does not raise the lower bound above what the lags alone give, and the slice's own
        lag always counts: the clock may have gone forward since, by less than a slice takes to get
        here, and nothing else would show it.
        """
        low_s, high_s = self._believed(received_s, rules)
        lag_s = self.least_prompt_lag_s
        if lag_s is None:
            lag_s = self.least_loose_lag_s
        own_lag_s = received_s - latest_end_s(interval, rules)
        by_lag_s = (own_lag_s if lag_s is None else min(lag_s, own_lag_s)) - rules.prompt_delay_s
        low_s = max(low_s, by_lag_s) if self.sync is None else min(low_s, by_lag_s)
        if self.least_lag_s is not None:
            high_s = min(high_s, self.least_lag_s)
        if low_s > high_s + rules.jump_tolerance_s:
            return None
        return OffsetBounds(min(low_s, high_s), high_s)

    def least_possible_lag_s(self, now_s: float, rules: ClockRules) -> float:
        """A slice with a smaller lag than this proves that the scanner's clock went forward."""
        low_s, _ = self._believed(now_s, rules)
        if self.least_prompt_lag_s is not None:
            low_s = max(low_s, self.least_prompt_lag_s - rules.prompt_delay_s)
        return low_s - rules.jump_tolerance_s

    def _believed(self, now_s: float, rules: ClockRules) -> tuple[float, float]:
        """Bounds of the offset before any slice was seen."""
        if self.sync is None:
            return -rules.largest_offset_s, rules.largest_offset_s
        age_s = abs(now_s - self.sync.at_s)
        half_s = self.sync.uncertainty_s + age_s * rules.drift_ppm * 1e-6
        return self.sync.offset_s - half_s, self.sync.offset_s + half_s


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
    lag_s = received_s - earliest_end_s(interval)
    least_s = clock.least_possible_lag_s(received_s, rules)
    if lag_s < least_s:
        text = f"the scanner's clock is at least {least_s - lag_s:.1f} s ahead of before"
        return Observation(_seen(ScannerClock(), interval, received_s, rules), jump=text)
    late = ""
    bounds = clock.bounds_for(interval, received_s, rules)
    if bounds is not None:
        delay_s = received_s - latest_end_s(interval, rules) - bounds.high_s
        if delay_s > rules.late_limit_s:
            late = f"received {delay_s:.1f} s after the acquisition, or its clock was set back"
    return Observation(_seen(clock, interval, received_s, rules), late=late)


@dataclass(frozen=True)
class Drift:
    """The least lags at the beginning and of late, over `_DRIFT_SLICES` slices with certain ends.

    A clock that creeps shows in no single slice. Nor can it be told from slices that have come to
    take longer; either way the promptness that everything rests on is no longer what it was.
    """

    first_s: tuple[float, ...] = ()
    last_s: tuple[float, ...] = ()

    def with_slice(self, interval: AcquisitionInterval, received_s: float) -> "Drift":
        if interval.end_s is None or interval.estimated:
            return self
        lag_s = received_s - interval.end_s
        if len(self.first_s) < _DRIFT_SLICES:
            return Drift((*self.first_s, lag_s))
        return Drift(self.first_s, (*self.last_s, lag_s)[-_DRIFT_SLICES:])

    @property
    def moved_s(self) -> float:
        """How much longer the lags have become; 0 until there are enough slices to say."""
        if len(self.last_s) < _DRIFT_SLICES:
            return 0.0
        return min(self.last_s) - min(self.first_s)


def _seen(
    clock: ScannerClock, interval: AcquisitionInterval, received_s: float, rules: ClockRules
) -> ScannerClock:
    latest_lag_s = received_s - latest_end_s(interval, rules)
    seen = replace(
        clock, least_lag_s=_least(clock.least_lag_s, received_s - earliest_end_s(interval))
    )
    if _is_certain(interval):
        return replace(seen, least_prompt_lag_s=_least(clock.least_prompt_lag_s, latest_lag_s))
    return replace(seen, least_loose_lag_s=_least(clock.least_loose_lag_s, latest_lag_s))


def earliest_end_s(interval: AcquisitionInterval) -> float:
    """When it may have ended at the earliest: an estimate may be far too long."""
    if interval.end_s is None or interval.estimated:
        return interval.start_s
    return interval.end_s


def latest_end_s(interval: AcquisitionInterval, rules: ClockRules) -> float:
    """When it may have ended at the latest, where the header does not say: as long as any does."""
    if interval.end_s is None:
        return interval.start_s + rules.longest_acquisition_s
    return interval.end_s


def _is_certain(interval: AcquisitionInterval) -> bool:
    return interval.end_s is not None and not interval.estimated


def _least(known: float | None, new: float) -> float:
    return new if known is None else min(known, new)
