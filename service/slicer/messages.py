"""OpenIGTLink messages that are sent: STATUS, STRING, TRANSFORM, POINT and IMAGE.

A message is a header of 58 bytes and a body, both big-endian; the header holds a CRC-64 (ECMA-182)
of the body. A body of version 2 has an extended header before and meta-data behind its content.
Coordinates here are LPS mm, as everywhere in this software; on the wire they are RAS, which is what
receivers take for granted. Reference: openigtlink.org/protocols/v2_header.html, v3_header.html.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dicom_slice.geometry import SliceGeometry

Array = NDArray[np.float64]

HEADER = struct.Struct(">H12s20sQQQ")
EXTENDED_HEADER = struct.Struct(">HHII")
META_ENTRY = struct.Struct(">HHI")
POINT_HEAD = struct.Struct(">64s32s4B")
POINT_BYTES = POINT_HEAD.size + 16 + 20
STATUS_HEAD = struct.Struct(">Hq20s")
STRING_HEAD = struct.Struct(">HH")
COMMAND_HEAD = struct.Struct(">I128sHI")
US_ASCII = 3
# keys of meta-data: receivers copy them to what they show
TRANSFORM_STATUS, IMAGE_STATUS = "TransformStatus", "ImageStatus"
VALID, INVALID = "OK", "INVALID"
DEVICE_BYTES = 20
TO_RAS = np.array([-1.0, -1.0, 1.0])
_RAS, _LITTLE_ENDIAN, _FLOAT32 = 1, 2, 10
_POLYNOMIAL = 0x42F0E1EBA9EA3693
_BLOCK = 128
_SHORT = 512

STATUS_OK, STATUS_PANIC, STATUS_ACCESS_DENIED = 1, 3, 5
STATUS_CONFIGURATION_ERROR, STATUS_UNKNOWN_INSTRUCTION, STATUS_NOT_READY = 10, 12, 13
STATUS_MANUAL, STATUS_HARDWARE_FAILURE = 14, 18


@dataclass(frozen=True)
class Message:
    """at_s: seconds since 1970, of what the content shows; meta: text by name, version 2 only."""

    kind: str
    device: str
    at_s: float
    content: bytes
    meta: Mapping[str, str] = field(default_factory=dict)

    @property
    def withdraws(self) -> bool:
        """Whether it says that there is nothing (any more) under its device name."""
        empty = self.kind == "POINT" and not self.content
        return empty or INVALID in (self.meta.get(TRANSFORM_STATUS), self.meta.get(IMAGE_STATUS))

    def encoded(self, version: int = 2) -> bytes:
        """The whole message with its header, in version 1 or 2 of the protocol.

        Version 1 has no meta-data: a transform that is withdrawn is no number there, and an empty
        list, which would be a body of no bytes, goes in version 2 also to readers of version 1:
        they find no point in its 40 bytes.
        """
        if version == 1 and self.withdraws and self.kind != "IMAGE":
            if self.kind == "POINT":
                return self.encoded(2)
            return replace(self, content=_floats([np.nan] * 12), meta={}).encoded(1)
        body = self.content if version == 1 else self._extended()
        seconds = int(self.at_s)
        stamp = seconds << 32 | int((self.at_s - seconds) * 2**32)
        kind, device = self.kind.encode(), ascii_text(self.device, DEVICE_BYTES)
        return HEADER.pack(version, kind, device, stamp, len(body), crc64(body)) + body

    def _extended(self) -> bytes:
        pairs = [(_ascii(name), _ascii(value)) for name, value in self.meta.items()]
        entries = b"".join(META_ENTRY.pack(len(n), US_ASCII, len(v)) for n, v in pairs)
        index = struct.pack(">H", len(pairs)) + entries
        meta = b"".join(name + value for name, value in pairs)
        head = EXTENDED_HEADER.pack(EXTENDED_HEADER.size, len(index), len(meta), 0)
        return head + self.content + index + meta


@dataclass(frozen=True)
class Point:
    """A named sphere; diameter 0 for a point. rgb: 0 to 255."""

    name: str
    patient_mm: tuple[float, float, float]
    diameter_mm: float = 0.0
    rgb: tuple[int, int, int] = (255, 255, 0)
    group: str = ""


def status(
    device: str, at_s: float, code: int, name: str, text: str, *, subcode: int = 0
) -> Message:
    """code: STATUS_OK or another of the protocol's; name: of the state, in a word."""
    content = STATUS_HEAD.pack(code, subcode, ascii_text(name, 20)) + _ascii(text) + b"\0"
    return Message("STATUS", device, at_s, content)


def string(device: str, at_s: float, text: str) -> Message:
    encoded = _ascii(text)
    return Message("STRING", device, at_s, STRING_HEAD.pack(US_ASCII, len(encoded)) + encoded)


def transform(
    device: str,
    at_s: float,
    axes: ArrayLike,
    origin_mm: ArrayLike,
    meta: Mapping[str, str] | None = None,
) -> Message:
    """axes: (3, 3), its columns the tool's axes in the patient; origin_mm: of the tool. LPS."""
    columns = (np.asarray(axes, float) * TO_RAS[:, None]).T
    origin = np.asarray(origin_mm, float) * TO_RAS
    return Message("TRANSFORM", device, at_s, _floats(np.vstack([columns, origin])), meta or {})


def points(
    device: str, at_s: float, shown: Sequence[Point], meta: Mapping[str, str] | None = None
) -> Message:
    """A list of points; an empty one says that there are none.

    Receivers built on the official library take an empty list only in version 2, and only with
    some meta-data: there is always its length.
    """
    content = b"".join(
        POINT_HEAD.pack(ascii_text(one.name, 64), ascii_text(one.group, 32), *one.rgb, 255)
        + _floats([*(np.array(one.patient_mm) * TO_RAS), one.diameter_mm])
        + bytes(20)
        for one in shown
    )
    return Message("POINT", device, at_s, content, {"PointCount": str(len(shown)), **(meta or {})})


def image(
    device: str,
    at_s: float,
    pixels: NDArray[np.floating],
    geometry: SliceGeometry,
    thickness_mm: float = 1.0,
    meta: Mapping[str, str] | None = None,
) -> Message:
    """One slice, (rows, cols), as 32-bit floats with its place in the patient."""
    rows, cols = geometry.shape
    between_rows, between_cols = geometry.spacing_mm
    centre = geometry.patient_from_pixel([(rows - 1) / 2, (cols - 1) / 2])
    vectors = [
        np.array(geometry.col_direction) * between_cols,
        np.array(geometry.row_direction) * between_rows,
        geometry.normal * thickness_mm,
        centre,
    ]
    head = struct.pack(">HBBBB3H", 1, 1, _FLOAT32, _LITTLE_ENDIAN, _RAS, cols, rows, 1)
    part = struct.pack(">6H", 0, 0, 0, cols, rows, 1)
    content = head + _floats(np.array(vectors) * TO_RAS) + part + pixels.astype("<f4").tobytes()
    return Message("IMAGE", device, at_s, content, meta or {})


def crc64(body: bytes) -> int:
    """CRC-64 of ECMA-182: most significant bit first, starting from 0.

    Byte by byte an image would take the interpreter milliseconds. So blocks of equal length are
    taken side by side, and then put together: with start 0 the remainder is linear in the bits.
    For a few bytes the other way is the faster one.
    """
    numbers, table, advanced = _tables()
    remainder = 0
    if len(body) <= _SHORT:
        for byte in body:
            remainder = (remainder << 8 & 2**64 - 1) ^ numbers[remainder >> 56 ^ byte]
        return remainder
    blocks = np.frombuffer(bytes(-len(body) % _BLOCK) + body, np.uint8).reshape(-1, _BLOCK)
    parts = np.zeros(len(blocks), np.uint64)
    for column in blocks.T:  # zeros in front change nothing
        index = (parts >> np.uint64(56)).astype(np.uint8) ^ column
        parts = (parts << np.uint64(8)) ^ table[index]
    for part in parts.tolist():
        for k in range(8):
            part ^= advanced[k][remainder >> 8 * k & 0xFF]
        remainder = part
    return remainder


@lru_cache(maxsize=1)
def _tables() -> tuple[list[int], NDArray[np.uint64], list[list[int]]]:
    """Remainder of each byte (twice), and of each byte k places up with a block of zeros behind."""
    table = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = value << 1 ^ (_POLYNOMIAL if value >> 63 else 0)
            value &= 2**64 - 1
        table.append(value)
    advanced = []
    for k in range(8):
        row = []
        for byte in range(256):
            value = byte << 8 * k
            for _ in range(_BLOCK):
                value = (value << 8 & 2**64 - 1) ^ table[value >> 56]
            row.append(value)
        advanced.append(row)
    return table, np.array(table, np.uint64), advanced


def ascii_text(text: str, size: int) -> bytes:
    """ASCII, cut to leave the zero at the end that receivers look for."""
    return _ascii(text)[: size - 1]


def _ascii(text: str) -> bytes:
    return text.encode("ascii", "replace")


def _floats(values: ArrayLike) -> bytes:
    return np.asarray(values, ">f4").tobytes()
