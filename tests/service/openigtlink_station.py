"""A planning station for tests: the client built on the official library, where it can be built."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_SOURCE = Path(__file__).parent / "openigtlink_client"


def build_client() -> Path:
    """The program; skips the test where cmake or the library (3.0 or later) is not installed.

    OPENIGTLINK_DIR in the environment names a folder in which the library was built.
    """
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    folder = Path(tempfile.mkdtemp(prefix="openigtlink_client-"))
    own = os.environ.get("OPENIGTLINK_DIR")
    where = [f"-DOpenIGTLink_DIR={own}"] if own else []
    for words in (["-S", _SOURCE, "-B", folder, "-Wno-dev", *where], ["--build", folder]):
        made = subprocess.run(["cmake", *map(str, words)], capture_output=True, text=True)
        if made.returncode != 0:
            pytest.skip("the OpenIGTLink library (3.0 or later) is not here: set OPENIGTLINK_DIR")
    return folder / "openigtlink_client"


class Station:
    """What the station has received, and what it shows: the last of every device."""

    def __init__(self, program: Path, port: int) -> None:
        self._process = subprocess.Popen(
            [program, "127.0.0.1", str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._changed = threading.Condition()
        self.heard: list[dict[str, Any]] = []
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with self._changed:
                self.heard.append(json.loads(line))
                self._changed.notify_all()

    def say(self, *words: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()

    def mark(self) -> int:
        with self._changed:
            return len(self.heard)

    def wait_for(
        self, wanted: Callable[[dict[str, Any]], Any], since: int = 0, timeout_s: float = 60.0
    ) -> dict[str, Any]:
        """The first message since a mark that is as wanted."""
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                for message in self.heard[since:]:
                    if wanted(message):
                        return message
                since = len(self.heard)
                left_s = deadline_s - time.monotonic()
                assert self._changed.wait(max(0.0, left_s)), f"not heard: {self.heard[-8:]}"

    def shown(self, device: str) -> dict[str, Any] | None:
        """What a screen shows under a name now: None where it was withdrawn or never came."""
        with self._changed:
            found = [m for m in self.heard if m.get("device") == device and m["whole"]]
        if not found:
            return None
        last, meta = found[-1], found[-1].get("meta", {})
        withdrawn = "INVALID" in (meta.get("TransformStatus"), meta.get("ImageStatus"))
        return None if withdrawn or last.get("points") == [] else last

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


@contextmanager
def station(program: Path, port: int, *, hello: bool = True) -> Iterator[Station]:
    made = Station(program, port)
    try:
        if hello:
            made.say("hello")
        yield made
    finally:
        made.close()
