"""Messages into CBOR and back, strictly: a field of another type, a missing or an extra one is a
MessageError. The schema's hash is part of every frame's checksum.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import fields
from enum import StrEnum
from typing import Any

import cbor2

from robot_bridge.protocol.messages import (
    MESSAGES,
    PROTOCOL_VERSION,
    TEXT_MAX,
    AxisTravel,
    Message,
)

INT_MAX = 2**53
SETPOINT_MAX_UM = 2**31 - 1


class MessageError(ValueError):
    """The payload is not a message of this schema."""


def _integer(value: Any) -> int:
    if type(value) is not int or not -INT_MAX <= value <= INT_MAX:
        raise MessageError(f"{value!r} is not an integer in range")
    return value


def _boolean(value: Any) -> bool:
    if type(value) is not bool:
        raise MessageError(f"{value!r} is not a boolean")
    return value


def _text(value: Any) -> str:
    if type(value) is not str or len(value) > TEXT_MAX:
        raise MessageError(f"{str(value)[:40]!r} is not text of at most {TEXT_MAX} characters")
    return value


def _text_or_none(value: Any) -> str | None:
    return None if value is None else _text(value)


def _positions(value: Any) -> dict[str, int]:
    if not isinstance(value, Mapping) or len(value) > 32:
        raise MessageError("positions are not a map of at most 32 axes")
    for axis, position_um in value.items():
        _text(axis)
        if type(position_um) is not int or not abs(position_um) <= SETPOINT_MAX_UM:
            raise MessageError(f"axis {axis[:40]}: {position_um!r} is not an integer micrometre")
    return dict(value)


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or len(value) > 32:
        raise MessageError("names are not a list of at most 32")
    return tuple(_text(name) for name in value)


def _axes(value: Any) -> tuple[AxisTravel, ...]:
    if not isinstance(value, list | tuple) or any(len(axis) != 4 for axis in value):
        raise MessageError("axes are not a list of (name, min, max, tolerance)")
    return tuple(
        AxisTravel(_text(n), _integer(lo), _integer(hi), _integer(tolerance))
        for n, lo, hi, tolerance in value
    )


_CHECKS: dict[Any, Callable[[Any], Any]] = {
    int: _integer,
    bool: _boolean,
    str: _text,
    str | None: _text_or_none,
    dict[str, int]: _positions,
    tuple[AxisTravel, ...]: _axes,
    tuple[str, ...]: _names,
}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and value and isinstance(value[0], str):
        return [str(name) for name in value]
    if isinstance(value, tuple):
        return [[axis.name, axis.min_um, axis.max_um, axis.tolerance_um] for axis in value]
    return str(value) if isinstance(value, StrEnum) else value


def pack(message: Message) -> bytes:
    """The CBOR payload. Raises MessageError if a field is not what the schema says."""
    plain = [_plain(getattr(message, column.name)) for column in fields(message)]
    for column, value in zip(fields(message), plain, strict=True):
        _checked(type(message), column.name, column.type, value)
    return cbor2.dumps(plain)


def unpack(kind: int, payload: bytes) -> Message:
    """The message of type `kind`. Raises MessageError for anything that is not exactly one."""
    cls = MESSAGES.get(kind)
    if cls is None:
        raise MessageError(f"message type 0x{kind:02x} is not known")
    try:
        values = cbor2.loads(payload)
    except Exception as error:  # cbor2 raises several unrelated types on bad input
        raise MessageError(f"{cls.__name__}: payload is not CBOR ({error})") from error
    names = fields(cls)
    if not isinstance(values, list) or len(values) != len(names):
        raise MessageError(f"{cls.__name__}: payload is not a list of {len(names)} fields")
    checked = [_checked(cls, f.name, f.type, v) for f, v in zip(names, values, strict=True)]
    return cls(*checked)


def _checked(cls: type[Message], name: str, kind: Any, value: Any) -> Any:
    try:
        return _CHECKS[kind](value)
    except MessageError as error:
        raise MessageError(f"{cls.__name__}.{name}: {error}") from None


def schema_text() -> str:
    """One line a message: type byte, name, fields in order with their types."""
    lines = [f"protocol {PROTOCOL_VERSION}"]
    for kind, cls in sorted(MESSAGES.items()):
        columns = ", ".join(f"{column.name}: {_type_name(column.type)}" for column in fields(cls))
        lines.append(f"0x{kind:02x} {cls.__name__}({columns})")
    return "\n".join(lines)


def _type_name(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


SCHEMA_HASH = hashlib.sha256(schema_text().encode()).digest()[:8]
SCHEMA = SCHEMA_HASH.hex()
