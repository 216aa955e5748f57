"""The first elements of an encoded data set, without decoding it.

Before Success is answered we look at no more than group 0008 up to the SOP Instance UID: enough to
refuse what is no data set at all, and a data set that contradicts the SOP class it came under.
"""

import struct
import zlib
from dataclasses import dataclass

from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ImplicitVRLittleEndian,
)

_SOP_CLASS, _SOP_INSTANCE = (0x0008, 0x0016), (0x0008, 0x0018)
_LONG_VRS = frozenset(
    (b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"UC", b"UN", b"UR", b"UT", b"SV", b"UV")
)
_SHORT_VRS = "AE AS AT CS DA DS DT FL FD IS LO LT PN SH SL SS ST TM UI UL US"
_VRS = _LONG_VRS | frozenset(map(str.encode, _SHORT_VRS.split(" ")))
_LOOK_AT_BYTES = 4096
_FIRST_GROUP = 0x0004  # 0000 and 0002 belong to commands and file meta, not to data sets


class NoDataSetError(ValueError):
    """The bytes do not begin as a data set in the negotiated transfer syntax would."""


@dataclass(frozen=True)
class Peeked:
    """What stands in the data set itself; empty where it has no such element early on."""

    sop_class_uid: str
    sop_instance_uid: str


def peek(data_set: bytes, transfer_syntax_uid: str) -> Peeked:
    """Read SOP class and instance UID of an encoded data set. Raises NoDataSetError."""
    head, size = data_set[:_LOOK_AT_BYTES], len(data_set)
    if transfer_syntax_uid == DeflatedExplicitVRLittleEndian:
        head, size = _inflated(head), 2**32
    if size < 8:
        raise NoDataSetError(f"the data set has {size} bytes")
    order = ">" if transfer_syntax_uid == ExplicitVRBigEndian else "<"
    found = _walk(head, size, order, transfer_syntax_uid != ImplicitVRLittleEndian)
    return Peeked(found.get(_SOP_CLASS, ""), found.get(_SOP_INSTANCE, ""))


def _inflated(head: bytes) -> bytes:
    try:
        return zlib.decompressobj(-zlib.MAX_WBITS).decompress(head, _LOOK_AT_BYTES)
    except zlib.error as error:
        raise NoDataSetError(f"not deflated data ({error})") from None


def _walk(head: bytes, size: int, order: str, explicit: bool) -> dict[tuple[int, int], str]:
    found: dict[tuple[int, int], str] = {}
    at, last = 0, (0, 0)
    while at + 8 <= len(head):
        tag: tuple[int, int] = struct.unpack_from(order + "HH", head, at)
        if tag <= last or tag[0] < _FIRST_GROUP:
            raise NoDataSetError(f"({tag[0]:04X},{tag[1]:04X}) cannot stand at byte {at}")
        length, value_at = _length(head, at, order, explicit)
        if length != 0xFFFFFFFF and value_at + length > size:
            raise NoDataSetError(f"the element at byte {at} extends past the end of the data set")
        if tag > _SOP_INSTANCE or length == 0xFFFFFFFF:
            break
        if tag in (_SOP_CLASS, _SOP_INSTANCE):
            found[tag] = head[value_at : value_at + length].decode("ascii", "replace").strip("\0 ")
        at, last = value_at + length, tag
    return found


def _length(head: bytes, at: int, order: str, explicit: bool) -> tuple[int, int]:
    """(length, where the value begins) of the element at `at`."""
    if not explicit:
        return struct.unpack_from(order + "L", head, at + 4)[0], at + 8
    vr = head[at + 4 : at + 6]
    if vr not in _VRS:
        raise NoDataSetError(f"{vr!r} at byte {at + 4} is not a value representation")
    if vr not in _LONG_VRS:
        return struct.unpack_from(order + "H", head, at + 6)[0], at + 8
    if at + 12 > len(head):
        raise NoDataSetError("the data set ends within its first elements")
    return struct.unpack_from(order + "L", head, at + 8)[0], at + 12
