"""Where the stages are taken to stand when nobody knows it, and from what: for a person to confirm.

Controllers without encoders that lost their supply, and a bridge that was killed in a motion, do
not know where the robot stands. The bridge remembers what it last knew, with a bound; what it never
knew is no more than a count. Neither is a position before somebody has looked and said yes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from robot_bridge.client.client import BridgeStatus


@dataclass(frozen=True)
class TakenAt:
    """within_um: give or take; None: by the motor's count alone, which nobody vouches for."""

    at_um: int
    within_um: int | None


def taken_to_stand(status: BridgeStatus) -> dict[str, TakenAt]:
    """Of the axes whose position is not certain."""
    taken = {}
    for axis, counted_um in status.positions_um.items():
        if axis in status.certain_axes:
            continue
        if axis in status.remembered_um:
            bound_um = status.bound_um.get(axis, 0)
            taken[axis] = TakenAt(status.remembered_um[axis], bound_um)
        else:
            taken[axis] = TakenAt(counted_um, None)
    return taken


def in_words(taken: Mapping[str, TakenAt]) -> str:
    """One sentence that says where, and from what."""
    places = ", ".join(f"{axis} {one.at_um / 1000:.3f} mm" for axis, one in taken.items())
    return f"Assumed stage positions: {places} ({source_of(taken)})."


def source_of(taken: Mapping[str, TakenAt]) -> str:
    known = [one.within_um for one in taken.values() if one.within_um is not None]
    if not known:
        return "motor count only; its zero may be anywhere"
    text = f"last known to the bridge, ± {max(known) / 1000:.3f} mm"
    counted = [axis for axis, one in taken.items() if one.within_um is None]
    return f"{text}; {', '.join(counted)}: motor count only" if counted else text
