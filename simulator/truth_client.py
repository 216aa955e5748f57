"""Asks the emulated motor controllers where the stages truly are (loopback TCP, a line each way).

`where` answers `{"t", "positions_mm": {axis: mm}, "moving", …}`; `history T0 T1` answers
`{"start_mm": {axis: mm}, "samples": [[t, {axis: mm}], …], …}`: where the stages stood at T0, and
each change until T1. What cannot be answered is `{"error": text}`. Instants are seconds since the
epoch, UTC.
"""

import json
import socket
from dataclasses import dataclass
from typing import Any

import numpy as np

from simulator.mr_slice import StagePath

_LONGEST_ANSWER_BYTES = 16 * 1024 * 1024


class TruthError(Exception):
    """The motor controllers' process did not tell where the stages are; one line says why."""


@dataclass(frozen=True)
class TruthAddress:
    """Where the truth is asked for, and for how long an answer is waited for."""

    host: str
    port: int
    timeout_s: float = 2.0

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


@dataclass(frozen=True)
class StageTruth:
    """True stage positions (axis → mm) at `time_s`."""

    time_s: float
    positions_mm: dict[str, float]
    moving: bool


def ask_where(address: TruthAddress) -> StageTruth:
    """Where the stages stand now. Raises TruthError."""
    answer = _ask(address, "where")
    try:
        stages = answer["positions_mm"]
        positions = {axis: float(stages[axis]) for axis in _checked_axes(stages)}
        return StageTruth(float(answer["t"]), positions, bool(answer["moving"]))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TruthError(f"truth at {address}: 'where' was answered with {answer!r}") from error


def ask_path(address: TruthAddress, from_s: float, until_s: float) -> StagePath:
    """The path that the stages took between two instants. Raises TruthError."""
    answer = _ask(address, f"history {from_s:.6f} {until_s:.6f}")
    try:
        axes = _checked_axes(answer["start_mm"])
        samples = [(from_s, answer["start_mm"]), *answer["samples"]]
        times = np.array([float(time_s) for time_s, _ in samples])
        positions = np.array([[float(stages[axis]) for axis in axes] for _, stages in samples])
    except (KeyError, TypeError, ValueError) as error:
        raise TruthError(f"truth at {address}: 'history' was answered with {answer!r}") from error
    if not (np.all(np.isfinite(positions)) and np.all(np.diff(times) >= 0)):
        raise TruthError(f"truth at {address}: history is not in order or not finite")
    return StagePath(axes, times, positions)


def _checked_axes(positions: dict[str, Any]) -> tuple[str, ...]:
    """The names of the axes; without the top stage there is no fiducial. Raises KeyError."""
    for axis in ("xt", "yt"):
        positions[axis]
    return tuple(positions)


def _ask(address: TruthAddress, question: str) -> Any:
    try:
        with socket.create_connection((address.host, address.port), address.timeout_s) as line:
            line.settimeout(address.timeout_s)
            line.sendall(question.encode() + b"\n")
            answer = _read_line(line)
    except OSError as error:
        raise TruthError(f"truth at {address}: {error}") from error
    try:
        decoded = json.loads(answer)
    except ValueError as error:
        raise TruthError(f"truth at {address}: {question!r} was not answered in JSON") from error
    if isinstance(decoded, dict) and "error" in decoded:
        raise TruthError(f"truth at {address}: {decoded['error']}")
    return decoded


def _read_line(line: socket.socket) -> bytes:
    received = bytearray()
    while not received.endswith(b"\n"):
        chunk = line.recv(65536)
        if not chunk:
            raise ConnectionError("the connection was closed before the answer was complete")
        received += chunk
        if len(received) > _LONGEST_ANSWER_BYTES:
            raise ConnectionError("the answer is too long")
    return bytes(received)
