"""What is known of the scanner's clock, since when, and what that means for slices."""

from __future__ import annotations

from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Event
from dicom_listener.clock import ClockRules
from room_config.load import Config
from service.room.state import ClockState

_WAITS = "slices are pending: compare the clocks, or confirm the hold at which each was acquired"


def clock_update(config: Config, record: CaseRecord, now_s: float) -> dict[str, Any]:
    """The fields of the room's state that tell of the scanner's clock."""
    compared = _last_comparison(config, record)
    return {"clock": compared, "clock_implies": implied(config, compared, now_s)}


def implied(config: Config, compared: ClockState | None, now_s: float) -> str:
    """In words, what becomes of slices with what is known now."""
    most_s = config.listener.prompt_delay_s
    if compared is None:
        if most_s is None:
            return f"Not compared, and no delay has been measured here: {_WAITS}."
        return f"Not compared: slices are judged by the delay measured here, at most {most_s:g} s."
    ends_s = _made_s(compared) + 60 * config.listener.comparison_valid_min
    if now_s < ends_s:
        wait_s = start_margin_s(config, compared, now_s)
        return f"Used for slices acquired {wait_s:.1f} s or more after the robot settled."
    if most_s is None:
        return f"Too old: {_WAITS}."
    return f"Too old: slices are judged by the delay measured here, at most {most_s:g} s."


def start_margin_s(config: Config, compared: ClockState | None, now_s: float) -> float:
    """How long after settling an acquisition must begin to be surely believed; 0: it is not."""
    listener = config.listener
    margins_s = [0.0]
    if compared is not None:
        age_s = abs(now_s - _made_s(compared))
        if age_s < 60 * listener.comparison_valid_min:
            margins_s.append(2 * (compared.uncertainty_s + age_s * ClockRules.drift_ppm * 1e-6))
    if listener.prompt_delay_s is not None:
        margins_s.append(listener.prompt_delay_s - listener.least_delay_s)
    return max(margins_s) + listener.guard_s if len(margins_s) > 1 else 0.0


def clock_margin_s(config: Config, record: CaseRecord, now_s: float) -> float:
    """`start_margin_s` with what the record and the room's file know."""
    return start_margin_s(config, _last_comparison(config, record), now_s)


def _made_s(compared: ClockState) -> float:
    return compared.compared_s if compared.compared_s is not None else 0.0


def _last_comparison(config: Config, record: CaseRecord) -> ClockState | None:
    compared = record.last_event("clock_sync")
    forgotten = record.last_event("clock_reset")
    if forgotten is not None and (compared is None or compared.event_id < forgotten.event_id):
        return None
    return _from_file(config) if compared is None else _from_event(compared)


def _from_event(compared: Event) -> ClockState:
    return ClockState(
        offset_s=compared.body["offset_s"],
        uncertainty_s=compared.body["uncertainty_s"],
        compared_s=compared.wall_s,
        who=compared.who,
    )


def _from_file(config: Config) -> ClockState | None:
    listener = config.listener
    if listener.clock_offset_s is None or listener.clock_compared_at is None:
        return None
    return ClockState(
        offset_s=listener.clock_offset_s,
        uncertainty_s=listener.clock_uncertainty_s,
        compared_s=listener.clock_compared_at.timestamp(),
        who="the room's file",
    )
