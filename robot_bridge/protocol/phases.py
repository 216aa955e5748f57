"""The work phases, and the one table of what is allowed in each.

The bridge owns the phase. A transition that the table does not name is refused; a motion in a
phase whose row does not say so is refused. STOP and EMERGENCY are entered from every phase by a
stop (never by a request for the phase) and are left by the operator's re-arm alone.
"""

from dataclasses import dataclass
from enum import StrEnum


class WorkPhase(StrEnum):
    START_UP = "START_UP"
    CALIBRATION = "CALIBRATION"
    PLANNING = "PLANNING"
    TARGETING = "TARGETING"
    MOVE_TO_TARGET = "MOVE_TO_TARGET"
    MANUAL = "MANUAL"
    STOP = "STOP"
    EMERGENCY = "EMERGENCY"


@dataclass(frozen=True)
class Allowed:
    """One row: the phases that a request may lead to from here, and what may move here."""

    to: frozenset[WorkPhase]
    move: bool
    home: bool
    after_rearm: WorkPhase | None = None


def _row(*to: WorkPhase, move: bool = False, home: bool = False) -> Allowed:
    return Allowed(frozenset(to), move=move, home=home)


_P = WorkPhase

ALLOWED: dict[WorkPhase, Allowed] = {
    _P.START_UP: _row(_P.CALIBRATION, _P.PLANNING, _P.MANUAL, home=True),
    _P.CALIBRATION: _row(_P.START_UP, _P.PLANNING, _P.TARGETING, _P.MANUAL, move=True, home=True),
    _P.PLANNING: _row(_P.START_UP, _P.CALIBRATION, _P.TARGETING, _P.MANUAL),
    _P.TARGETING: _row(_P.CALIBRATION, _P.PLANNING, _P.MOVE_TO_TARGET, _P.MANUAL, move=True),
    _P.MOVE_TO_TARGET: _row(_P.CALIBRATION, _P.PLANNING, _P.TARGETING, _P.MANUAL, move=True),
    _P.MANUAL: _row(_P.START_UP, _P.CALIBRATION, _P.PLANNING, _P.TARGETING, move=True, home=True),
    _P.STOP: Allowed(frozenset(), move=False, home=False, after_rearm=_P.START_UP),
    _P.EMERGENCY: Allowed(frozenset(), move=False, home=False, after_rearm=_P.START_UP),
}


def may_follow(now: WorkPhase, wanted: WorkPhase) -> bool:
    """Whether a request may change the phase from `now` to `wanted` (staying is allowed)."""
    return wanted == now or wanted in ALLOWED[now].to


def motion_allowed(phase: WorkPhase) -> bool:
    return ALLOWED[phase].move
