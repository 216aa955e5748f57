"""Slices and reconstructions as PNG."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from case_record.record import CaseRecord
from dicom_listener.pixels import magnitude_pixels
from dicom_listener.reasons import UnusableError

_WINDOW_PERCENT = (1.0, 99.8)


class ImageMissingError(Exception):
    """There is no such image (yet)."""


def render_slice(record: CaseRecord, slice_id: int) -> bytes:
    """Return the PNG of a slice in the record."""
    row = record.slice(slice_id)
    try:
        pixels = magnitude_pixels(record.case_dir / row.path, row.frame)
    except UnusableError as error:
        raise ImageMissingError(f"slice {slice_id}: {error}") from error
    return png_of(pixels)


def render_reconstruction(record: CaseRecord, measurement_id: int) -> bytes:
    """Return the PNG of the super-resolution image of a measurement."""
    measurement = record.measurement(measurement_id)
    name = (measurement.result or {}).get("reconstruction")
    if not name or not (record.case_dir / name).is_file():
        raise ImageMissingError(f"measurement {measurement_id} has no reconstruction")
    return png_of(np.load(record.case_dir / name))


def png_of(pixels: NDArray[np.floating]) -> bytes:
    """Return an 8-bit PNG, windowed so that all but the brightest pixels differ."""
    low, high = np.percentile(pixels, _WINDOW_PERCENT)
    scaled = np.clip((pixels - low) / max(high - low, 1e-12), 0.0, 1.0)
    buffer = io.BytesIO()
    Image.fromarray((scaled * 255).astype(np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()
