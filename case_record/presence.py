"""Which processes of the room are alive, told by the kernel: each locks a file of its own.

A process that ends, however it ends, loses its lock at once; one that hangs stops beating.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FOLDER = "processes"
BEAT_EVERY_S = 0.5


@dataclass(frozen=True)
class Alive:
    """What is known of a process. `seen` False: it never ran on this case."""

    name: str
    seen: bool
    running: bool
    beat_age_s: float


class Presence:
    """Held by a process for as long as it works on a case; call `beat` from its main loop."""

    def __init__(self, case_dir: Path, name: str) -> None:
        folder = case_dir / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        self._file = os.open(folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        # shared: two workers are allowed, and whoever looks asks for the exclusive lock
        fcntl.flock(self._file, fcntl.LOCK_SH)
        self._next_s = 0.0
        self.beat()

    def beat(self) -> None:
        """Say that the main loop still turns; cheap enough for every round of it."""
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + BEAT_EVERY_S
            os.utime(self._file)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._file)

    def __enter__(self) -> Presence:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def who_is_alive(case_dir: Path, names: Sequence[str]) -> list[Alive]:
    """Look at each of the named processes."""
    return [_look(case_dir / FOLDER / name, name) for name in names]


def _look(path: Path, name: str) -> Alive:
    try:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return Alive(name, False, False, 0.0)
    try:
        age_s = max(0.0, time.time() - os.fstat(file).st_mtime)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return Alive(name, True, True, age_s)
        return Alive(name, True, False, age_s)
    finally:
        os.close(file)
