"""What is known of the clocks of the scanners that send to us, by scanner."""

from collections.abc import Mapping
from typing import Any

from dicom_listener.clock import ClockRules, OffsetBounds, ScannerClock, Sync, observe
from dicom_listener.header import Slice


class ScannerClocks:
    """Learns from every slice, and from what operators say: a sync, or a reset."""

    def __init__(self, rules: ClockRules, sync: Sync | None) -> None:
        self._rules = rules
        self._sync = sync
        self._clocks: dict[str, ScannerClock] = {}
        self._late: set[str] = set()

    def observe(self, slice_: Slice, received_s: float) -> list[tuple[str, str]]:
        """Take one more slice into account; return the alarms that it gives, as (kind, text)."""
        if slice_.interval is None:
            return []
        clock = self._clocks.get(slice_.scanner, ScannerClock(sync=self._sync))
        seen = observe(clock, slice_.interval, received_s, self._rules)
        self._clocks[slice_.scanner] = seen.clock
        alarms = [("clock_jump", seen.jump)] if seen.jump else []
        if seen.late and slice_.scanner not in self._late:
            alarms.append(("late_or_clock_jump", seen.late))  # once, until one is prompt again
        (self._late.add if seen.late else self._late.discard)(slice_.scanner)
        return [(kind, f"{slice_.scanner}: {text}") for kind, text in alarms]

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
        elif kind == "clock_reset":
            self._sync = None
            self._clocks.clear()
