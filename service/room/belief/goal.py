"""Settings of a case: what the operator changed of strategy and goal, within the room's bounds."""

from __future__ import annotations

from dataclasses import dataclass

from case_record.record import CaseRecord
from room_config.load import Config

SETTINGS_CHANGED = "settings_changed"
_NAMES = ("strategy", "tolerance_mm", "confidence", "most_slices")


@dataclass(frozen=True)
class Bounds:
    """Lowest and highest value that may be set on the page."""

    tolerance_mm: tuple[float, float]
    confidence: tuple[float, float]
    most_slices: tuple[int, int]


def bounds_of(config: Config) -> Bounds:
    """As the room's file has them; the file's own value always lies within."""
    service = config.service
    return Bounds(
        _around(service.tolerance_range_mm, goal_tolerance_mm(config)),
        _around(service.confidence_range, service.confidence),
        (1, service.most_slices_limit),
    )


def _around(bounds: tuple[float, float], value: float) -> tuple[float, float]:
    low, high = bounds
    return min(low, value), max(high, value)


def goal_tolerance_mm(config: Config) -> float:
    """Of the needle's tip where the room has a guide with two fiducials."""
    return (config.service.guide or config.service).tolerance_mm


def effective(config: Config, record: CaseRecord) -> Config:
    """The room's configuration with what was changed for this case."""
    changed = record.last_event(SETTINGS_CHANGED)
    if changed is None:
        return config
    body = {name: changed.body[name] for name in _NAMES}
    service = config.service
    if service.guide is not None:
        tolerance = {"tolerance_mm": body.pop("tolerance_mm")}
        body["guide"] = service.guide.model_copy(update=tolerance)
    return config.model_copy(update={"service": service.model_copy(update=body)})
