"""OpenIGTLink messages that are received: bytes in, messages out, no I/O.

What peers send is not trusted: a message whose CRC is wrong, whose version is not 1 or 2, or whose
body is over the limit is counted and passed over, and reading goes on at the next thing that looks
like a header. A STOP must get through behind any rubbish: it is looked for in everything that is
not part of a whole message, also while the rest of one that will never come is awaited.
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
    COMMAND_HEAD,
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
_LARGEST_STOP = 1024
_LOOKED_BACK = 64 * 1024
_MOST_TRIES = 16
_TYPE = re.compile(rb"[A-Z][A-Z0-9_]{1,11}\0*")
_STOP_TYPE = re.compile(rb"STRING\0{6}|COMMAND\0{5}")
_VERSIONS = (1, 2)
_PLAUSIBLE_VERSIONS = range(1, 10)
STOPS = ("STOP", "EMERGENCY")


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
        self._at = 0  # where in the stream `_waiting` begins
        self._skip = 0
        self._lost = False
        self._tries = 0
        self._stops = _StopsAhead()
        self.faults: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[Received]:
        """Take bytes; return the messages that are whole by now, in their order, and any STOP that
        stands behind them, whatever is awaited in front of it.
        """
        self._waiting += data
        self._stops.feed(data)
        return [*self._messages(), *self._stops.found()]

    @property
    def is_waiting(self) -> bool:
        """Whether the rest of a message is awaited."""
        return bool(self._waiting or self._skip)

    @property
    def front(self) -> int:
        """Changes whenever another message is awaited than before."""
        return self._at + self._skip

    def resume(self) -> list[Received]:
        """A message is awaited for long: give it up if whole ones come behind its start. A large
        one on a slow line contains none, and goes on being awaited.
        """
        return self.give_up() if self._skip or self._has_whole_ones() else []

    def give_up(self) -> list[Received]:
        """The rest of a message does not come: look for whole ones behind its start."""
        self._skip = 0
        if len(self._waiting) < HEADER.size:
            self._drop(len(self._waiting))
            return []
        self._find_header("cut off")
        return list(self._messages())

    def _messages(self) -> Iterator[Received]:
        while True:
            if self._skip:
                gone = min(self._skip, len(self._waiting))
                self._skip -= gone
                self._drop(gone)
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
            begun_at = self._at
            self._drop(HEADER.size + size)
            self._stops.whole_until(self._at)
            self._lost, self._tries = False, 0
            found = _received_if_sound(version, _text(kind), _text(device), body)
            if found is None:
                self.faults["meta-data"] += 1
            elif not (stop_word(found) and self._stops.was_heard(begun_at)):
                yield found

    def _find_header(self, fault: str) -> None:
        """Drop what stands before the next thing that could be a header; one fault until then.

        Who sends header after header that is none must not keep the room busy: after some of them
        everything that has come is dropped.
        """
        if not self._lost:
            self.faults[fault] += 1
            self._lost = True
        self._tries += 1
        if self._tries > _MOST_TRIES:
            self._tries = 0
            self._drop(len(self._waiting))
        else:
            self._drop(_next_header(bytes(self._waiting)))

    def _drop(self, number: int) -> None:
        del self._waiting[:number]
        self._at += number

    def _has_whole_ones(self) -> bool:
        """Among the newest bytes, behind the start of what is awaited."""
        newest = bytes(self._waiting[HEADER.size :][-_LOOKED_BACK:])
        tried = 0
        for match in _TYPE.finditer(newest, 2):
            start = match.start() - 2
            if tried == _MOST_TRIES or len(newest) < start + HEADER.size:
                break
            version, kind, _, _, size, crc = HEADER.unpack_from(newest, start)
            body = newest[start + HEADER.size : start + HEADER.size + size]
            if version in _VERSIONS and _TYPE.fullmatch(kind) and 0 < size == len(body):
                if crc64(body) == crc:
                    return True
                tried += 1
        return False


class _StopsAhead:
    """STOPs in what is not (yet) part of a whole message; each byte is looked at once or twice."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._at = 0
        self._heard_until = 0

    def feed(self, data: bytes) -> None:
        self._bytes += data

    def whole_until(self, at: int) -> None:
        """What came before this place of the stream was a message and said what it said."""
        self._drop(at - self._at)

    def was_heard(self, at: int) -> bool:
        return at < self._heard_until

    def found(self) -> Iterator[Received]:
        """Each once; what may still become one is kept."""
        keep_from = max(0, len(self._bytes) - HEADER.size + 1)
        for match in _STOP_TYPE.finditer(bytes(self._bytes), 2):
            start = match.start() - 2
            if len(self._bytes) < start + HEADER.size:
                break
            version, kind, device, _, size, crc = HEADER.unpack_from(self._bytes, start)
            if version not in _VERSIONS or size > _LARGEST_STOP:
                continue
            end = start + HEADER.size + size
            if len(self._bytes) < end:
                keep_from = min(keep_from, start)
                continue
            body = bytes(self._bytes[start + HEADER.size : end])
            said = _received_if_sound(version, _text(kind), _text(device), body)
            is_new = not self.was_heard(self._at + start)
            if is_new and said is not None and stop_word(said) and crc64(body) == crc:
                self._heard_until = self._at + end
                yield said
        self._drop(keep_from)

    def _drop(self, number: int) -> None:
        if number > 0:
            self._at += number
            del self._bytes[:number]


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


def _received_if_sound(version: int, kind: str, device: str, body: bytes) -> Received | None:
    """None where its meta-data lie; a STOP is one whatever they say."""
    try:
        return _received(version, kind, device, body)
    except MessageError:
        bare = Received(version, kind, device, body[EXTENDED_HEADER.size :])
        return bare if stop_word(bare) else None


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


def stop_word(message: Received) -> str:
    """STOP or EMERGENCY if the message says so, however it is addressed; else nothing."""
    try:
        text = _text_of(message).upper()
    except MessageError:
        return ""
    return text if text in STOPS else ""


def _text_of(message: Received) -> str:
    if message.kind == "STRING":
        return string_of(message)
    if message.kind == "COMMAND" and len(message.content) >= COMMAND_HEAD.size:
        _, name, _, _ = COMMAND_HEAD.unpack_from(message.content)
        return _text(name)
    return ""


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
