"""Settings of one case: what the operator changed of strategy and goal, within the room's bounds."""

from __future__ import annotations

from dataclasses import dataclass

from case_record.record import CaseRecord
from room_config.load import Config
from room_config.service import STRATEGIES
from service.room.context import Room
from service.room.readiness import ConflictError

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


class SettingsCommands:
    """Changes them; what runs goes on with what it began with."""

    def __init__(self, room: Room) -> None:
        self._room = room

    def change_settings(
        self, strategy: str, tolerance_mm: float, confidence: float, most_slices: int, by: str
    ) -> None:
        """From the next procedure of this case on; ConflictError outside the room's bounds."""
        if self._room.record.running_procedure() is not None:
            raise ConflictError("busy", "A procedure is running: change settings after it.")
        if strategy not in STRATEGIES:
            raise ConflictError("out_of_bounds", f"There is no strategy {strategy!r}.")
        bounds = bounds_of(self._room.config)
        values: dict[str, float] = {"tolerance_mm": tolerance_mm, "confidence": confidence}
        values["most_slices"] = most_slices
        for name, value in values.items():
            low, high = getattr(bounds, name)
            if not low <= value <= high:
                raise ConflictError(
                    "out_of_bounds", f"{name} is {value:g}; this room allows {low:g} to {high:g}."
                )
        self._room.note(SETTINGS_CHANGED, by, {"strategy": strategy, **values})
