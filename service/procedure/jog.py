"""Moving by hand: one move of one axis, recorded and replayed like every other procedure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.procedure.sensing import move
from service.procedure.steps import MoveTo, ProcedureSteps

PURPOSE = "manual"


@dataclass(frozen=True)
class JogEnd:
    """Where the axes stood when the move had ended."""

    readback_um: Mapping[str, int]

    def to_json(self) -> dict[str, Any]:
        return {"readback_um": dict(self.readback_um)}


def jog(setpoints_um: Mapping[str, int]) -> ProcedureSteps[JogEnd]:
    """Go to the setpoints; raises ProcedureFailedError if the bridge refuses."""
    moved = yield from move(MoveTo(dict(setpoints_um), PURPOSE))
    return JogEnd(moved.readback_um)
