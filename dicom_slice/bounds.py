"""What a file may cost before it is read: found by walking over its bytes, not by decoding them.

pydicom inflates a deflated data set whole (1 MB of it may be 2 GiB) and makes an object of every
item of a sequence (8 bytes of it become a kilobyte). So both are counted first, in bounded memory.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from functools import lru_cache
from pathlib import Path

from dicom_slice.reasons import Reason, UnusableError

MOST_INFLATED_BYTES = 128 * 2**20
MOST_HEADER_BYTES = 32 * 2**20
MOST_ELEMENTS = 400_000
MOST_ITEMS = 50_000
DEEPEST = 32
_DEFLATED, _IMPLICIT, _BIG_ENDIAN = (
    b"1.2.840.10008.1.2.1.99",
    b"1.2.840.10008.1.2",
    b"1.2.840.10008.1.2.2",
)
_PIXELS = frozenset((0x7FE00008, 0x7FE00009, 0x7FE00010))
_ITEM, _ITEM_END, _SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
_UNDEFINED = 0xFFFFFFFF
_LONG_VRS = frozenset(
    (b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"UC", b"UN", b"UR", b"UT", b"SV", b"UV")
)
Bytes = bytes | mmap.mmap


def check_bounds(path: Path) -> None:
    """Raise UnusableError (too_large) for a Part 10 file that would cost too much to read."""
    at = path.stat()
    refusal = _refusal(path, at.st_mtime_ns, at.st_size)
    if refusal:
        raise UnusableError(Reason.TOO_LARGE, f"{path}: {refusal}")


@lru_cache(maxsize=256)
def _refusal(path: Path, mtime_ns: int, size: int) -> str:
    """Why it is not read, or an empty text; the rest of the arguments make the key."""
    if size < 144:
        return ""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        syntax, start = _syntax(data)
        if not syntax:
            return ""
        if syntax != _DEFLATED:
            return _why_too_much(data, start, syntax)
        inflated = _inflated(data, start)
    if len(inflated) > MOST_INFLATED_BYTES:
        return f"it inflates to more than {MOST_INFLATED_BYTES // 2**20} MiB"
    return _why_too_much(inflated, 0, syntax)


def _syntax(data: Bytes) -> tuple[bytes, int]:
    """Transfer syntax and where the data set begins; an empty one where that is not plain."""
    if data[128:132] != b"DICM" or data[132:138] != b"\x02\x00\x00\x00UL":
        return b"", 0
    end = 144 + int(struct.unpack_from("<L", data, 140)[0])
    at = 144
    while at + 12 <= min(end, len(data)):
        tag, vr = struct.unpack_from("<L", data, at)[0], data[at + 4 : at + 6]
        length, value_at = _length(data, at, "<", explicit=True)
        if tag == 0x00100002:  # (0002,0010), as little endian halves stand
            return data[value_at : value_at + length].rstrip(b"\0 "), end
        if vr == b"\0\0" or length == _UNDEFINED:
            break
        at = value_at + length
    return b"", 0


def _inflated(data: Bytes, start: int) -> bytes:
    """No more than one byte over the limit; what is damaged is left to whoever reads it."""
    try:
        return zlib.decompressobj(-zlib.MAX_WBITS).decompress(data[start:], MOST_INFLATED_BYTES + 1)
    except zlib.error:
        return b""


def _why_too_much(data: Bytes, start: int, syntax: bytes) -> str:
    order = ">" if syntax == _BIG_ENDIAN else "<"
    return _Walk(data, order, explicit=syntax != _IMPLICIT).refusal(start)


class _Walk:
    """Over elements and items, down into sequences, up to the pixels of the image itself."""

    def __init__(self, data: Bytes, order: str, *, explicit: bool) -> None:
        self._data = data
        self._order = order
        self._explicit = explicit
        self._item_start = struct.pack(order + "HH", 0xFFFE, 0xE000)
        self._ends: list[int] = []
        self._elements = self._items = 0

    def refusal(self, at: int) -> str:
        start, size = at, len(self._data)
        while at + 8 <= size:
            while self._ends and at >= self._ends[-1]:
                self._ends.pop()
            following = self._step(at)
            if following is None:
                break
            at = following
            if len(self._ends) > 2 * DEEPEST:
                return f"sequences nested more than {DEEPEST} deep"
            if self._items > MOST_ITEMS:
                return f"more than {MOST_ITEMS} sequence items"
            if self._elements > MOST_ELEMENTS:
                return f"more than {MOST_ELEMENTS} elements"
        header_bytes = min(at, size) - start
        if header_bytes > MOST_HEADER_BYTES:
            return f"{header_bytes // 2**20} MiB besides the pixels"
        return ""

    def _step(self, at: int) -> int | None:
        """Where the next element begins; None at the pixels, and where it makes no sense."""
        group, element = struct.unpack_from(self._order + "HH", self._data, at)
        tag = group << 16 | element
        if tag in (_ITEM_END, _SEQUENCE_END):
            if self._ends:
                self._ends.pop()
            return at + 8
        if tag == _ITEM:
            self._items += 1
            length = struct.unpack_from(self._order + "L", self._data, at + 4)[0]
            return self._into(at + 8, length)
        if tag in _PIXELS and not self._ends:
            return None
        self._elements += 1
        try:
            length, value_at = _length(self._data, at, self._order, explicit=self._explicit)
        except struct.error:
            return None
        if length == _UNDEFINED or self._data[value_at : value_at + 4] == self._item_start:
            return self._into(value_at, length)
        return value_at + length

    def _into(self, at: int, length: int) -> int:
        self._ends.append(len(self._data) + 1 if length == _UNDEFINED else at + length)
        return at


def _length(data: Bytes, at: int, order: str, *, explicit: bool) -> tuple[int, int]:
    """(length, where the value begins) of the element at `at`."""
    if not explicit:
        return struct.unpack_from(order + "L", data, at + 4)[0], at + 8
    if data[at + 4 : at + 6] not in _LONG_VRS:
        return struct.unpack_from(order + "H", data, at + 6)[0], at + 8
    return struct.unpack_from(order + "L", data, at + 8)[0], at + 12
