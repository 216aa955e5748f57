"""What is known of the clocks of the scanners that send to us, by scanner."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from dicom_listener.clock_offset import (
    LAGS_KEPT,
    ClockRules,
    Comparison,
    Offset,
    OffsetUnknown,
    Received,
    ScannerClock,
    is_certain,
    observe,
)
from dicom_slice.header import Slice

# kinds of events: by people, by people, by slices
CLOCK_COMPARED, CLOCK_FORGOTTEN, CLOCK_DOUBTED = "clock_sync", "clock_reset", "clock_doubted"
_WHAT_TO_DO = {
    kind: "; compare the clocks"
    for kind in ("clock_jump", "late_or_clock_jump", "push_delay_unlike_measured", "clock_drift")
}


@dataclass(frozen=True)
class Drift:
    """The least lags at the beginning and of late, over `LAGS_KEPT` slices with certain ends.

    A clock that creeps shows in no single slice. Nor can it be told from slices that have come to
    take longer; either way what everything rests on is no longer what it was.
    """

    first_s: tuple[float, ...] = ()
    last_s: tuple[float, ...] = ()

    def with_slice(self, slice_: Received) -> "Drift":
        if not is_certain(slice_.interval):
            return self
        lag_s = slice_.most_lag_s
        if len(self.first_s) < LAGS_KEPT:
            return Drift((*self.first_s, lag_s))
        return Drift(self.first_s, (*self.last_s, lag_s)[-LAGS_KEPT:])

    @property
    def moved_s(self) -> float:
        """How much longer the lags have become; 0 until there are enough slices to say."""
        if len(self.last_s) < LAGS_KEPT:
            return 0.0
        return min(self.last_s) - min(self.first_s)


def outdates_until_s(body: Mapping[str, Any], wall_s: float) -> float:
    """Up to when a comparison in the room's file is older than a comparison or reset in the record.

    body, wall_s: of that event. A file has no place in the order of the record. Where this computer
    was set back, what is older may have the larger time: by the clock before, it was said later.
    """
    return float(body.get("at_s", wall_s)) - min(0.0, float(body.get("step_s", 0.0)))


class ScannerClocks:
    """Learns from every slice, and from what operators say: a comparison, or a reset.

    What slices prove against a comparison goes into the record (`take_doubts`, CLOCK_DOUBTED): it
    is known of the room's scanner, whichever case comes next.
    """

    def __init__(self, rules: ClockRules, comparison: Comparison | None) -> None:
        self._rules = rules
        self._filed = comparison  # in the room's file
        self._unseen = self._with_filed(ScannerClock())  # of a scanner that has not sent yet
        self._doubts: dict[str, dict[str, Any]] = {}  # that stand, by scanner
        self._untold: set[str] = set()  # of those, whose the record does not have
        self._clocks: dict[str, ScannerClock] = {}
        self._drifts: dict[str, Drift] = {}
        self._standing: set[tuple[str, str]] = set()  # alarms that are raised once, while they last
        self._has_news = False

    def observe(
        self, slice_: Slice, received_s: float, *, is_fresh: bool = True
    ) -> list[tuple[str, str]]:
        """Take one more slice into account; return the alarms that it gives, as (kind, text)."""
        received = _received(slice_, received_s, is_fresh=is_fresh)
        if received is None:
            return []
        scanner = slice_.scanner
        before = self._clock(scanner)
        seen = observe(before, received, self._rules)
        self._clocks[scanner] = seen.clock
        text = seen.clock.contradicted or seen.clock.suspicion
        if text and text != (before.contradicted or before.suspicion):
            is_sure = bool(seen.clock.contradicted)
            doubt = {"scanner": scanner, "text": text, "is_certain": is_sure, "at_s": received_s}
            self._doubts[scanner] = doubt
            self._untold.add(scanner)
        is_new = not before.is_witnessed(self._rules) and seen.clock.is_witnessed(self._rules)
        self._has_news |= is_new
        drift = self._drifts.get(scanner, Drift())
        if not seen.duration:
            drift = drift.with_slice(received)
        self._drifts[scanner] = drift
        alarms = [
            *self._standing_alarm("clock_jump", scanner, seen.jump),
            *self._standing_alarm("late_or_clock_jump", scanner, seen.late),
            *self._standing_alarm("push_delay_unlike_measured", scanner, seen.unlike),
            *self._standing_alarm("wrong_duration", scanner, seen.duration),
            *self._standing_alarm("clock_drift", scanner, self._drift_text(drift)),
        ]
        return [(kind, f"{scanner}: {text}{_WHAT_TO_DO.get(kind, '')}") for kind, text in alarms]

    def _clock(self, scanner: str) -> ScannerClock:
        return self._clocks.get(scanner, self._unseen)

    def _drift_text(self, drift: Drift) -> str:
        if abs(drift.moved_s) <= self._rules.drift_alarm_s:
            return ""
        return (
            f"slices seem to take {drift.moved_s:+.1f} s longer to arrive than at the beginning, "
            "or its clock has drifted by that much"
        )

    def _standing_alarm(self, kind: str, scanner: str, text: str) -> list[tuple[str, str]]:
        was_standing = (kind, scanner) in self._standing
        (self._standing.add if text else self._standing.discard)((kind, scanner))
        return [(kind, text)] if text and not was_standing else []

    def offset(self, slice_: Slice, received_s: float) -> Offset:
        """Between which bounds the offset lies for this slice, or what would make it known."""
        received = _received(slice_, received_s)
        if received is None:
            return OffsetUnknown("the header has no acquisition time")
        return self._clock(slice_.scanner).bounds_for(received, self._rules)

    def wrong_duration(self, slice_: Slice, received_s: float) -> str:
        """Why the end of its acquisition cannot be true; empty where nothing says so."""
        received = _received(slice_, received_s)
        if received is None:
            return ""
        return self._clock(slice_.scanner).wrong_duration(received, self._rules)

    def heed(self, kind: str, body: Mapping[str, Any], wall_s: float) -> None:
        """Follow an event of the record, where it concerns clocks."""
        if kind == CLOCK_COMPARED:
            self._outdate_filed(body, wall_s)
            made = Comparison(body["offset_s"], body["uncertainty_s"], body["at_s"])
            self._unseen = self._with_filed(self._unseen.compared(made, self._rules))
            self._clocks = {
                name: self._with_filed(clock.compared(made, self._rules))
                for name, clock in self._clocks.items()
            }
        elif kind == CLOCK_FORGOTTEN:
            self._outdate_filed(body, wall_s)
            set_at_s = body.get("at_s", wall_s)  # what was said in an earlier case has an instant
            self._unseen = self._with_filed(ScannerClock(set_at_s=set_at_s))
            self._clocks.clear()
        elif kind == CLOCK_DOUBTED:
            self._doubt(body)
            return
        else:
            return
        self._doubts.clear()
        self._untold.clear()
        self._drifts.clear()
        self._standing.clear()
        self._has_news = True

    def _outdate_filed(self, body: Mapping[str, Any], wall_s: float) -> None:
        if self._filed is not None and self._filed.at_s <= outdates_until_s(body, wall_s):
            self._filed = None

    def _with_filed(self, clock: ScannerClock) -> ScannerClock:
        """The clock after what the room's file says, if the clocks were compared since then."""
        return clock if self._filed is None else clock.compared(self._filed, self._rules)

    def _doubt(self, body: Mapping[str, Any]) -> None:
        if self._filed is not None and self._filed.at_s > body["at_s"]:
            return
        scanner = body["scanner"]
        clock = self._clock(scanner)
        self._clocks[scanner] = clock.doubted(body["text"], is_certain=body["is_certain"])
        self._doubts[scanner] = dict(body)
        self._untold.discard(scanner)

    @property
    def comparison(self) -> Comparison | None:
        """The last one that counts, for a scanner that has not sent yet."""
        return self._unseen.comparisons[-1] if self._unseen.comparisons else None

    @property
    def doubts(self) -> list[dict[str, Any]]:
        """What stands against what was known, in words for the record."""
        return list(self._doubts.values())

    def take_doubts(self) -> list[dict[str, Any]]:
        """Of those, what the record does not have yet."""
        untold = [self._doubts[scanner] for scanner in self._untold]
        self._untold.clear()
        return untold

    def recall(self, doubts: Iterable[Mapping[str, Any]]) -> None:
        """What was seen in the case before, if nobody has compared or reset the clocks since."""
        for body in doubts:
            clock = self._clock(body["scanner"])
            told_s = [made.at_s for made in clock.comparisons] + [clock.set_at_s or -math.inf]
            if body["scanner"] in self._doubts or max(told_s) > body["at_s"]:
                continue
            self._doubt(body)
            if body["scanner"] in self._doubts:
                self._untold.add(body["scanner"])

    @property
    def has_news(self) -> bool:
        return self._has_news

    def take_news(self) -> bool:
        """Whether slices that waited for the clock to be known are to be asked for again."""
        news, self._has_news = self._has_news, False
        return news


def _received(slice_: Slice, received_s: float, *, is_fresh: bool = True) -> Received | None:
    if slice_.interval is None:
        return None
    return Received(slice_.interval, received_s, slice_.clock_synchronized is True, is_fresh)
