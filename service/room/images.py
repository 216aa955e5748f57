"""Slices and reconstructions as PNG, as raw pixels, and as the DICOM file that was received."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from case_record.record import CaseRecord
from case_record.seal_chain import TamperedError
from dicom_slice.pixels import magnitude_pixels
from dicom_slice.reasons import Reason, UnusableError
from sr_engine.residual import residual_image
from sr_engine.result import recorded_point_spread

_MOST_SIDE_PX = 4096
_WINDOW_PERCENT = (1.0, 99.8)
_FITTED = ("ml", "template")


class ImageMissingError(Exception):
    """There is no such image (yet)."""


@dataclass(frozen=True)
class Rendering:
    """How a PNG is made: window and level in the image's units (None: automatic), whole scale."""

    window: float | None = None
    level: float | None = None
    scale: int = 1


def slice_pixels(record: CaseRecord, slice_id: int) -> NDArray[np.float64]:
    """Return the magnitudes of a slice (rows, cols); raises ImageMissingError."""
    row = record.slice(slice_id)
    if row.reason_code == Reason.TOO_LARGE:
        raise ImageMissingError(f"slice {slice_id} is not shown: {row.reason}")
    try:
        return magnitude_pixels(record.case_dir / row.path, row.frame)
    except (UnusableError, OSError) as error:
        raise ImageMissingError(f"slice {slice_id}: {error}") from error


def slice_file(record: CaseRecord, slice_id: int) -> Path:
    """Return the DICOM file of a slice, bit for bit as it was received."""
    path = record.case_dir / record.slice(slice_id).path
    if not path.is_file():
        raise ImageMissingError(f"slice {slice_id}: its file no longer exists")
    return path


def reconstruction_pixels(record: CaseRecord, measurement_id: int) -> NDArray[np.float64]:
    """Return the super-resolution image of a measurement; raises ImageMissingError."""
    result = record.measurement(measurement_id).result or {}
    if (
        not result.get("reconstruction")
        or not (record.case_dir / result["reconstruction"]).is_file()
    ):
        raise ImageMissingError(f"measurement {measurement_id} has no reconstruction")
    return load_reconstruction(record.case_dir, result)


def load_reconstruction(case_dir: Path, result: Mapping[str, Any]) -> NDArray[np.float64]:
    """The image that the worker made for a result. TamperedError if the file is another one."""
    path = case_dir / result["reconstruction"]
    content = path.read_bytes()
    sworn = result.get("reconstruction_sha256")  # a program before did not say
    if sworn is not None and hashlib.sha256(content).hexdigest() != sworn:
        raise TamperedError(f"{path} is not the image that was made")
    pixels: NDArray[np.float64] = np.load(io.BytesIO(content)).astype(np.float64)
    return pixels


def residual_pixels(record: CaseRecord, measurement_id: int) -> NDArray[np.float64]:
    """Return the newest slice of a measurement less a disc where the fiducial was found.

    (rows, cols) of that slice, 0 far from it; raises ImageMissingError where it was found by one of
    the paper's methods, which fit no disc.
    """
    result = record.measurement(measurement_id).result or {}
    psf = recorded_point_spread(result)
    if result.get("method") not in _FITTED or psf is None:
        raise ImageMissingError(f"measurement {measurement_id} has no fitted model")
    row, col = result["centre_px"]
    frame = slice_pixels(record, result["slice_id"])
    return residual_image(frame, (row, col), result["radius_px"], psf)


def png_of(pixels: NDArray[np.floating], how: Rendering = Rendering()) -> bytes:
    """Return an 8-bit PNG; automatic window: all but the brightest pixels differ."""
    low, high = np.percentile(pixels, _WINDOW_PERCENT).tolist()
    window = how.window if how.window is not None else high - low
    level = how.level if how.level is not None else (high + low) / 2
    scaled = np.clip((pixels - level) / max(window, 1e-12) + 0.5, 0.0, 1.0)
    grey = np.round(scaled * 255).astype(np.uint8)
    scale = min(how.scale, max(1, _MOST_SIDE_PX // max(grey.shape)))
    if scale > 1:
        grey = grey.repeat(scale, axis=0).repeat(scale, axis=1)
    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, "PNG")
    return buffer.getvalue()


def raw_of(pixels: NDArray[np.floating]) -> bytes:
    """Return the pixels row by row as little-endian 32-bit floats."""
    return pixels.astype("<f4").tobytes()
