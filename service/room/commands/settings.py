"""Strategy and goal of a case, changed by the operator within the room's bounds."""

from __future__ import annotations

from room_config.service import STRATEGIES
from service.room.belief.goal import SETTINGS_CHANGED, bounds_of
from service.room.context import RoomContext
from service.room.refusal import ConflictError


class SettingsCommands:
    """Changes them; what runs goes on with what it began with."""

    def __init__(self, room: RoomContext) -> None:
        self._room = room

    def change_settings(
        self, strategy: str, tolerance_mm: float, confidence: float, most_slices: int, by: str
    ) -> None:
        """From the next procedure of this case on; ConflictError outside the room's bounds."""
        if self._room.record.running_procedure() is not None:
            raise ConflictError(
                "busy", "A procedure is running: change settings when it has ended."
            )
        if strategy not in STRATEGIES:
            raise ConflictError("out_of_bounds", f"Unknown strategy {strategy!r}.")
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
