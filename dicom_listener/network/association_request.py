"""What senders put into an A-ASSOCIATE-RQ, made readable for pynetdicom. Bytes in, bytes out.

Real devices pad AE titles with NUL, leave them blank, write them in Latin-1, and add items that
nobody knows. DCMTK takes all of that; pynetdicom would end the association without a word. Layout:
PS3.8 section 9.3.2 and annex D.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

BLANK = "(BLANK)"
_HEAD_BYTES = 74  # type to the reserved bytes before the first item
_VERSION, _CALLED, _CALLING = slice(6, 8), slice(10, 26), slice(26, 42)
_CONTEXT, _USER_INFORMATION = 0x20, 0x50
_CLASS_UID, _VERSION_NAME = 0x52, 0x55
_KNOWN_USER_ITEMS = range(0x51, 0x5A)
_LONGEST_UID, _LONGEST_NAME = 64, 16


class MalformedRequestError(ValueError):
    """The request cannot be read; the text says what is wrong with it."""


@dataclass
class Mended:
    """The request as pynetdicom can read it, and what was done to it, in words."""

    pdu: bytes = b""
    remarks: list[str] = field(default_factory=list)


def mended_request(pdu: bytes) -> Mended:
    """Return the request with what no reader needs left out or put right.

    Raises MalformedRequestError where items overrun each other, or no presentation context is left.
    """
    if len(pdu) < _HEAD_BYTES:
        raise MalformedRequestError(f"an association request of {len(pdu)} bytes")
    mended = Mended()
    head = bytearray(pdu[:_HEAD_BYTES])
    if speaks_our_version(pdu):
        head[_VERSION] = b"\0\1"
    head[_CALLED] = _padded(readable_ae_title(bytes(head[_CALLED])))
    head[_CALLING] = _padded(readable_ae_title(bytes(head[_CALLING])))
    items = b"".join(_mended_items(pdu, mended))
    mended.pdu = bytes(head[:2]) + struct.pack(">L", len(head) - 6 + len(items))
    mended.pdu += bytes(head[6:]) + items
    return mended


def speaks_our_version(pdu: bytes) -> bool:
    """Whether version 1 of the protocol is among those that the sender speaks (one bit each)."""
    return bool(pdu[_VERSION.stop - 1] & 1)


def readable_ae_title(raw: bytes) -> str:
    """As C programs read it, up to the first NUL; what is no printable ASCII becomes `?`."""
    text = raw.split(b"\0")[0].decode("latin-1")
    text = "".join(c if " " <= c <= "~" and c != "\\" else "?" for c in text).strip()
    return text or BLANK


def _padded(title: str) -> bytes:
    return title.encode("ascii").ljust(_LONGEST_NAME)


def _items(body: bytes, first: int) -> Iterator[tuple[int, bytes]]:
    """(type, value) of each item from byte `first` on."""
    at = first
    while at < len(body):
        if at + 4 > len(body):
            raise MalformedRequestError(f"half an item header at byte {at}")
        kind, _, size = struct.unpack_from(">BBH", body, at)
        if at + 4 + size > len(body):
            raise MalformedRequestError(f"item 0x{kind:02X} at byte {at} is cut off")
        yield kind, body[at + 4 : at + 4 + size]
        at += 4 + size


def _item(kind: int, value: bytes) -> bytes:
    return struct.pack(">BBH", kind, 0, len(value)) + value


def _mended_items(pdu: bytes, mended: Mended) -> Iterator[bytes]:
    contexts = 0
    for kind, value in _items(pdu, _HEAD_BYTES):
        if kind == _CONTEXT:
            if not value or value[0] % 2 == 0:
                number = value[0] if value else "none"
                mended.remarks.append(
                    f"presentation context {number} left out: its number must be odd"
                )
                continue
            contexts += 1
            yield _item(kind, value)
        elif kind == _USER_INFORMATION:
            yield _item(kind, b"".join(_mended_user_items(value, mended)))
        else:
            yield _item(kind, value)
    if not contexts:
        found = "; ".join(mended.remarks) or "none were proposed"
        raise MalformedRequestError(f"no presentation context can be used: {found}")


def _mended_user_items(body: bytes, mended: Mended) -> Iterator[bytes]:
    for kind, value in _items(body, 0):
        if kind not in _KNOWN_USER_ITEMS:
            mended.remarks.append(f"unknown user information item 0x{kind:02X} left out")
        elif kind == _CLASS_UID:
            uid = value.rstrip(b"\0 ")
            if 0 < len(uid) <= _LONGEST_UID and set(uid) <= set(b"0123456789."):
                yield _item(kind, uid)
            else:
                mended.remarks.append(f"implementation class UID of {len(uid)} bytes left out")
        elif kind == _VERSION_NAME:
            yield _item(kind, readable_ae_title(value)[:_LONGEST_NAME].encode("ascii"))
        else:
            yield _item(kind, value)
