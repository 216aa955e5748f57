"""Files that a user names on the command line: read, or refused in one line."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from dicom_slice.geometry import SliceGeometry
from dicom_slice.header import Slice
from dicom_slice.read import dicom_files
from dicom_slice.reasons import UnusableError
from room_config.exit_codes import BAD_INPUT

_COLUMNS = ("file", "row_px", "col_px")


class BadFileError(Exception):
    """A file or option cannot be used; the text is one line that names it."""

    exit_code = BAD_INPUT


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files named, and those in the folders named."""
    try:
        return dicom_files(list(paths))
    except UnusableError as error:
        raise BadFileError(str(error)) from None


def geometry_of(header: Slice, file: Path) -> SliceGeometry:
    """Return where the slice lies in the patient, or refuse the file."""
    if header.geometry is None:
        raise BadFileError(f"{file}: {header.geometry_problem}")
    return header.geometry


def read_shift_table(path: Path) -> dict[str, tuple[float, float]]:
    """Return file name -> displacement (row, col) px from a CSV with `file,row_px,col_px`."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadFileError(f"{path}: cannot be read ({error})") from None
    shifts: dict[str, tuple[float, float]] = {}
    for number, row in enumerate(rows, start=2):
        missing = [name for name in _COLUMNS if not row.get(name)]
        if missing:
            raise BadFileError(f"{path}: line {number}: column {missing[0]} is missing")
        name = Path(row["file"]).name
        if name in shifts:
            raise BadFileError(f"{path}: line {number}: {name} appears twice")
        shifts[name] = (_number(row, "row_px", path, number), _number(row, "col_px", path, number))
    if not shifts:
        raise BadFileError(f"{path}: has no rows")
    return shifts


def _number(row: dict[str, str], name: str, path: Path, line: int) -> float:
    try:
        value = float(row[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadFileError(f"{path}: line {line}: {name} {row[name]!r} is not a number")
    return value
