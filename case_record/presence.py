"""Which processes of the room are alive, told by the kernel: each locks a file of its own.

A process that ends, however it ends, loses its lock at once; one that hangs stops beating, and
whoever supervises it ends it: `autospine up` sees the beats of the file, systemd is told of each.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from case_record.connection import CaseRecordError

FOLDER = "processes"
BEAT_EVERY_S = 0.25
_RETRY_S = 0.05


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
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._file = os.open(folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        # shared: whoever looks asks for the exclusive lock
        fcntl.flock(self._file, fcntl.LOCK_SH)
        self._next_s = 0.0
        self.beat()

    def beat(self) -> None:
        """Say that the main loop still turns; cheap enough for every round of it."""
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + BEAT_EVERY_S
            now_ns = time.monotonic_ns()  # one clock for all processes, and nobody sets it
            with contextlib.suppress(OSError):  # a disk that takes nothing
                os.utime(self._file, ns=(now_ns, now_ns))
            _tell_systemd()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._file)

    def __enter__(self) -> Presence:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Sole:
    """Held by the one process of its name on a case, where two would undo each other's work.

    Raises CaseRecordError where another holds it, and does not let it go within `patience_s`: one
    that was just killed is still ending.
    """

    def __init__(self, case_dir: Path, name: str, *, patience_s: float = 2.0) -> None:
        folder = case_dir / FOLDER
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        # not the file of its presence: whoever looks locks that one for a moment
        path = folder / f"{name}.sole"
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        deadline_s = time.monotonic() + patience_s
        while not self._lock():
            if time.monotonic() > deadline_s:
                other = os.pread(self._file, 20, 0).decode("ascii", "replace").strip() or "unknown"
                self.close()
                raise CaseRecordError(
                    f"{case_dir}: another {name} (process {other}) is using it; stop that one first"
                )
            time.sleep(_RETRY_S)
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def _lock(self) -> bool:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._file)

    def __enter__(self) -> Sole:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Hanging:
    """Says of other processes that they hang: for a supervisor that looks several times a second.

    It beats as they do. Where its own beat does not show, the disk takes nothing and says nothing
    of anybody; where it has itself not looked for a while, neither does what it sees first.
    """

    def __init__(self, folder: Path, name: str, hung_s: float, confirm_s: float = 2.0) -> None:
        self._folder, self._name = folder, name
        self._hung_s, self._confirm_s = hung_s, confirm_s
        self._own: Presence | None = None
        self._since_s: dict[str, float] = {}
        self._looked_s = 0.0

    def look(self, names: Sequence[str]) -> list[str]:
        """Those of the named processes that run and have not beaten for too long."""
        now_s = time.monotonic()
        if now_s - self._looked_s > self._confirm_s:
            self._since_s.clear()
        self._looked_s = now_s
        if not self._sees_itself():
            self._since_s.clear()
            return []
        seen = who_is_alive(self._folder, names)
        late = {one.name for one in seen if one.running and one.beat_age_s > self._hung_s}
        self._since_s = {name: self._since_s.get(name, now_s) for name in late}
        return [name for name in late if now_s - self._since_s[name] >= self._confirm_s]

    def _sees_itself(self) -> bool:
        try:
            self._own = self._own or Presence(self._folder, self._name)
        except OSError:
            return False
        self._own.beat()
        (own,) = who_is_alive(self._folder, [self._name])
        return own.running and own.beat_age_s < self._confirm_s

    def close(self) -> None:
        if self._own is not None:
            self._own.close()


def _tell_systemd() -> None:
    """Where it watches this process (`WatchdogSec=`): that the main loop turns."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or "WATCHDOG_USEC" not in os.environ:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.sendto(
            b"WATCHDOG=1", address.replace("@", "\0", 1) if address[0] == "@" else address
        )


def who_is_alive(case_dir: Path, names: Sequence[str]) -> list[Alive]:
    """Look at each of the named processes."""
    return [_look(case_dir / FOLDER / name, name) for name in names]


def _look(path: Path, name: str) -> Alive:
    try:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return Alive(name, False, False, 0.0)
    try:
        age_s = max(0.0, time.monotonic() - os.fstat(file).st_mtime_ns / 1e9)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return Alive(name, True, True, age_s)
        return Alive(name, True, False, age_s)
    finally:
        os.close(file)
