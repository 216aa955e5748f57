"""A real listener process, and the room's file that it reads."""

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


def needs_program(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(name) is None, reason=f"{name} is not installed")


# somebody has compared the clocks, which are equal, when the room's file was written, and nobody
# sets them
COMPARED = {"clock_offset_s": 0.0, "clock_uncertainty_s": 0.1, "clock_may_be_set": False}


def write_room(folder: Path, **listener: Any) -> Path:
    """A room's TOML file whose listener takes any free port; return its path.

    Nothing is known there of the scanner's clock unless it is said.
    """
    keys = {"port": 0, "min_free_mib": 1, **listener}
    lines = [f"{key} = {json.dumps(value)}" for key, value in keys.items()]
    text = "\n".join(
        [
            "[room]",
            'name = "test"',
            'case_dir = "case"',
            "[listener]",
            *lines,
            "[service]",
            'bridge_link = "/dev/null"',
            "",
        ]
    )
    path = folder / "room.toml"
    path.write_text(text)
    return path


class ListenerProcess:
    """A real `autospine listener` and the ready line that it printed."""

    def __init__(self, config: Path, *, log: Path | None = None) -> None:
        self.log = log or config.with_name("listener.log")
        with self.log.open("ab") as stderr:
            self.process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "dicom_listener.command_line",
                    "--config",
                    str(config),
                    "--exit-with-parent",
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                cwd=Path(__file__).parents[2],
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.end()
            raise AssertionError(self.log.read_text())
        self.ready = json.loads(line)
        self.port: int = self.ready["port"]

    def kill(self) -> None:
        """As a power cut would: SIGKILL."""
        self.process.kill()
        self._reap()

    def end(self) -> int:
        with contextlib.suppress(OSError):
            assert self.process.stdin is not None
            self.process.stdin.close()
        try:
            self.process.wait(60)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._reap()
        return self.process.returncode

    def _reap(self) -> None:
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()


@contextlib.contextmanager
def listening(config: Path) -> Iterator[ListenerProcess]:
    process = ListenerProcess(config)
    try:
        yield process
    finally:
        process.end()


def wait_for(condition: Any, timeout_s: float = 120.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.02)
