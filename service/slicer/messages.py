"""OpenIGTLink messages as bytes: STATUS, TRANSFORM, POINT and IMAGE of protocol version 2.

A message is a header of 58 bytes and a body, both big-endian; the header holds a CRC-64 (ECMA-182)
of the body. Coordinates here are LPS mm, as everywhere in this software; on the wire they are RAS,
which is what receivers take for granted. Reference: openigtlink.org/protocols/v2_header.html.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dicom_slice.geometry import SliceGeometry

Array = NDArray[np.float64]

HEADER = struct.Struct(">H12s20sQQQ")
_VERSION = 1
_RAS, _LITTLE_ENDIAN, _FLOAT32 = 1, 2, 10
_POLYNOMIAL = 0x42F0E1EBA9EA3693
_BLOCK = 128
_TO_RAS = np.array([-1.0, -1.0, 1.0])

STATUS_OK, STATUS_NOT_READY = 1, 13


@dataclass(frozen=True)
class Point:
    """A named sphere; diameter 0 for a point. rgb: 0 to 255."""

    name: str
    patient_mm: tuple[float, float, float]
    diameter_mm: float = 0.0
    rgb: tuple[int, int, int] = (255, 255, 0)
    group: str = ""


def message(kind: str, device: str, at_s: float, body: bytes) -> bytes:
    """One whole message; at_s: seconds since 1970, of what the body shows."""
    seconds = int(at_s)
    stamp = seconds << 32 | int((at_s - seconds) * 2**32)
    head = HEADER.pack(_VERSION, kind.encode(), _text(device, 20), stamp, len(body), crc64(body))
    return head + body


def status(device: str, at_s: float, code: int, name: str, text: str) -> bytes:
    """code: STATUS_OK or another of the protocol's; name: of the state, in a word."""
    return message(
        "STATUS", device, at_s, struct.pack(">Hq20s", code, 0, _text(name, 20)) + _ended(text)
    )


def transform(device: str, at_s: float, axes: ArrayLike, origin_mm: ArrayLike) -> bytes:
    """axes: (3, 3), its columns the tool's axes in the patient; origin_mm: of the tool. LPS."""
    columns = (np.asarray(axes, float) * _TO_RAS[:, None]).T
    origin = np.asarray(origin_mm, float) * _TO_RAS
    return message("TRANSFORM", device, at_s, _floats(np.vstack([columns, origin])))


def points(device: str, at_s: float, shown: Sequence[Point]) -> bytes:
    """A list of points; an empty one says that there are none."""
    body = b"".join(
        struct.pack(">64s32s4B", _text(one.name, 64), _text(one.group, 32), *one.rgb, 255)
        + _floats([*(np.array(one.patient_mm) * _TO_RAS), one.diameter_mm])
        + bytes(20)
        for one in shown
    )
    return message("POINT", device, at_s, body)


def image(device: str, at_s: float, pixels: NDArray[np.floating], geometry: SliceGeometry) -> bytes:
    """One slice, (rows, cols), as 32-bit floats with its place in the patient."""
    rows, cols = geometry.shape
    between_rows, between_cols = geometry.spacing_mm
    centre = geometry.patient_from_pixel([(rows - 1) / 2, (cols - 1) / 2])
    vectors = [
        np.array(geometry.col_direction) * between_cols,
        np.array(geometry.row_direction) * between_rows,
        geometry.normal,
        centre,
    ]
    head = struct.pack(">HBBBB3H", 1, 1, _FLOAT32, _LITTLE_ENDIAN, _RAS, cols, rows, 1)
    part = struct.pack(">6H", 0, 0, 0, cols, rows, 1)
    return message(
        "IMAGE",
        device,
        at_s,
        head + _floats(np.array(vectors) * _TO_RAS) + part + pixels.astype("<f4").tobytes(),
    )


def crc64(body: bytes) -> int:
    """CRC-64 of ECMA-182: most significant bit first, starting from 0.

    Byte by byte an image would take the interpreter milliseconds. So blocks of equal length are
    taken side by side, and then put together: with start 0 the remainder is linear in the bits.
    """
    table, advanced = _tables()
    blocks = np.frombuffer(bytes(-len(body) % _BLOCK) + body, np.uint8).reshape(-1, _BLOCK)
    parts = np.zeros(len(blocks), np.uint64)
    for column in blocks.T:  # zeros in front change nothing
        index = (parts >> np.uint64(56)).astype(np.uint8) ^ column
        parts = (parts << np.uint64(8)) ^ table[index]
    remainder = 0
    for part in parts.tolist():
        for k in range(8):
            part ^= advanced[k][remainder >> 8 * k & 0xFF]
        remainder = part
    return remainder


@lru_cache(maxsize=1)
def _tables() -> tuple[NDArray[np.uint64], list[list[int]]]:
    """Remainder of each byte, and of each byte k places up with a block of zeros behind it."""
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
    return np.array(table, np.uint64), advanced


def _floats(values: ArrayLike) -> bytes:
    return np.asarray(values, ">f4").tobytes()


def _text(text: str, size: int) -> bytes:
    """ASCII, cut to leave the zero at the end that receivers look for."""
    return text.encode("ascii", "replace")[: size - 1]


def _ended(text: str) -> bytes:
    return text.encode("ascii", "replace") + b"\0"
