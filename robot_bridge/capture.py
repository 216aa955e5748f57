"""Byte capture: what went over a controller line, when, to a file; and replay of such a file.

One JSON array a line: `[seconds, "tx" | "rx", url, "hex"]`, `tx` being what the host wrote, seconds
since the capture began. A capture of a real unit becomes a test: the same driver calls against
`ReplayPort` must write the same bytes, and get the answers that the unit gave.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from robot_bridge.pmd_line import Port


class CaptureError(ValueError):
    """The capture file does not hold what it should; the text names file and line."""


class ReplayMismatchError(Exception):
    """The host wrote other bytes than in the capture."""


@dataclass(frozen=True)
class Captured:
    at_s: float
    direction: Literal["tx", "rx"]
    url: str
    data: bytes


class CaptureWriter:
    """Appends to the file; every line is whole, so that a crash leaves a readable file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._begun_s = time.monotonic()

    def write(self, direction: Literal["tx", "rx"], url: str, data: bytes) -> None:
        at_s = round(time.monotonic() - self._begun_s, 6)
        self._file.write(json.dumps([at_s, direction, url, data.hex()]) + "\n")

    def close(self) -> None:
        self._file.close()


class CapturingPort:
    """A port whose traffic is written down."""

    def __init__(self, port: Port, url: str, writer: CaptureWriter) -> None:
        self._port, self._url, self._writer = port, url, writer

    def read(self, size: int = 1, /) -> bytes:
        data = self._port.read(size)
        if data:
            self._writer.write("rx", self._url, data)
        return data

    def write(self, data: bytes, /) -> int | None:
        self._writer.write("tx", self._url, data)
        return self._port.write(data)

    def reset_input_buffer(self) -> None:
        self._port.reset_input_buffer()

    def close(self) -> None:
        self._port.close()


def read_capture(path: Path) -> list[Captured]:
    """Raises CaptureError, or OSError if the file cannot be read."""
    return list(_captured_lines(path))


def _captured_lines(path: Path) -> Iterator[Captured]:
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            at_s, direction, url, data = json.loads(line)
            if direction not in ("tx", "rx"):
                raise ValueError(direction)
            yield Captured(float(at_s), direction, str(url), bytes.fromhex(data))
        except (ValueError, TypeError):
            raise CaptureError(f"{path}, line {number}: not a capture record") from None


class ReplayPort:
    """Plays the controllers' part of one line of a capture.

    Answers become readable once the host has written everything that went before them in the
    capture. Other bytes than the captured ones raise ReplayMismatchError, which names the place.
    """

    def __init__(self, captured: list[Captured], url: str) -> None:
        self._script = [c for c in captured if c.url == url]
        self._place = 0
        self._tx_left = b""
        self._readable = bytearray()
        self._release()

    def _release(self) -> None:
        while self._place < len(self._script) and not self._tx_left:
            record = self._script[self._place]
            self._place += 1
            if record.direction == "tx":
                self._tx_left = record.data
            else:
                self._readable += record.data

    @property
    def finished(self) -> bool:
        return self._place == len(self._script) and not self._tx_left

    def write(self, data: bytes, /) -> int:
        for written in data:
            if not self._tx_left or self._tx_left[0] != written:
                raise ReplayMismatchError(
                    f"record {self._place}: host wrote {data!r}, captured {self._tx_left!r}"
                )
            self._tx_left = self._tx_left[1:]
            self._release()
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        data = bytes(self._readable[:size])
        del self._readable[:size]
        return data

    def reset_input_buffer(self) -> None:
        self._readable.clear()

    def close(self) -> None:
        pass
