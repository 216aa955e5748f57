"""What is known of the scanner's clock, since when, and what that means for slices.

A comparison is between two clocks: where this computer's own one is set, nothing is known any more.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Event, Hold
from dicom_listener.clock_offset import ClockRules
from dicom_listener.scanner_clocks import (
    CLOCK_COMPARED,
    CLOCK_DOUBTED,
    CLOCK_FORGOTTEN,
    outdates_until_s,
)
from room_config.load import Config
from service.room.alarm_list import Condition
from service.room.state import ClockState
from service.room.validity import computer_start

# by less the margins between a hold and its slices allow for
_STEP_S = 0.1
_WAITS = "slices are pending: compare the clocks, or confirm the hold at which each was acquired"


def clock_update(config: Config, record: CaseRecord, now_s: float) -> dict[str, Any]:
    """The fields of the room's state that tell of the scanner's clock."""
    compared, doubted = _last_comparison(config, record), doubt(config, record)
    return {
        "clock": compared,
        "clock_doubted": doubted,
        "clock_implies": implied(config, compared, now_s, doubted),
    }


def doubt(config: Config, record: CaseRecord) -> str:
    """What a slice has shown against what is known of the clock; empty where nothing stands.

    As `ScannerClocks` has it: until the clocks are compared again, or somebody says they were set.
    """
    doubted = record.last_event(CLOCK_DOUBTED)
    if doubted is None:
        return ""
    told, filed = _last_told(record), _filed(config, record)
    if told is not None and told.event_id > doubted.event_id:
        return ""
    if filed is not None and _made_s(filed) > doubted.body["at_s"]:
        return ""
    return f"{doubted.body['scanner']}: {doubted.body['text']}"


def implied(config: Config, compared: ClockState | None, now_s: float, doubted: str = "") -> str:
    """In words, what becomes of slices with what is known now."""
    if doubted:
        return f"Doubted: compare again ({doubted}). Until then slices are pending."
    most_s = config.listener.prompt_delay_s
    if compared is None:
        if most_s is None:
            return f"Not compared, and no delay has been measured here: {_WAITS}."
        return f"Not compared: slices are judged by the delay measured here, at most {most_s:g} s."
    ends_s = _made_s(compared) + 60 * config.listener.comparison_valid_min
    if now_s < ends_s and most_s is None and config.listener.clock_may_be_set:
        return f"Valid for the hold at which it was made. For others, {_WAITS}."
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
    """What stands, as `ScannerClocks` has it: the room's file counts while it is the newer one."""
    filed, told = _filed(config, record), _last_told(record)
    if filed is not None or told is None or told.kind == CLOCK_FORGOTTEN:
        return filed
    return _from_event(told)


def _last_told(record: CaseRecord) -> Event | None:
    """What people said last: a comparison, or that a clock was set."""
    said = (record.last_event(kind) for kind in (CLOCK_COMPARED, CLOCK_FORGOTTEN))
    return max((event for event in said if event), key=lambda event: event.event_id, default=None)


def _filed(config: Config, record: CaseRecord) -> ClockState | None:
    filed = _from_file(config)
    if filed is None:
        return None
    kinds = (CLOCK_COMPARED, CLOCK_FORGOTTEN)
    told = (event for kind in kinds for event in record.events_of_kind(kind))
    is_old = any(_made_s(filed) <= outdates_until_s(event.body, event.wall_s) for event in told)
    return None if is_old else filed


def _from_event(compared: Event) -> ClockState:
    return ClockState(
        offset_s=compared.body["offset_s"],
        uncertainty_s=compared.body["uncertainty_s"],
        compared_s=compared.body["at_s"],
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


class ClockWatch:
    """Whether somebody, or a time service, sets this computer's clock: also between two cases, or
    while the service is restarted (`home / clock.json`). Slewing moves both clocks alike.

    stepped_s, at_monotonic_s: by how much it was set last, and when.
    """

    def __init__(self, home: Path) -> None:
        self._path = home / "clock.json"
        self._offset_s = _wall_less_steady_s()
        self.stepped_s = self.at_monotonic_s = 0.0
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            kept = json.loads(self._path.read_text(encoding="utf-8"))
            if kept.pop("computer") == computer_start():
                self._offset_s = float(kept["offset_s"])
                self.stepped_s = float(kept["stepped_s"])
                self.at_monotonic_s = float(kept["at_monotonic_s"])
        self._keep()

    def look(self) -> bool:
        """True once for each step."""
        step_s = _wall_less_steady_s() - self._offset_s
        if not abs(step_s) > _STEP_S:
            return False
        self._offset_s += step_s
        self.stepped_s, self.at_monotonic_s = step_s, time.monotonic()
        self._keep()
        return True

    def is_news_to(self, record: CaseRecord) -> bool:
        """Whether the clock was set since the case was told anything of comparisons."""
        told = (record.last_event(kind) for kind in (CLOCK_COMPARED, CLOCK_FORGOTTEN))
        last_s = max((_told_s(event) for event in told if event), default=0.0)
        return bool(self.stepped_s) and last_s < self.at_monotonic_s

    def _keep(self) -> None:
        kept = {"offset_s": self._offset_s, "stepped_s": self.stepped_s}
        kept |= {"at_monotonic_s": self.at_monotonic_s}
        part = self._path.with_suffix(".part")
        with contextlib.suppress(OSError):  # of a disk that takes nothing
            part.write_text(json.dumps({"computer": computer_start(), **kept}), encoding="utf-8")
            os.replace(part, self._path)


def _told_s(event: Event) -> float:
    """When the clocks were compared, which may have been in the case before."""
    return float(event.body.get("monotonic_s", event.monotonic_s))


def _wall_less_steady_s() -> float:
    """The steady clock goes on while the computer sleeps, and nobody sets it."""
    before_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    wall_s = time.time()
    return wall_s - (before_s + time.clock_gettime(time.CLOCK_BOOTTIME)) / 2


def note_step(record: CaseRecord, step_s: float) -> None:
    """Of the comparison nothing is left; slices wait, or are judged by the delay measured here."""
    body = {"why": f"the room computer's clock was set by {step_s:+.1f} s", "step_s": step_s}
    record.append_event(CLOCK_FORGOTTEN, body, source="service")


def clock_was_set(config: Config, record: CaseRecord) -> list[Condition]:
    """That the computer's clock was set, or what is known is doubted, until compared again."""
    doubted = doubt(config, record)
    if doubted and not config.listener.arrival_mode:
        text = f"The scanner's clock is doubted: {doubted}; slices stay pending"
        return [Condition("clock_doubted", "alarm", text, "Compare the clocks again.")]
    step = _last_step(config, record)
    if step is None:
        return []
    waits = "" if config.listener.prompt_delay_s is not None else ": slices stay pending"
    text = f"{step.body['why'][:1].upper()}{step.body['why'][1:]}{waits}"
    return [Condition("clock_set", "alarm", text, "Compare it with the scanner's clock.")]


def _last_step(config: Config, record: CaseRecord) -> Event | None:
    told = _last_told(record)
    if told is None or "step_s" not in told.body or _last_comparison(config, record) is not None:
        return None
    return told


def is_by_another_clock(record: CaseRecord, hold: Hold) -> bool:
    """Whether the clock was set since the hold began: its instants are not the slices' then."""
    forgotten = record.last_event(CLOCK_FORGOTTEN)
    return forgotten is not None and "step_s" in forgotten.body and forgotten.seq > hold.begun_seq
