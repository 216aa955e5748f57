"""The benchtop camera: a printed circle on the top stage, seen from above like a coronal slice.

The paper's bench: a camera at 1.5 pixels a millimetre looks at a printed circle, and its frames are
scaled down by interpolation to one pixel a millimetre. Not stated there, assumed here: the
circle's radius, the noise, 8 bits, and bicubic interpolation with anti-aliasing.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.transform import resize

from dicom_slice.geometry import SliceGeometry
from simulator.config import VirtualRoom
from simulator.mr_slice import slice_geometry
from simulator.scene import true_fiducial_mm
from sr_engine.psf import Psf
from sr_engine.simulate import render_disc

Floats = NDArray[np.float64]
GREY_LEVELS = 255.0
MARGIN_PX = 6  # beyond the circle's edge nothing is left of it


@dataclass(frozen=True)
class Camera:
    """Signals are of full scale; `noise` is the standard deviation in one pixel of the camera."""

    pixels_per_mm: float = 1.5
    circle_radius_mm: float = 4.0
    contrast: float = 0.6
    background: float = 0.2
    noise: float = 0.012


def photograph(
    room: VirtualRoom,
    stage_mm: Mapping[str, float],
    camera: Camera,
    rng: np.random.Generator,
) -> tuple[Floats, SliceGeometry]:
    """One frame (rows, cols), 0..255, scaled down to the grid of the room's slice protocol."""
    geometry = slice_geometry(room.protocol)
    centre_px, _ = geometry.pixel_from_patient(true_fiducial_mm(room, stage_mm))
    factors = np.array(geometry.spacing_mm) * camera.pixels_per_mm
    shape = (round(geometry.shape[0] * factors[0]), round(geometry.shape[1] * factors[1]))
    row, col = ((centre_px + 0.5) * factors - 0.5).tolist()
    frame = np.full(shape, camera.background)
    radius_px = camera.circle_radius_mm * camera.pixels_per_mm
    top, left = (round(at - radius_px) - MARGIN_PX for at in (row, col))
    size = 2 * (round(radius_px) + MARGIN_PX)
    if not (0 <= top <= shape[0] - size and 0 <= left <= shape[1] - size):
        raise ValueError(f"the circle at {centre_px} leaves the camera's frame")
    frame[top : top + size, left : left + size] += render_disc(
        (size, size), (row - top, col - left), radius_px, camera.contrast, psf=Psf("box")
    )
    frame = frame + camera.noise * rng.standard_normal(shape)
    levels = np.clip(np.rint(frame * GREY_LEVELS), 0.0, GREY_LEVELS)
    scaled = resize(levels, geometry.shape, order=3, anti_aliasing=True, mode="edge", clip=False)
    return np.asarray(scaled, dtype=np.float64), geometry
