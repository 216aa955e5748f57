"""Byte capture: what went over a controller line, when, to a file; and replay of such a file.

One JSON array a line: `[seconds, "tx" | "rx", url, "hex"]`, `tx` being what the host wrote, seconds
since the capture began. A capture of a real unit becomes a test: the same driver calls against
`ReplayPort` must write the captured commands, and get the answers that the unit gave.
"""

import json
import re
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from robot_bridge.pmd.line import Port


class CaptureError(ValueError):
    """The capture file does not hold what it should; the text names file and line."""


class ReplayMismatchError(Exception):
    """The host wrote a command that the capture does not answer."""


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

    Each command line is answered by what followed it in the capture: the first time by the first
    such answer, the second time by the second, and so on. Commands to different addresses may come
    in another order than captured (axes on one bus take turns by time), but a command that was
    never captured, or more often than captured, raises ReplayMismatchError.
    """

    def __init__(self, captured: Sequence[Captured], url: str) -> None:
        self._answers = _answers_by_line([c for c in captured if c.url == url])
        self._written = b""
        self._readable = bytearray()

    @property
    def left(self) -> dict[bytes, int]:
        """Captured commands that were not asked for yet, with their number."""
        return {line: len(answers) for line, answers in self._answers.items() if answers}

    def write(self, data: bytes, /) -> int:
        *lines, self._written = _split_lines(self._written + data)
        for line in lines:
            answers = self._answers.get(line)
            if not answers:
                seen = "never" if answers is None else "less often"
                raise ReplayMismatchError(f"{line!r} was written, and {seen} captured")
            self._readable += answers.popleft()
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        data = bytes(self._readable[:size])
        del self._readable[:size]
        return data

    def reset_input_buffer(self) -> None:
        self._readable.clear()

    def close(self) -> None:
        pass


def _split_lines(data: bytes) -> list[bytes]:
    """Whole lines with their delimiter (CR, LF or semicolon), then what is left."""
    return re.split(rb"(?<=[\r\n;])", data)


def _answers_by_line(captured: Sequence[Captured]) -> dict[bytes, deque[bytes]]:
    answers: dict[bytes, deque[bytes]] = {}
    newest: deque[bytes] | None = None
    for record in captured:
        if record.direction == "tx":
            for line in _split_lines(record.data)[:-1]:
                newest = answers.setdefault(line, deque())
                newest.append(b"")
        elif newest is not None:
            newest[-1] += record.data
    return answers
