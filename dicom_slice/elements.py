"""Tolerant, early reading of DICOM values: every needed element is touched here or not at all.

Scanners write DS of more than 16 characters, IS with decimals, UIDs with leading zeros. What has
one plain reading is read, with a warning kept beside it; what has none is absent, also with one.
"""

import math
from collections.abc import Callable
from itertools import islice
from typing import Any

from pydicom.datadict import keyword_for_tag, tag_for_keyword
from pydicom.dataset import Dataset
from pydicom.tag import Tag

_MOST_ITEMS = 1_000  # as many as frames are taken
Key = str | tuple[int, int]


class Elements:
    """One data set with a list of warnings about what was odd in it."""

    def __init__(self, data_set: Dataset, warnings: list[str] | None = None) -> None:
        self.data_set = data_set
        self.warnings: list[str] = warnings if warnings is not None else []

    def _within(self, data_set: Dataset) -> "Elements":
        return Elements(data_set, self.warnings)

    def raw(self, key: Key) -> Any:
        """The value, or None where the element is absent, empty or beyond reading."""
        tag = Tag(tag_for_keyword(key) if isinstance(key, str) else key)
        if tag not in self.data_set:
            return None
        try:
            value = self.data_set[tag].value
        except Exception as error:  # a value of any VR may be damaged in any way
            text = self._undecoded_text(tag)
            if text is None:
                self.warnings.append(f"{_name(key)} cannot be read ({_one_line(error)})")
                return None
            self.warnings.append(f"{_name(key)} does not match its VR: {text[:32]!r}")
            return text.split("\\") if "\\" in text else text
        if value is None or (hasattr(value, "__len__") and len(value) == 0):
            return None
        return value

    def _undecoded_text(self, tag: Any) -> str | None:
        """Text of an element that pydicom could not convert, where it is plain text at all."""
        value = self.data_set.get_item(tag).value
        if not isinstance(value, bytes):
            return None
        text = value.decode("ascii", "replace").strip(" \0")
        return text if text.isprintable() and "\ufffd" not in text else None

    def text(self, key: Key) -> str:
        """Text without padding; the first value of several; empty where there is none."""
        values = self.texts(key)
        return values[0] if values else ""

    def texts(self, key: Key) -> tuple[str, ...]:
        value = self.raw(key)
        if value is None:
            return ()
        values = [value] if isinstance(value, str) or not hasattr(value, "__iter__") else value
        return tuple(str(v).strip(" \0") for v in values)

    def numbers(self, key: Key) -> tuple[float, ...]:
        """Finite numbers; () where the element is absent or any value is not one."""
        value = self.raw(key)
        if value is None:
            return ()
        try:
            numbers = plain_numbers(value)
        except (TypeError, ValueError):
            self.warnings.append(f"{_name(key)} is not a number: {str(value)[:32]!r}")
            return ()
        if not all(map(math.isfinite, numbers)):
            self.warnings.append(f"{_name(key)} is not finite")
            return ()
        return numbers

    def shown(self, key: Key) -> str:
        """The value as it stands there, for people; empty where there is none."""
        value = self.raw(key)
        return "" if value is None else "\\".join(self.texts(key))[:48]

    def number(self, key: Key) -> float | None:
        numbers = self.numbers(key)
        return numbers[0] if numbers else None

    def integer(self, key: Key) -> int | None:
        number = self.number(key)
        if number is None:
            return None
        if number != int(number):
            self.warnings.append(f"{_name(key)} is {number}, not an integer")
            return None
        return int(number)

    def items(self, key: Key) -> list["Elements"]:
        """The items of a sequence; [] where it is absent or broken."""
        value = self.raw(key)
        if value is None or isinstance(value, (str, bytes)):
            return []
        try:
            items = [item for item in islice(value, _MOST_ITEMS) if isinstance(item, Dataset)]
            return [self._within(item) for item in items]
        except TypeError:
            return []


def plain_numbers(value: Any) -> tuple[float, ...]:
    """The numbers of a DICOM value of any VR that can only mean one thing.

    Text is split at backslashes; a comma stands for the decimal point where no point does (1,5),
    and between values where each has a point of its own (1.0,1.5). Raises ValueError, TypeError.
    """
    parts = value.split("\\") if isinstance(value, str) else value
    if not hasattr(parts, "__iter__"):
        parts = [parts]
    numbers: list[float] = []
    for part in parts:
        text = part.strip(" \0") if isinstance(part, str) else ""
        pieces = text.split(",")
        if len(pieces) == 2 and "." not in text:
            numbers.append(float(".".join(pieces)))
        elif len(pieces) > 1 and all("." in piece for piece in pieces):
            numbers += map(float, pieces)
        else:
            numbers.append(float(part))
    return tuple(numbers)


class FrameElements:
    """What holds for one frame: its own functional groups, then the shared ones, then the top."""

    def __init__(self, top: Elements, groups: list[Elements]) -> None:
        self.top = top
        self._groups = groups

    def find(self, sequence: Key, read: Callable[[Elements], Any]) -> Any:
        """First non-empty value in `sequence` of the functional groups, else of the top level."""
        for group in self._groups:
            for item in group.items(sequence):
                value = read(item)
                if value not in (None, "", ()):
                    return value
        return read(self.top)


def frame_elements(top: Elements, frame: int) -> FrameElements:
    """Functional groups of the frame with this index (0 first), if the object has any."""
    groups = []
    own = top.items("PerFrameFunctionalGroupsSequence")
    if frame < len(own):
        groups.append(own[frame])
    groups += top.items("SharedFunctionalGroupsSequence")[:1]
    return FrameElements(top, groups)


def _name(key: Key) -> str:
    return key if isinstance(key, str) else keyword_for_tag(key) or f"({key[0]:04X},{key[1]:04X})"


def _one_line(error: Exception) -> str:
    return str(error).splitlines()[0][:80] if str(error) else type(error).__name__
