"""Read DICOM files that someone named: header and pixels of every usable frame."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dicom_slice.decode_guard import DecodeGuard
from dicom_slice.eligibility import BY_HAND, SliceRules, why_not_usable
from dicom_slice.header import Slice, read_header
from dicom_slice.pixels import frame_pixels, read_with_pixels
from dicom_slice.reasons import Reason, UnusableError

# JPEG lossless, baseline and extended are decoded by GDCM
_ABORTING = tuple(f"1.2.840.10008.1.2.4.{number}" for number in (50, 51, 57, 70))

Frame = tuple[Slice, NDArray[np.float64]]


def read_frames(path: Path, rules: SliceRules = BY_HAND) -> list[Frame]:
    """Return (header, pixels) of every frame of the file that the rules let pass.

    Raises UnusableError, with one line that names file and reason, where the file is not DICOM, is
    no MR image, has no pixels, or has no frame that may be used.
    """
    try:
        slices = read_header(path)
    except UnusableError as error:
        raise _named(path, error) from error
    reasons = {slice_.frame: why_not_usable(slice_, rules) for slice_ in slices}
    usable = [slice_ for slice_ in slices if reasons[slice_.frame] is None]
    if not usable:
        first = next(reason for reason in reasons.values() if reason is not None)
        raise UnusableError(first.code, f"{path}: {first.text}")
    try:
        _check_compressed(path, usable)
        data_set = read_with_pixels(path)
        return [(slice_, frame_pixels(data_set, slice_.frame)) for slice_ in usable]
    except UnusableError as error:
        raise _named(path, error) from error


def _check_compressed(path: Path, slices: list[Slice]) -> None:
    """Try damaged JPEG elsewhere first: its codec would abort this process."""
    if all(slice_.transfer_syntax_uid not in _ABORTING for slice_ in slices):
        return
    guard = DecodeGuard()
    try:
        problems = guard.check(path, slices)
    finally:
        guard.close()
    for error in problems.values():
        if error.reason.code == Reason.UNDECODABLE:
            raise error


def _named(path: Path, error: UnusableError) -> UnusableError:
    text = str(error)
    return UnusableError(
        error.reason.code, text if text.startswith(str(path)) else f"{path}: {text}"
    )


def dicom_files(paths: list[Path]) -> list[Path]:
    """Files as given, folders as the files below them in the order of their names.

    Raises UnusableError for a path that does not exist and for a folder without files.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith("."))
        if not inside:
            raise UnusableError(Reason.NOT_DICOM, f"{path}: the folder has no files")
        found += inside
    for path in found:
        if not path.exists():
            raise UnusableError(Reason.NOT_DICOM, f"{path}: no such file")
    return found
