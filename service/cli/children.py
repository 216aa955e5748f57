"""Child processes under one supervisor: started until ready, watched, and all ended together.

Every child is given `--exit-with-parent`: it ends by itself when the pipe on its standard input is
closed, which the kernel does even if the supervisor is killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from room_config.exit_codes import COULD_NOT

MOST_LOG_BYTES = 16 * 2**20
LOGS_KEPT = 4
_TAIL_LINES = 3
_LAST_WORDS_BYTES = 64 * 1024


class ChildError(Exception):
    """A child did not start, or ended; the text is one line with its own last words."""

    exit_code = COULD_NOT


class Child:
    """One process, its ready line, and its log file."""

    def __init__(self, name: str, words: Sequence[str], log_file: Path) -> None:
        self.name = name
        self.log_file = log_file
        self.ready: dict[str, Any] = {}
        self._is_ready = threading.Event()
        self._log: IO[bytes] = open_log(log_file)
        self._log_start = self._log.tell()
        self.process = subprocess.Popen(
            [*words, "--exit-with-parent"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            # a Ctrl-C on the terminal is for the supervisor, which ends the children in order
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, name=f"{name} output", daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if not self._is_ready.is_set() and line.startswith(b"{"):
                with contextlib.suppress(ValueError):
                    facts = json.loads(line)
                    if facts.get("ready"):
                        self.ready = facts
                        self._is_ready.set()
                        continue
            with contextlib.suppress(ValueError, OSError):
                self._log.write(line)

    def wait_ready(self, timeout_s: float) -> dict[str, Any]:
        """Return the facts of the ready line; ChildError if the child ends or is silent."""
        deadline_s = time.monotonic() + timeout_s
        while not self._is_ready.wait(0.02):
            if self.process.poll() is not None:
                raise ChildError(self.describe_end())
            if time.monotonic() > deadline_s:
                raise ChildError(f"{self.name} was not ready within {timeout_s:.0f} s")
        return self.ready

    def describe_end(self) -> str:
        """Say in one line how the child ended, with the last of what it said."""
        code = self.process.poll()
        how = "still runs"
        if code is not None:
            how = (
                f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
            )
        said = self._last_words()
        return f"{self.name} {how}" + (f": {said}" if said else "")

    def _last_words(self) -> str:
        try:
            self._log.flush()
            with self.log_file.open("rb") as log:
                end = log.seek(0, os.SEEK_END)
                # what it said itself; the log may have been rotated since
                start = self._log_start if self._log_start < end else 0
                log.seek(max(start, end - _LAST_WORDS_BYTES))
                lines = log.read().decode(errors="replace").splitlines()
        except OSError:
            return ""
        plain = [line for line in lines if line.strip() and not line.startswith("{")]
        return " | ".join(plain[-_TAIL_LINES:])

    def ask_to_end(self) -> None:
        """By signal and by its standard input; returns at once."""
        with contextlib.suppress(OSError):
            if self.process.stdin is not None:
                self.process.stdin.close()
        with contextlib.suppress(OSError):
            self.process.terminate()

    def end(self, timeout_s: float = 5.0) -> None:
        """Ask the child to end, and kill it if it does not. Idempotent."""
        if self.process.poll() is None:
            self.ask_to_end()
            try:
                self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join(timeout=0.2)
        for stream in (self.process.stdin, self.process.stdout, self._log):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


class Family:
    """The children of one room: ended in the reverse of the order in which they were started."""

    def __init__(self, log_dir: Path) -> None:
        self._log_dir = log_dir
        with contextlib.suppress(OSError):  # of a disk that takes nothing; then nothing is logged
            log_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.children: dict[str, Child] = {}

    def start(self, name: str, words: Sequence[str], timeout_s: float = 120.0) -> dict[str, Any]:
        """Start a child and return the facts of its ready line."""
        child = self.launch(name, words)
        return child.wait_ready(timeout_s)

    def launch(self, name: str, words: Sequence[str]) -> Child:
        """Start a child without waiting until it is ready."""
        child = Child(name, words, self._log_dir / f"{name}.log")
        self.children[name] = child
        return child

    def dead(self) -> Child | None:
        """Return a child that has ended by itself, if there is one."""
        return next((c for c in self.children.values() if c.process.poll() is not None), None)

    def end(self, *names: str) -> None:
        """End the named children, or all."""
        for name in names or tuple(reversed(self.children)):
            if name in self.children:
                self.children.pop(name).end()

    def end_all(self, names: Sequence[str], timeout_s: float) -> None:
        """End the named children at the same time: whoever still runs after timeout_s is killed."""
        ending = [self.children.pop(name) for name in names if name in self.children]
        for child in ending:
            child.ask_to_end()
        until_s = time.monotonic() + timeout_s
        for child in ending:
            child.end(max(0.0, until_s - time.monotonic()))

    def rotate_logs(self) -> None:
        for child in self.children.values():
            rotate(child.log_file)


def open_log(path: Path) -> IO[bytes]:
    """To be appended to; where the disk takes no file, what is said is lost and nothing else."""
    try:
        return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), "ab")
    except OSError:
        return open(os.devnull, "ab")


def rotate(path: Path, most_bytes: int = MOST_LOG_BYTES, kept: int = LOGS_KEPT) -> None:
    """Begin a log anew that has become too long; the last `kept` are kept as NAME.1, NAME.2, ….

    Whoever writes keeps its file: the text is copied away and the file emptied, so that a line
    which is written in that very moment may be lost.
    """
    try:
        if path.stat().st_size <= most_bytes:
            return
        for number in range(kept, 1, -1):
            older = path.with_name(f"{path.name}.{number - 1}")
            if older.exists():
                older.replace(path.with_name(f"{path.name}.{number}"))
        with contextlib.suppress(OSError):  # a full disk: the log must not grow all the same
            shutil.copy(path, path.with_name(f"{path.name}.1"))
        os.truncate(path, 0)
    except OSError:
        return


def quiet_environment() -> None:
    """Keep numerical libraries from starting a thread a core in every process of the room."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
