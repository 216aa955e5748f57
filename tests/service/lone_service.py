"""`autospine service` as a process of its own, without robot, listener and worker."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from room_config.shell import autospine

# a serial device on which nobody answers; both ends stay open as long as the tests run
_FAR_END, _NEAR_END = os.openpty()

CONFIG = f"""
[room]
name = "lone room"
case_dir = "case"
virtual = true

[service]
port = 0
bridge_link = "{os.ttyname(_NEAR_END)}"
"""


@contextmanager
def running_service(folder: Path, more: str = "") -> Iterator[str]:
    """The URL of a service whose `[service]` table goes on with `more`."""
    with ready_service(folder, more) as ready:
        yield ready["url"]


@contextmanager
def ready_service(
    folder: Path, more: str = "", *, config: str = CONFIG
) -> Iterator[dict[str, str]]:
    """What such a service says when it is ready."""
    file = folder / "room.toml"
    file.write_text(config + more)
    log = folder / "service.log"
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [*autospine("service", "--config", str(file)), "--exit-with-parent"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, log.read_text()
        yield json.loads(line)
    finally:
        process.communicate()
        assert process.returncode == 0, log.read_text()
