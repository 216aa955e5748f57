"""Planning stations for tests, on our own bytes or on the official library where it can be had."""

from __future__ import annotations

import json
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.slicer.messages import (
    TO_RAS,
    Message,
    Point,
    points,
    status,
    string,
    transform,
)
from service.slicer.reading import Received, Stream, matrix_of, points_of, string_of

_SOURCE = Path(__file__).parent / "openigtlink_client"


@cache
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


class Station(ABC):
    """What the station has heard, and what it shows: the last of every device."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.heard: list[dict[str, Any]] = []
        self._listening = threading.Thread(target=self._listen, daemon=True)
        self._listening.start()

    @abstractmethod
    def say(self, *words: object) -> None:
        """In the words of the client's source."""

    @abstractmethod
    def close(self) -> None: ...

    @abstractmethod
    def _messages(self) -> Iterator[dict[str, Any]]: ...

    def _listen(self) -> None:
        for message in self._messages():
            with self._changed:
                self.heard.append(message)
                self._changed.notify_all()

    def mark(self) -> int:
        with self._changed:
            return len(self.heard)

    def wait_for(
        self, wanted: Callable[[Mapping[str, Any]], Any], since: int = 0, timeout_s: float = 60.0
    ) -> dict[str, Any]:
        """The first message since a mark that is as wanted."""
        deadline_s, begun = time.monotonic() + timeout_s, since
        with self._changed:
            while True:
                for message in self.heard[since:]:
                    if wanted(message):
                        return message
                since = len(self.heard)
                left_s = deadline_s - time.monotonic()
                others = [m for m in self.heard[begun:] if m["device"] != "AutoSPINe"]
                assert self._changed.wait(max(0.0, left_s)), f"not heard, but {others[-8:]}"

    def next_beats(self, number: int = 2) -> None:
        """Until the room has said so often more what is going on: once a second, and before
        everything else that it says at that instant.
        """
        for _ in range(number):
            self.wait_for(lambda m: m["device"] == "AutoSPINe", self.mark())

    def shown(self, device: str) -> dict[str, Any] | None:
        """What a screen shows under a name now: None where it was withdrawn or never came."""
        with self._changed:
            found = [m for m in self.heard if m["device"] == device and m["whole"]]
        if not found:
            return None
        last, meta = found[-1], found[-1]["meta"]
        withdrawn = "INVALID" in (meta.get("TransformStatus"), meta.get("ImageStatus"))
        return None if withdrawn or last.get("points") == [] else last


class OfficialStation(Station):
    """The client that is built on the official library."""

    def __init__(self, program: Path, port: int) -> None:
        self._process = subprocess.Popen(
            [program, "127.0.0.1", str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        super().__init__()

    def say(self, *words: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()

    def _messages(self) -> Iterator[dict[str, Any]]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if not line.startswith('{"kind":"END"'):
                yield json.loads(line)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._listening.join()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


class OwnStation(Station):
    """The same on this project's own bytes."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=120)
        super().__init__()

    def say(self, *words: object) -> None:
        self.send(_message(*map(str, words)).encoded())

    def send(self, data: bytes) -> None:
        self._socket.sendall(data)

    def _messages(self) -> Iterator[dict[str, Any]]:
        stream = Stream()
        while data := self._received():
            yield from map(_as_the_client_says, stream.feed(data))
            assert not stream.faults

    def _received(self) -> bytes:
        try:
            return self._socket.recv(65536)
        except OSError:
            return b""

    def close(self) -> None:
        self._socket.close()


def _message(*words: str) -> Message:
    what, device, *rest = [*" ".join(words).split(), ""][:2] + " ".join(words).split()[2:]
    if what == "hello":
        return status("", 1.0, 1, "", "")
    if what == "string":
        return string(device, 1.0, " ".join(rest))
    if what == "transform":
        matrix = np.array([float(word) for word in rest]).reshape(3, 4) * TO_RAS[:, None]
        return transform(device, 1.0, matrix[:, :3], matrix[:, 3])
    listed = [
        Point(rest[at], tuple((np.array(rest[at + 1 : at + 4], float) * TO_RAS).tolist()))
        for at in range(0, len(rest), 4)
    ]
    return points(device, 1.0, listed)


def _as_the_client_says(message: Received) -> dict[str, Any]:
    said: dict[str, Any] = {"whole": True, "meta": message.meta}
    said |= {"kind": message.kind, "device": message.device}
    if message.kind == "STATUS":
        code, subcode = struct.unpack(">Hq", message.content[:10])
        name = message.content[10:30].split(b"\0")[0].decode()
        text = message.content[30:].split(b"\0")[0].decode()
        said |= {"code": code, "subcode": subcode, "name": name, "text": text}
    elif message.kind == "STRING":
        said["text"] = string_of(message)
    elif message.kind == "TRANSFORM":
        axes, origin = matrix_of(message)
        said["matrix"] = (np.hstack([axes, origin[:, None]]) * TO_RAS[:, None]).ravel().tolist()
    elif message.kind == "POINT":
        said["points"] = [
            {"name": point.name, "ras": (np.array(point.patient_mm) * TO_RAS).tolist()}
            for point in points_of(message)
        ]
    return said


@contextmanager
def station(kind: str, port: int, *, hello: bool = True) -> Iterator[Station]:
    """kind: `official` (skipped where the library is not), or `own`."""
    made = OfficialStation(build_client(), port) if kind == "official" else OwnStation(port)
    try:
        if hello:
            made.say("hello")
        yield made
    finally:
        made.close()
