"""OpenIGTLink messages that are received: bytes in, messages out, no I/O.

What peers send is not trusted: a message whose CRC is wrong, whose version is not 1 or 2, or whose
body is over the limit is counted and passed over, and reading goes on at the next thing that looks
like a header. A STOP must get through behind any rubbish.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.slicer.messages import (
    EXTENDED_HEADER,
    HEADER,
    META_ENTRY,
    POINT_BYTES,
    POINT_HEAD,
    STRING_HEAD,
    TO_RAS,
    crc64,
)

Array = NDArray[np.float64]
LARGEST_BODY = 2 * 1024 * 1024
_LARGEST_SKIPPED = 256 * 1024 * 1024
_TYPE = re.compile(rb"[A-Z][A-Z0-9_]{1,11}\0*")
_VERSIONS = (1, 2)
_PLAUSIBLE_VERSIONS = range(1, 10)


class MessageError(ValueError):
    """The content is not what its type promises; one line."""


@dataclass(frozen=True)
class Received:
    """A message whose CRC is right; content without extended header and meta-data."""

    version: int
    kind: str
    device: str
    content: bytes
    meta: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ReceivedPoint:
    """patient_mm: LPS, not checked for being finite."""

    name: str
    group: str
    patient_mm: tuple[float, float, float]


class Stream:
    """What one peer sends. `faults` counts what was passed over, by reason."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self._skip = 0
        self._lost = False
        self.faults: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[Received]:
        """Take bytes; return the messages that are whole by now, in their order."""
        self._waiting += data
        return list(self._messages())

    @property
    def is_waiting(self) -> bool:
        """Whether the rest of a message is awaited."""
        return bool(self._waiting or self._skip)

    def give_up(self) -> list[Received]:
        """The rest of a message does not come: look for whole ones behind its start."""
        self._skip = 0
        if len(self._waiting) < HEADER.size:
            self._waiting.clear()
            return []
        self._find_header("cut off")
        return list(self._messages())

    def _messages(self) -> Iterator[Received]:
        while True:
            if self._skip:
                gone = min(self._skip, len(self._waiting))
                del self._waiting[:gone]
                self._skip -= gone
            if len(self._waiting) < HEADER.size:
                return
            version, kind, device, _, size, crc = HEADER.unpack_from(self._waiting)
            if not _is_plausible(version, kind, size):
                self._find_header("no header")
                continue
            if size > LARGEST_BODY or version not in _VERSIONS:
                self.faults["too large" if size > LARGEST_BODY else "version"] += 1
                self._skip = HEADER.size + size
                continue
            if len(self._waiting) < HEADER.size + size:
                return
            body = bytes(self._waiting[HEADER.size : HEADER.size + size])
            if crc64(body) != crc:
                # its length may be what is wrong: what follows is looked for inside of it too
                self._find_header("crc")
                continue
            del self._waiting[: HEADER.size + size]
            self._lost = False
            try:
                yield _received(version, _text(kind), _text(device), body)
            except MessageError:
                self.faults["meta-data"] += 1

    def _find_header(self, fault: str) -> None:
        """Drop what stands before the next thing that could be a header; one fault until then."""
        if not self._lost:
            self.faults[fault] += 1
            self._lost = True
        del self._waiting[: _next_header(bytes(self._waiting))]


def _next_header(waiting: bytes) -> int:
    """Where behind the start of this the next header begins, or could."""
    for match in _TYPE.finditer(waiting, 3):
        start = match.start() - 2
        if len(waiting) < start + HEADER.size:
            return start
        version, kind, _, _, size, _ = HEADER.unpack_from(waiting, start)
        if _is_plausible(version, kind, size):
            return start
    return max(1, len(waiting) - HEADER.size + 1)


def _is_plausible(version: int, kind: bytes, size: int) -> bool:
    return (
        version in _PLAUSIBLE_VERSIONS
        and _TYPE.fullmatch(kind) is not None
        and size <= _LARGEST_SKIPPED
    )


def _received(version: int, kind: str, device: str, body: bytes) -> Received:
    if version == 1:
        return Received(version, kind, device, body)
    if len(body) < EXTENDED_HEADER.size:
        raise MessageError("the body is shorter than its extended header")
    start, index_size, meta_size, _ = EXTENDED_HEADER.unpack_from(body)
    end = len(body) - index_size - meta_size
    if not EXTENDED_HEADER.size <= start <= end:
        raise MessageError("the extended header does not fit the body")
    meta = _meta(body[end : end + index_size], body[end + index_size :])
    return Received(version, kind, device, body[start:end], meta)


def _meta(index: bytes, values: bytes) -> dict[str, str]:
    if not index:
        return {}
    if len(index) < 2:
        raise MessageError("the meta-data index is truncated")
    (count,) = struct.unpack_from(">H", index)
    if 2 + count * META_ENTRY.size > len(index):
        raise MessageError("the meta-data index is truncated")
    found, at = {}, 0
    for number in range(count):
        name_size, _, value_size = META_ENTRY.unpack_from(index, 2 + number * META_ENTRY.size)
        if at + name_size + value_size > len(values):
            raise MessageError("the meta-data are truncated")
        name = values[at : at + name_size].decode("utf-8", "replace")
        found[name] = values[at + name_size : at + name_size + value_size].decode(
            "utf-8", "replace"
        )
        at += name_size + value_size
    return found


def string_of(message: Received) -> str:
    """Text of a STRING, without zeros and blanks at its ends."""
    if len(message.content) < STRING_HEAD.size:
        raise MessageError("a STRING without a length")
    _, size = STRING_HEAD.unpack_from(message.content)
    text = message.content[STRING_HEAD.size : STRING_HEAD.size + size]
    if len(text) < size:
        raise MessageError("a STRING shorter than its stated length")
    return text.decode("utf-8", "replace").strip("\0 \t\r\n")


def matrix_of(message: Received) -> tuple[Array, Array]:
    """Axes (3, 3) as columns and origin (3,) of a TRANSFORM, LPS mm; not checked for sense."""
    if len(message.content) != 48:
        raise MessageError(f"a TRANSFORM must have 48 bytes, not {len(message.content)}")
    values = np.frombuffer(message.content, ">f4").astype(float).reshape(4, 3)
    return (values[:3] * TO_RAS).T, values[3] * TO_RAS


def points_of(message: Received) -> list[ReceivedPoint]:
    if len(message.content) % POINT_BYTES:
        raise MessageError(f"a POINT must have a multiple of {POINT_BYTES} bytes")
    found = []
    for at in range(0, len(message.content), POINT_BYTES):
        name, group, *_ = POINT_HEAD.unpack_from(message.content, at)
        place = np.frombuffer(message.content, ">f4", 3, at + POINT_HEAD.size) * TO_RAS
        x, y, z = (float(value) for value in place)
        found.append(ReceivedPoint(_text(name), _text(group), (x, y, z)))
    return found


def _text(field_bytes: bytes) -> str:
    return field_bytes.split(b"\0", 1)[0].decode("ascii", "replace").strip()
