"""Child processes under one supervisor: started until ready, watched, and all ended together.

Every child is given `--exit-with-parent`: it ends by itself when the pipe on its standard input is
closed, which the kernel does even if the supervisor is killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from room_config.exit_codes import COULD_NOT

_TAIL_LINES = 3


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
        self._log: IO[bytes] = log_file.open("ab")
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
            with contextlib.suppress(ValueError):
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
        self._log.flush()
        with self.log_file.open("rb") as log:
            log.seek(self._log_start)
            lines = log.read().decode(errors="replace").splitlines()
        plain = [line for line in lines if line.strip() and not line.startswith("{")]
        return " | ".join(plain[-_TAIL_LINES:])

    def end(self, timeout_s: float = 5.0) -> None:
        """Ask the child to end, and kill it if it does not. Idempotent."""
        if self.process.poll() is None:
            with contextlib.suppress(OSError):
                if self.process.stdin is not None:
                    self.process.stdin.close()
                self.process.terminate()
            try:
                self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join(timeout=1.0)
        for stream in (self.process.stdin, self.process.stdout, self._log):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


class Family:
    """The children of one room: ended in the reverse of the order in which they were started."""

    def __init__(self, log_dir: Path) -> None:
        self._log_dir = log_dir
        log_dir.mkdir(parents=True, exist_ok=True)
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


def quiet_environment() -> None:
    """Keep numerical libraries from starting a thread a core in every process of the room."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
