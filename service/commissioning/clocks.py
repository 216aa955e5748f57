"""How far the scanner's clock is off, whether its times are true, and how soon slices come."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from dicom_listener.promptness import Promptness, promptness_of
from service.commissioning.evidence import CommissioningError, ScannedSeries

# A person presses so long before (below 0) or after what is seen or heard to start or to end.
REACTION_S = (-0.5, 1.0)


@dataclass(frozen=True)
class ClockFinding:
    """offset_s: our clock minus the scanner's, within ± uncertainty_s, at the instant at_s (ours).

    untruthful_s: by how much the acquisition times and the presses contradict each other; 0 where
    they do not. delays_s: of each slice after its acquisition, by protocol, with that offset.
    """

    offset_s: float
    uncertainty_s: float
    at_s: float
    untruthful_s: float
    promptness: Promptness
    delays_s: dict[str, tuple[float, ...]]


def find_clock(series: Sequence[ScannedSeries]) -> ClockFinding:
    """Judge the clocks by the presses and by when the slices came.

    Each press bounds the offset by what a person's reaction may be, and each slice bounds it from
    above: it came after its acquisition had ended. Raises CommissioningError where there is too
    little to judge by (TooFewDelaysError is raised by `promptness_of`).
    """
    lows, highs = [], []
    for scanned in series:
        first, last = scanned.receptions[0].interval, scanned.receptions[-1].interval
        pairs = [(scanned.started, first.start_s)]
        if last.end_s is not None and not last.estimated:
            pairs.append((scanned.ended, last.end_s))
        for press, by_scanner_s in pairs:
            lows.append(press.at_s - REACTION_S[1] - by_scanner_s)
            highs.append(press.at_s - REACTION_S[0] - by_scanner_s)
    upper_s = min(_lags_s(series, certain=False), default=float("inf"))
    low_s, high_s = max(lows), min(*highs, upper_s)
    middle_s, half_s = (low_s + high_s) / 2, abs(high_s - low_s) / 2
    lags_s = _lags_s(series, certain=True)
    if not lags_s:
        raise CommissioningError("no slice gives the duration of its acquisition: confirm each one")
    seen = promptness_of([lag_s - middle_s for lag_s in lags_s])
    return ClockFinding(
        offset_s=middle_s,
        uncertainty_s=half_s,
        at_s=series[-1].ended.at_s,
        untruthful_s=max(0.0, low_s - high_s),
        promptness=Promptness(max(0.0, seen.least_s - half_s), seen.most_s + half_s),
        delays_s=_delays_s(series, middle_s),
    )


def _lags_s(series: Sequence[ScannedSeries], *, certain: bool) -> list[float]:
    """Receipt less the acquisition's end; less its start where the end is no proof."""
    lags = []
    for scanned in series:
        for reception in scanned.receptions:
            interval = reception.interval
            is_certain = interval.end_s is not None and not interval.estimated
            if is_certain:
                lags.append(reception.received_s - float(interval.end_s or 0.0))
            elif not certain:
                lags.append(reception.received_s - interval.start_s)
    return lags


def _delays_s(series: Sequence[ScannedSeries], offset_s: float) -> dict[str, tuple[float, ...]]:
    delays: dict[str, list[float]] = defaultdict(list)
    for scanned in series:
        for reception in scanned.receptions:
            if reception.interval.end_s is not None:
                lag_s = reception.received_s - reception.interval.end_s
                delays[scanned.protocol].append(lag_s - offset_s)
    return {protocol: tuple(values) for protocol, values in delays.items()}
