"""How far the scanner's clock is from ours: an interval that never pretends to know more.

offset_s = our wall clock - the scanner's clock, at the same instant. A slice is received after its
acquisition ended, so each one bounds the offset from above: receipt - end. From below nothing in a
slice bounds it, for nobody knows how late it is; and an offset believed too large makes an
acquisition seem later than it was, which is how a slice is taken for a hold that came after it. So
the lower bound comes from what people did at this site:

- a comparison of the clocks, made at a known instant, which widens and ends with age;
- promptness that was measured here: no slice comes later than so long after its end.

Where both are known, an acquisition must be good by both: one may be wrong without harm. With
neither there are no bounds at all. What contradicts them stops assignment by time until somebody
compares the clocks again; it never replaces them.

A clock that is set forward after a comparison, by less than slices take to come, shows in nothing.
With a comparison alone an acquisition is therefore sure to have begun only after the comparison, or
after `late_limit_s` before it came, whichever is later, if that is earlier than its own time says.
"""

from dataclasses import dataclass, replace

from dicom_listener.promptness import Promptness, Witness, with_witness
from dicom_slice.times import AcquisitionInterval

LAGS_KEPT = 10
_MUCH_SOONER_S = 0.5
_LAGS_THAT_SHOW_A_HABIT = 5


@dataclass(frozen=True)
class ClockRules:
    """What is known of a scanner, its network and of clocks.

    promptness: measured at this site; None: not measured, and nothing is believed of it.
    witnesses: acquisitions, independent of each other, that must agree before promptness alone is
    believed: those that were held up do not come equally late.
    longest_acquisition_s: no acquisition that comes without its duration lasts longer.
    late_limit_s: no slice comes later than this. One that seems to shows a clock that was set back,
    or a network that stood still, and nothing can tell which.
    unseen_steps: the clock may be set without anybody's knowing.
    comparison_valid_s: a comparison says nothing of a slice further away in time than this, unless
    the scanner says that its clock is synchronized (AcquisitionTimeSynchronized).
    drift_ppm: what a clock may run off by while its time service slews it (ntpd: 500 ppm).
    synchronized_drift_ppm: the same where the scanner says that it is synchronized.
    drift_alarm_s: how far the least lag of late may be from that of the beginning.
    """

    promptness: Promptness | None = None
    witnesses: int = 5
    longest_acquisition_s: float = 30.0
    late_limit_s: float = 300.0
    unseen_steps: bool = True
    comparison_valid_s: float = 3600.0
    jump_tolerance_s: float = 0.5
    drift_ppm: float = 500.0
    synchronized_drift_ppm: float = 50.0
    drift_alarm_s: float = 1.0


@dataclass(frozen=True)
class Comparison:
    """The two clocks were compared at `at_s` (ours)."""

    offset_s: float
    uncertainty_s: float
    at_s: float

    def bounds_at(self, instant_s: float, drift_ppm: float) -> "OffsetBounds":
        half_s = self.uncertainty_s + abs(instant_s - self.at_s) * drift_ppm * 1e-6
        return OffsetBounds(self.offset_s - half_s, self.offset_s + half_s)

    def agrees_with(self, earlier: "Comparison", rules: ClockRules) -> bool:
        then = earlier.bounds_at(self.at_s, rules.drift_ppm)
        apart_s = abs(self.offset_s - earlier.offset_s)
        return apart_s <= self.uncertainty_s + (then.high_s - then.low_s) / 2


@dataclass(frozen=True)
class OffsetBounds:
    """The offset lies in [low_s, high_s]; not below low_if_set_s if the clock was set unseen."""

    low_s: float
    high_s: float
    low_if_set_s: float | None = None


@dataclass(frozen=True)
class OffsetUnknown:
    """Nothing is known that would bound the offset; the text says what to do."""

    text: str


Offset = OffsetBounds | OffsetUnknown

_CONFIRM = "or confirm the hold at which this acquisition was made"
_WHAT_TO_DO, _SCAN_AGAIN = f"compare the clocks, {_CONFIRM}", f"scan again, {_CONFIRM}"


@dataclass(frozen=True)
class Received:
    """One slice, as its clock sees it.

    is_fresh: it came when it was received; a file that lay in the drop folder may have come at any
    time before, and bears no witness to promptness.
    """

    interval: AcquisitionInterval
    received_s: float
    synchronized: bool = False
    is_fresh: bool = True

    @property
    def most_lag_s(self) -> float:
        """Receipt less the earliest end: the offset cannot be larger."""
        return self.received_s - earliest_end_s(self.interval)

    def least_lag_s(self, rules: ClockRules) -> float:
        """Receipt less the latest end: the offset plus the least delay."""
        return self.received_s - latest_end_s(self.interval, rules)

    def earliest_start_s(self, rules: ClockRules) -> float:
        """By our clock, whatever the scanner's says: no slice comes later than `late_limit_s`."""
        return self.interval.start_s + self.least_lag_s(rules) - rules.late_limit_s


@dataclass(frozen=True)
class ScannerClock:
    """What is known of one scanner's clock. Values only; `observe` makes the next one.

    comparisons: that agree with each other, oldest first.
    set_at_s: until when the clock may have been set, by what somebody said or by comparisons that
    do not agree; nothing from before counts. contradicted: what slices prove against what was
    known; suspicion: what they make doubtful of it. Both stand until the next comparison.
    witnesses (the least late of what came independently, by the latest end) and upper_s (the least
    lag by the earliest end): over all slices since then. lags_s: of the last acquisitions whose
    ends are certain.
    synchronized_since_s: since when all slices say that the clock is synchronized.
    """

    comparisons: tuple[Comparison, ...] = ()
    set_at_s: float | None = None
    contradicted: str = ""
    suspicion: str = ""
    witnesses: tuple[Witness, ...] = ()
    upper_s: float | None = None
    lags_s: tuple[float, ...] = ()
    synchronized_since_s: float | None = None

    def compared(self, made: Comparison, rules: ClockRules) -> "ScannerClock":
        """What is known once the clocks have been compared (again).

        Where it does not agree with what was known, the clock was set at some time before.
        """
        agrees = all(made.agrees_with(before, rules) for before in self.comparisons[-1:])
        if self.contradicted or not agrees:
            return ScannerClock((made,), set_at_s=made.at_s)
        return replace(self, comparisons=(*self.comparisons, made), suspicion="", lags_s=())

    def doubted(self, text: str, *, is_certain: bool) -> "ScannerClock":
        """With what slices have shown against it, in another case or before a restart."""
        if is_certain:
            return replace(self, contradicted=self.contradicted or text)
        return replace(self, suspicion=self.suspicion or text)

    def bounds_for(self, slice_: Received, rules: ClockRules) -> Offset:
        """Between which bounds the offset lay when this slice was acquired."""
        against = self.contradicted or self.suspicion
        if against:
            return OffsetUnknown(f"{against}: {_WHAT_TO_DO}")
        if self.set_at_s is not None and slice_.earliest_start_s(rules) < self.set_at_s:
            return OffsetUnknown(
                f"it may have been acquired before the scanner's clock was set: {_SCAN_AGAIN}"
            )
        compared = self.by_comparison(slice_, rules)
        if compared is not None and _ahead_s(slice_, compared, rules) > rules.jump_tolerance_s:
            return OffsetUnknown(f"it arrived sooner than the comparison allows: {_WHAT_TO_DO}")
        prompt = self._by_promptness(slice_, rules)
        lows = [bounds.low_s for bounds in (compared, prompt) if bounds is not None]
        # of a slice that comes later than any did when this was measured, promptness proves nothing
        unlike = _unlike_measured(self, slice_, rules)
        if compared is None and unlike and self.is_witnessed(rules):
            return OffsetUnknown(f"{unlike}: {_SCAN_AGAIN}")
        if not lows:
            return OffsetUnknown(f"{self._why_unknown(slice_, rules)}: {_WHAT_TO_DO}")
        if_set = self._low_if_set_s(slice_, rules) if prompt is None or unlike else None
        return OffsetBounds(min(lows), max(self._high_s(slice_, rules), min(lows)), if_set)

    def _low_if_set_s(self, slice_: Received, rules: ClockRules) -> float | None:
        """None: nobody sets this clock unseen, or what it follows is known since the comparison."""
        since_s, last_s = self.synchronized_since_s, self.comparisons[-1].at_s
        is_followed = slice_.synchronized and since_s is not None and since_s <= last_s
        if not rules.unseen_steps or is_followed:
            return None
        return max(last_s, slice_.earliest_start_s(rules)) - slice_.interval.start_s

    def _high_s(self, slice_: Received, rules: ClockRules) -> float:
        compared = self.by_comparison(slice_, rules)
        upper_s = slice_.most_lag_s if self.upper_s is None else self.upper_s
        return upper_s if compared is None else min(upper_s, compared.high_s)

    def wrong_duration(self, slice_: Received, rules: ClockRules) -> str:
        """Why its end cannot be true though its start may be; empty where nothing says so.

        A short acquisition that ends after it was received may as well show a clock set forward.
        """
        interval = slice_.interval
        if interval.end_s is None or interval.estimated:
            return ""
        length_s = interval.end_s - interval.start_s
        known = self.by_comparison(slice_, rules)
        if known is None or not length_s > rules.longest_acquisition_s:
            return ""
        since_start_s = slice_.received_s - interval.start_s - known.low_s
        if not -rules.jump_tolerance_s <= since_start_s < length_s - rules.jump_tolerance_s:
            return ""
        return (
            f"its duration of {length_s:.1f} s is wrong: it arrived "
            f"{max(0.0, since_start_s):.1f} s after its start"
        )

    def by_comparison(self, slice_: Received, rules: ClockRules) -> OffsetBounds | None:
        """What the comparisons say that were made while it was on its way, and before and after."""
        at_s, sent_s = slice_.received_s, slice_.earliest_start_s(rules)
        near: list[Comparison] = []
        for made in self.comparisons:
            near = [made] if made.at_s < sent_s else [*near, made]
            if made.at_s > at_s:
                break
        if not slice_.synchronized:
            near = [made for made in near if abs(at_s - made.at_s) <= rules.comparison_valid_s]
        if not near:
            return None
        ppm = rules.synchronized_drift_ppm if slice_.synchronized else rules.drift_ppm
        bounds = [made.bounds_at(at_s, ppm) for made in near]
        return OffsetBounds(min(b.low_s for b in bounds), max(b.high_s for b in bounds))

    def _by_promptness(self, slice_: Received, rules: ClockRules) -> OffsetBounds | None:
        """Its own lag always counts: the clock may have gone forward since the other slices.

        Beside a comparison the slices before it need not bear witness.
        """
        if rules.promptness is None:
            return None
        if not self.is_witnessed(rules) and self.by_comparison(slice_, rules) is None:
            return None
        lag_s = slice_.least_lag_s(rules)
        if self.witnesses:
            lag_s = min(lag_s, self.witnesses[0].least_lag[0])
        return OffsetBounds(lag_s - rules.promptness.most_s, lag_s)

    def is_witnessed(self, rules: ClockRules) -> bool:
        """Whether the least late acquisitions came as nearly equally late as was measured."""
        lags = [one.least_lag for one in self.witnesses[: rules.witnesses]]
        if rules.promptness is None or len(lags) < rules.witnesses:
            return False
        range_s = rules.promptness.most_s - rules.promptness.least_s + rules.jump_tolerance_s
        if not all(certain for _, certain in lags):
            range_s += rules.longest_acquisition_s
        return lags[-1][0] - lags[0][0] <= range_s

    def _why_unknown(self, slice_: Received, rules: ClockRules) -> str:
        if rules.promptness is not None:
            return (
                f"fewer than {rules.witnesses} separate acquisitions arrived as promptly as was "
                "measured at this site"
            )
        if self.comparisons:
            age_min = (slice_.received_s - self.comparisons[-1].at_s) / 60
            when = "before" if age_min > 0 else "after"
            return f"the clocks were compared {abs(age_min):.0f} min {when} it arrived"
        return "the clocks have not been compared"


@dataclass(frozen=True)
class Observation:
    """The clock after a slice was seen, and the alarms that it gave, if any."""

    clock: ScannerClock
    jump: str = ""
    late: str = ""
    unlike: str = ""
    duration: str = ""


def observe(clock: ScannerClock, slice_: Received, rules: ClockRules) -> Observation:
    """Take one more slice into account.

    A lag below what is believed is impossible unless the scanner's clock was set forward, or what
    is believed was wrong: nothing is assigned by it until somebody has compared the clocks again.
    """
    duration = clock.wrong_duration(slice_, rules)
    if duration:
        return Observation(clock, duration=duration)
    jump = _contradiction(clock, slice_, rules)
    sooner = "" if jump else _break_of_habit(clock, slice_)
    late = "" if jump else _lateness(clock, slice_, rules)
    seen = replace(
        _with_lag(clock, slice_, rules),
        contradicted=clock.contradicted or jump,
        suspicion=clock.suspicion or sooner,
    )
    return Observation(seen, jump or sooner, late, _unlike_measured(clock, slice_, rules))


def _contradiction(clock: ScannerClock, slice_: Received, rules: ClockRules) -> str:
    lag_s = slice_.most_lag_s
    compared = clock.by_comparison(slice_, rules)
    if compared is not None:
        ahead_s = _ahead_s(slice_, compared, rules)
        if ahead_s > rules.jump_tolerance_s:
            return (
                f"the scanner's clock is at least {ahead_s:.1f} s ahead of the comparison"
                f"{_of_a_zone(ahead_s)}"
            )
    if rules.promptness is not None and clock.is_witnessed(rules):
        spread_s = rules.promptness.most_s - rules.promptness.least_s
        ahead_s = clock.witnesses[0].least_lag[0] - spread_s - lag_s
        if ahead_s > rules.jump_tolerance_s:
            return f"the scanner's clock is at least {ahead_s:.1f} s ahead of its earlier time"
    return ""


def _ahead_s(slice_: Received, compared: OffsetBounds, rules: ClockRules) -> float:
    """By how much the scanner's clock must have been ahead of the comparison, if above 0."""
    least_s = 0.0 if rules.promptness is None else rules.promptness.least_s
    return compared.low_s + least_s - slice_.most_lag_s


def _of_a_zone(ahead_s: float) -> str:
    """Clocks that are whole half hours apart mostly differ in what they think is the zone."""
    halves = round(ahead_s / 1800)
    if not halves or abs(ahead_s - 1800 * halves) > 60:
        return ""
    return " (close to a multiple of half an hour: check its time zone and scanner_time_zone)"


def _break_of_habit(clock: ScannerClock, slice_: Received) -> str:
    """Slices that all came equally late, and one that did not: the clock may have gone forward."""
    if len(clock.lags_s) < _LAGS_THAT_SHOW_A_HABIT or not is_certain(slice_.interval):
        return ""
    least_s, most_s = min(clock.lags_s), max(clock.lags_s)
    sooner_s = least_s - slice_.most_lag_s
    if sooner_s <= _MUCH_SOONER_S + (most_s - least_s):
        return ""
    return (
        f"it arrived {sooner_s:.1f} s sooner after its acquisition than any of the "
        f"{len(clock.lags_s)} slices before it, or the scanner's clock was set forward"
    )


def _lateness(clock: ScannerClock, slice_: Received, rules: ClockRules) -> str:
    known = clock.by_comparison(slice_, rules)
    high_s = clock.upper_s if known is None else known.high_s
    if high_s is None:
        return ""
    delay_s = slice_.least_lag_s(rules) - high_s
    if delay_s <= rules.late_limit_s:
        return ""
    return f"received {delay_s:.1f} s after the acquisition, or its clock was set back"


def _unlike_measured(clock: ScannerClock, slice_: Received, rules: ClockRules) -> str:
    """A slice that comes later than any did when the site was commissioned.

    Its promptness says nothing of it; and it may have been acquired before the clock was set.
    """
    promptness, known = rules.promptness, clock.by_comparison(slice_, rules)
    if promptness is None:
        return ""
    if known is not None:
        delay_s = slice_.least_lag_s(rules) - known.high_s
    elif clock.upper_s is not None:
        delay_s = slice_.least_lag_s(rules) - clock.upper_s + promptness.least_s
    else:
        return ""
    if delay_s <= promptness.most_s + rules.jump_tolerance_s:
        return ""
    return (
        f"received {delay_s:.1f} s after the acquisition; no slice arrived later than "
        f"{promptness.most_s:.1f} s when this was measured"
    )


def _with_lag(clock: ScannerClock, slice_: Received, rules: ClockRules) -> ScannerClock:
    upper_s = slice_.most_lag_s
    if clock.upper_s is not None:
        upper_s = min(clock.upper_s, upper_s)
    seen = replace(
        clock, upper_s=upper_s, synchronized_since_s=_synchronized_since_s(clock, slice_)
    )
    if not slice_.is_fresh:
        return seen
    lag_s, certain = slice_.least_lag_s(rules), is_certain(slice_.interval)
    acquired_s = slice_.interval.start_s, earliest_end_s(slice_.interval)
    received_s = slice_.received_s, slice_.received_s
    new = Witness((lag_s, certain), acquired_s, received_s)
    lags_s = clock.lags_s
    if certain and lags_s and any(one.is_one_with(new) for one in clock.witnesses):
        lags_s = (*lags_s[:-1], min(lags_s[-1], lag_s))
    elif certain:
        lags_s = (*lags_s, lag_s)[-LAGS_KEPT:]
    witnesses = with_witness(clock.witnesses, new, rules.witnesses)
    return replace(seen, witnesses=witnesses, lags_s=lags_s)


def _synchronized_since_s(clock: ScannerClock, slice_: Received) -> float | None:
    if not slice_.synchronized:
        return None
    since_s = clock.synchronized_since_s
    return slice_.received_s if since_s is None else since_s


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


def is_certain(interval: AcquisitionInterval) -> bool:
    """Whether the header says when it ended."""
    return interval.end_s is not None and not interval.estimated
