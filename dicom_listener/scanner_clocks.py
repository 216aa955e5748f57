"""What is known of the clocks of the scanners that send to us, by scanner."""

from collections.abc import Mapping
from typing import Any

from dicom_listener.clock import ClockRules, Drift, OffsetBounds, ScannerClock, Sync, observe
from dicom_slice.header import Slice


class ScannerClocks:
    """Learns from every slice, and from what operators say: a sync, or a reset."""

    def __init__(self, rules: ClockRules, sync: Sync | None) -> None:
        self._rules = rules
        self._sync = sync
        self._clocks: dict[str, ScannerClock] = {}
        self._drifts: dict[str, Drift] = {}
        self._standing: set[tuple[str, str]] = set()  # alarms that are raised once, while they last

    def observe(self, slice_: Slice, received_s: float) -> list[tuple[str, str]]:
        """Take one more slice into account; return the alarms that it gives, as (kind, text)."""
        if slice_.interval is None:
            return []
        clock = self._clocks.get(slice_.scanner, ScannerClock(sync=self._sync))
        seen = observe(clock, slice_.interval, received_s, self._rules)
        self._clocks[slice_.scanner] = seen.clock
        known = Drift() if seen.jump else self._drifts.get(slice_.scanner, Drift())
        drift = self._drifts[slice_.scanner] = known.with_slice(slice_.interval, received_s)
        alarms = [("clock_jump", seen.jump)] if seen.jump else []
        alarms += self._standing_alarm("late_or_clock_jump", slice_.scanner, seen.late)
        alarms += self._standing_alarm("clock_drift", slice_.scanner, self._drift_text(drift))
        return [
            (kind, f"{slice_.scanner}: {text}; compare the clocks, or reset what is known of it")
            for kind, text in alarms
        ]

    def _drift_text(self, drift: Drift) -> str:
        if abs(drift.moved_s) <= self._rules.drift_alarm_s:
            return ""
        return (
            f"slices seem to take {drift.moved_s:+.1f} s longer to come than at the beginning, or "
            "its clock has drifted by that"
        )

    def _standing_alarm(self, kind: str, scanner: str, text: str) -> list[tuple[str, str]]:
        was_standing = (kind, scanner) in self._standing
        (self._standing.add if text else self._standing.discard)((kind, scanner))
        return [(kind, text)] if text and not was_standing else []

    def offset(self, slice_: Slice, received_s: float) -> OffsetBounds | None:
        """Between which bounds the offset lies for this slice; None where it is not known."""
        clock = self._clocks.get(slice_.scanner)
        if clock is None or slice_.interval is None:
            return None
        return clock.bounds_for(slice_.interval, received_s, self._rules)

    def heed(self, kind: str, body: Mapping[str, Any]) -> None:
        """Follow an event of the record, where it concerns clocks."""
        if kind == "clock_sync":
            self._sync = Sync(body["offset_s"], body["uncertainty_s"], body["at_s"])
            self._clocks = {scanner: ScannerClock(sync=self._sync) for scanner in self._clocks}
            self._drifts.clear()
        elif kind == "clock_reset":
            self._sync = None
            self._clocks.clear()
            self._drifts.clear()
