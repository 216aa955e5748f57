"""The pixels of one frame as physical magnitudes."""

import hashlib
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import FileDataset
from pydicom.pixels import pixel_array

from dicom_slice.elements import Elements, frame_elements
from dicom_slice.header import Slice, dcmread_checked, rescale_of
from dicom_slice.reasons import Reason, UnusableError

_MOST_PIXEL_BYTES = 2**31


def magnitude_pixels(path: Path, frame: int = 0) -> NDArray[np.float64]:
    """Return the frame with index `frame` (0 first) as float64, shape (rows, cols).

    Stored values are inverted where the header says MONOCHROME1, rescaled by slope and intercept
    and by Philips' private scale; padding becomes 0. Brighter is always larger, never NaN. Real
    and phase images come out as they are: `why_not_usable` tells them from magnitudes.

    Raises UnusableError: no pixels, too few of them, an unknown or damaged encoding, colour. Some
    codecs abort the process on damaged data: what comes from outside goes through `decode_guard`.
    """
    return frame_pixels(read_with_pixels(path), frame)


def read_with_pixels(path: Path) -> FileDataset:
    """The whole data set; its pixels are decoded by `frame_pixels`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # read_header keeps them with the slice
        return dcmread_checked(path)


def frame_pixels(data_set: FileDataset, frame: int) -> NDArray[np.float64]:
    """As `magnitude_pixels`, from a data set that was read whole."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        top = Elements(data_set)
        stored = _stored(data_set, top, frame)
        values = stored.astype(np.float64)
        if top.text("PhotometricInterpretation") == "MONOCHROME1":
            values = _inverted(values, top)
        rescale = rescale_of(frame_elements(top, frame))
        values = (values * rescale.slope + rescale.intercept) / rescale.private_divisor
        values[_is_padding(stored, top)] = 0.0
    if not np.isfinite(values).all():
        raise UnusableError(Reason.UNDECODABLE, "the rescaled pixels are not finite")
    return values


def frame_digests(path: Path) -> dict[int, str]:
    """SHA-256 of the magnitudes of every frame: equal in every lossless encoding of an image."""
    data_set = read_with_pixels(path)
    number = Elements(data_set).integer("NumberOfFrames") or 1
    digests = {}
    for frame in range(number):
        pixels = frame_pixels(data_set, frame)
        shape = str(pixels.shape).encode()
        digests[frame] = hashlib.sha256(shape + pixels.tobytes()).hexdigest()
    return digests


def _stored(data_set: FileDataset, top: Elements, frame: int) -> NDArray[np.integer]:
    if "PixelData" not in data_set and "FloatPixelData" not in data_set:
        raise UnusableError(Reason.NO_PIXELS, "no pixels in the file")
    is_palette = top.text("PhotometricInterpretation").startswith("PALETTE")
    if (top.integer("SamplesPerPixel") or 1) != 1 or is_palette:
        raise UnusableError(Reason.COLOUR, "a colour image, not magnitudes")
    frames = top.integer("NumberOfFrames") or 1
    if not 0 <= frame < frames:
        raise UnusableError(Reason.NO_PIXELS, f"no frame {frame}; the file has {frames}")
    rows, cols = top.integer("Rows") or 0, top.integer("Columns") or 0
    if not 0 < rows * cols * 8 <= _MOST_PIXEL_BYTES:
        raise UnusableError(Reason.UNREADABLE, f"implausible size: {rows} x {cols} pixels")
    try:
        pixels = pixel_array(data_set, index=frame, raw=True)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # each codec has its own, and one is no Exception at all
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise UnusableError(Reason.UNDECODABLE, f"pixels cannot be decoded ({text})") from error
    if pixels.shape != (rows, cols):
        raise UnusableError(
            Reason.UNDECODABLE, f"decoded to {pixels.shape}, but the header says {(rows, cols)}"
        )
    return pixels


def _inverted(values: NDArray[np.float64], top: Elements) -> NDArray[np.float64]:
    bits = top.integer("BitsStored") or top.integer("BitsAllocated") or 16
    highest = -1.0 if top.integer("PixelRepresentation") else float(2**bits - 1)
    return highest - values


def _is_padding(stored: NDArray[np.integer], top: Elements) -> NDArray[np.bool_]:
    padding = top.number("PixelPaddingValue")
    if padding is None:
        return np.zeros(stored.shape, dtype=bool)
    limit = top.number("PixelPaddingRangeLimit")
    low, high = sorted((padding, padding if limit is None else limit))
    return (stored >= low) & (stored <= high)


def check_not_blank(pixels: NDArray[np.float64]) -> None:
    """Raise UnusableError where all pixels are equal: nothing was imaged."""
    if pixels.size and pixels.min() == pixels.max():
        raise UnusableError(Reason.BLANK, f"all pixels are {pixels.flat[0]:g}")


def check_pixels(path: Path, slices: Sequence[Slice]) -> dict[int, UnusableError]:
    """Decode each of the frames once; return what is wrong, by frame index."""
    problems: dict[int, UnusableError] = {}
    data_set = read_with_pixels(path)
    for slice_ in slices:
        try:
            check_not_blank(frame_pixels(data_set, slice_.frame))
        except UnusableError as error:
            problems[slice_.frame] = error
    return problems
