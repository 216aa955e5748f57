"""Counts motions of the true stages that no recorded move explains."""

from __future__ import annotations

import json
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from case_record.rows import Move
from simulator.truth_client import TruthAddress

# a park or unpark shifts a stage by less; anything further is a motion
_NOT_A_MOTION_MM = 0.02
_CLOCK_SLACK_S = 0.1


@dataclass(frozen=True)
class TrueMotion:
    """A motion of one axis as the stages really made it; instants in seconds since the epoch."""

    axis: str
    cause: str
    start_s: float
    from_mm: float
    to_mm: float


def ask_motions(address: TruthAddress) -> list[TrueMotion]:
    """Return every motion that began since the motors' process started."""
    with socket.create_connection((address.host, address.port), timeout=5.0) as line:
        line.sendall(b"motions\n")
        with line.makefile() as answer:
            rows: list[dict[str, Any]] = json.loads(answer.readline())["motions"]
    return [TrueMotion(r["axis"], r["cause"], r["t_start"], r["from_mm"], r["to_mm"]) for r in rows]


def unintended_motions(motions: Sequence[TrueMotion], moves: Sequence[Move]) -> list[TrueMotion]:
    """Return the motions that began while no move was on its way."""
    return [
        motion
        for motion in motions
        if abs(motion.to_mm - motion.from_mm) > _NOT_A_MOTION_MM
        and not any(_explains(move, motion) for move in moves)
    ]


def _explains(move: Move, motion: TrueMotion) -> bool:
    ended_s = float("inf") if move.ended_s is None else move.ended_s
    return move.sent_s - _CLOCK_SLACK_S <= motion.start_s <= ended_s + _CLOCK_SLACK_S
