"""Frames on the line: COBS between zero bytes, a header, a CBOR payload, a CRC-32.

    00  COBS( version u8 | kind u8 | session u32 | sequence u32 | payload | crc u32 )  00

The checksum covers the schema hash and everything before it, so a peer with other messages cannot
be misunderstood. STOP and its acknowledgement are ten bytes with a layout of their own that no
later version may change:

    00  COBS( 'S' or 'A' | flags u8 | nonce u32 | crc u32 )  00        flags bit 0: emergency
"""

import struct
import zlib
from dataclasses import dataclass, fields

from cobs import cobs

from robot_bridge.protocol.messages import (
    BOOTSTRAP_KINDS,
    FROM_BRIDGE,
    PROTOCOL_VERSION,
)
from robot_bridge.protocol.packing import SCHEMA_HASH

FRAME_MAX = 2048  # encoded bytes between two delimiters; longer is noise
_HEADER = struct.Struct(">BBII")
_STOP = struct.Struct(">BBI")
_CRC = struct.Struct(">I")
_STOP_SEED = b"autospine stop"
_STOP_BYTE, _STOP_ACK_BYTE = ord("S"), ord("A")


class FrameError(ValueError):
    """Not a frame; `reason` is a short word for the counters."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class Frame:
    kind: int
    session: int
    sequence: int
    payload: bytes

    @property
    def from_bridge(self) -> bool:
        return bool(self.kind & FROM_BRIDGE)


@dataclass(frozen=True)
class StopFrame:
    nonce: int
    emergency: bool


@dataclass(frozen=True)
class StopAckFrame:
    nonce: int
    emergency: bool


AnyFrame = Frame | StopFrame | StopAckFrame


@dataclass
class FrameCounters:
    """What arrived since the start. `bad` is the sum of what was thrown away as no frame."""

    received: int = 0
    sent: int = 0
    bad: int = 0
    stale: int = 0
    own_echoes: int = 0
    malformed: int = 0
    wrong_session: int = 0
    resent: int = 0
    repeated: int = 0
    stops: int = 0

    def as_dict(self) -> dict[str, int]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def _delimited(raw: bytes) -> bytes:
    return b"\0" + cobs.encode(raw) + b"\0"


def _checksum(raw: bytes, kind: int) -> bytes:
    seed = b"" if kind in BOOTSTRAP_KINDS else SCHEMA_HASH
    return _CRC.pack(zlib.crc32(raw, zlib.crc32(seed)))


def encode(frame: Frame) -> bytes:
    raw = _HEADER.pack(PROTOCOL_VERSION, frame.kind, frame.session, frame.sequence)
    raw += frame.payload
    return _delimited(raw + _checksum(raw, frame.kind))


def encode_stop(nonce: int, emergency: bool) -> bytes:
    return _stop_bytes(_STOP_BYTE, nonce, emergency)


def encode_stop_ack(nonce: int, emergency: bool) -> bytes:
    return _stop_bytes(_STOP_ACK_BYTE, nonce, emergency)


def _stop_bytes(first: int, nonce: int, emergency: bool) -> bytes:
    raw = _STOP.pack(first, int(emergency), nonce)
    return _delimited(raw + _CRC.pack(zlib.crc32(_STOP_SEED + raw)))


def decode(encoded: bytes) -> AnyFrame:
    """The frame between two delimiters. Raises FrameError for anything that fails any check."""
    try:
        raw = cobs.decode(encoded)
    except cobs.DecodeError:
        raise FrameError("cobs") from None
    if len(raw) == _STOP.size + _CRC.size and raw[0] in (_STOP_BYTE, _STOP_ACK_BYTE):
        return _decode_stop(raw)
    if len(raw) < _HEADER.size + _CRC.size:
        raise FrameError("short")
    body, checksum = raw[: -_CRC.size], raw[-_CRC.size :]
    version, kind, session, sequence = _HEADER.unpack_from(body)
    if checksum != _checksum(body, kind):
        raise FrameError("checksum")
    if version != PROTOCOL_VERSION and kind not in BOOTSTRAP_KINDS:
        raise FrameError("version")
    return Frame(kind, session, sequence, body[_HEADER.size :])


def _decode_stop(raw: bytes) -> StopFrame | StopAckFrame:
    body, checksum = raw[: -_CRC.size], raw[-_CRC.size :]
    if checksum != _CRC.pack(zlib.crc32(_STOP_SEED + body)):
        raise FrameError("checksum")
    first, flags, nonce = _STOP.unpack(body)
    cls = StopFrame if first == _STOP_BYTE else StopAckFrame
    return cls(nonce, bool(flags & 1))


class Deframer:
    """Cuts a byte stream at its zero bytes and keeps what is a frame."""

    def __init__(self, counters: FrameCounters) -> None:
        self._counters = counters
        self._buffer = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[AnyFrame]:
        """The frames that `data` completes, in order; anything else is dropped and counted."""
        frames: list[AnyFrame] = []
        pieces = data.split(b"\0")
        for piece in pieces[:-1]:
            self._buffer += piece
            self._close(frames)
        self._buffer += pieces[-1]
        if len(self._buffer) > FRAME_MAX:
            self._overlong = True
            self._buffer.clear()
        return frames

    def _close(self, frames: list[AnyFrame]) -> None:
        encoded, overlong = bytes(self._buffer), self._overlong
        self._buffer.clear()
        self._overlong = False
        if overlong or len(encoded) > FRAME_MAX:
            self._counters.bad += 1
        elif encoded:
            try:
                frames.append(decode(encoded))
                self._counters.received += 1
            except FrameError:
                self._counters.bad += 1
