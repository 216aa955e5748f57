"""The benchtop experiment's camera: a printed red circle on the top stage, seen from above.

An RGB camera (640×480, 1.5 px/mm) photographs the circle; the photograph is scaled down by
interpolation to the 1 px/mm of an MR slice and cropped to 128×128, as Martinez et al. did. What
reaches the frame is the circle's redness, so that it is bright on dark like the MR fiducial.

Pixels integrate over squares (fill factor 1) behind a slightly unsharp lens, under a Bayer mosaic.
The downscaling by 1.5 does not treat all pixels alike: its phase repeats every two. Two frames are
in play, both with pixel (0, 0) centred at (0.0, 0.0): the `sensor`, and the `frame` cut from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.ndimage import correlate

from room_config.section import Positive
from sr_engine.psf import Psf
from sr_engine.simulate import render_disc

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

Share = Annotated[float, Field(ge=0, le=1)]
Colour = tuple[Share, Share, Share]
Size = Annotated[int, Field(ge=16, le=4096)]

_MARGIN_PX = 8  # sensor pixels around the crop that the mosaic and the interpolation look at
_FULL_SCALE = 255.0


class Benchtop(BaseModel):
    """The camera on its tripod, the circle on its sheet, the stage below. Colours are RGB."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sensor_shape: tuple[Size, Size] = (480, 640)
    sensor_px_per_mm: Positive = 1.5
    shape: tuple[Size, Size] = (128, 128)
    px_per_mm: Positive = 1.0
    centre_px: tuple[float, float] = (63.2, 64.7)
    """Frame pixel of the circle when the stages stand at zero."""
    rotation_deg: float = 1.2
    """The camera about its axis; at 0, x of the stages is along columns and y along rows."""
    scale: tuple[Positive, Positive] = (1.004, 0.997)
    """True pixels per nominal pixel along x and y: the camera's height and tilt."""
    radius_mm: Positive = 5.0
    sheet_mm: tuple[Positive, Positive] = (40.0, 34.0)
    """The white sheet around the circle (rows, columns); it moves with the stage."""
    red: Colour = (0.74, 0.13, 0.15)
    white: Colour = (0.86, 0.86, 0.84)
    stage: Colour = (0.22, 0.22, 0.24)
    shading_per_px: tuple[float, float] = (2e-4, -3e-4)
    """Relative slope of the room's light along sensor rows and columns."""
    lens_blur_px: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Standard deviation, sensor pixels."""
    noise_dn: Annotated[float, Field(ge=0)] = 2.0
    """Standard deviation of one photosite, in steps of 8 bits, where the sheet is white."""
    bayer: bool = True
    interpolation: Literal["bicubic", "bilinear"] = "bicubic"
    antialias: bool = True
    """Widen the interpolation kernel when scaling down, as MATLAB's imresize does."""

    @model_validator(mode="after")
    def _frame_lies_on_the_sensor(self) -> "Benchtop":
        for axis in (0, 1):
            scaled = self.sensor_shape[axis] * self.px_per_mm / self.sensor_px_per_mm
            if not self.shape[axis] <= scaled - 2 * _MARGIN_PX:
                raise ValueError(f"shape {self.shape} does not fit into the scaled photograph")
        return self


@dataclass(frozen=True, eq=False)
class BenchtopFrame:
    """redness (rows, cols), 0..255; centre_px: the true centre of the circle (row, col)."""

    redness: Floats
    centre_px: Floats
    radius_px: float


def true_centre_px(bench: Benchtop, stage_mm: Mapping[str, float]) -> Floats:
    """Frame pixel (row, col) of the circle's centre for true stage positions xt, yt in mm."""
    angle = np.radians(bench.rotation_deg)
    x_px = bench.scale[0] * stage_mm["xt"] * bench.px_per_mm
    y_px = bench.scale[1] * stage_mm["yt"] * bench.px_per_mm
    row = np.sin(angle) * x_px + np.cos(angle) * y_px
    col = np.cos(angle) * x_px - np.sin(angle) * y_px
    return np.array(bench.centre_px) + np.array([row, col])


def acquire_frame(
    bench: Benchtop, stage_mm: Mapping[str, float], rng: np.random.Generator
) -> BenchtopFrame:
    """One frame with its truth; only the part of the sensor that reaches it is computed."""
    region = _needed_region(bench)
    photo = _expose(bench, stage_mm, region, rng)
    centre = true_centre_px(bench, stage_mm)
    redness = _scale_down(bench, _redness(photo), region)
    return BenchtopFrame(redness, centre, bench.radius_mm * bench.px_per_mm)


def photograph(bench: Benchtop, stage_mm: Mapping[str, float], rng: np.random.Generator) -> Bytes:
    """The whole photograph, (rows, cols, 3)."""
    rows, cols = bench.sensor_shape
    return _expose(bench, stage_mm, (slice(0, rows), slice(0, cols)), rng)


def frame_from_photograph(bench: Benchtop, photo: Bytes) -> Floats:
    """Redness, scaled down and cropped to the frame."""
    rows, cols = bench.sensor_shape
    return _scale_down(bench, _redness(photo), (slice(0, rows), slice(0, cols)))


def sensor_from_frame(bench: Benchtop, point_px: Floats) -> Floats:
    """Frame pixel (row, col) → sensor pixel; both images share their outer edges."""
    step = bench.sensor_px_per_mm / bench.px_per_mm
    scaled_px = np.asarray(point_px, dtype=np.float64) + _crop_offset(bench)
    return np.asarray((scaled_px + 0.5) * step - 0.5)


def _crop_offset(bench: Benchtop) -> NDArray[np.int64]:
    """Pixel of the scaled photograph on which the frame's pixel (0, 0) lies."""
    step = bench.sensor_px_per_mm / bench.px_per_mm
    scaled = np.ceil(np.array(bench.sensor_shape) / step).astype(int)
    return (scaled - np.array(bench.shape)) // 2


Region = tuple[slice, slice]


def _needed_region(bench: Benchtop) -> Region:
    first = sensor_from_frame(bench, np.zeros(2))
    last = sensor_from_frame(bench, np.array(bench.shape) - 1.0)
    # From an even pixel, so that the mosaic begins with the same colour.
    start = np.maximum(np.floor(first).astype(int) - _MARGIN_PX, 0) // 2 * 2
    stop = np.minimum(np.ceil(last).astype(int) + _MARGIN_PX, np.array(bench.sensor_shape))
    return slice(int(start[0]), int(stop[0])), slice(int(start[1]), int(stop[1]))


def _expose(
    bench: Benchtop, stage_mm: Mapping[str, float], region: Region, rng: np.random.Generator
) -> Bytes:
    centre = sensor_from_frame(bench, true_centre_px(bench, stage_mm))
    local = centre - np.array([region[0].start, region[1].start])
    shape = (region[0].stop - region[0].start, region[1].stop - region[1].start)
    sheet = _sheet_coverage(bench, shape, local)
    disc = _disc_coverage(bench, shape, local)
    red, white, stage = (np.array(colour) for colour in (bench.red, bench.white, bench.stage))
    colours = stage + sheet[..., None] * (white - stage) + disc[..., None] * (red - white)
    light = colours * _light(bench, region)[..., None]
    noise = bench.noise_dn / _FULL_SCALE * np.sqrt(np.maximum(light, 0.02) / max(bench.white))
    exposed = light + noise * rng.standard_normal(light.shape)
    if bench.bayer:
        exposed = _demosaic(exposed)
    return np.clip(np.rint(_FULL_SCALE * exposed), 0, 255).astype(np.uint8)


def _light(bench: Benchtop, region: Region) -> Floats:
    rows = np.arange(region[0].start, region[0].stop) - bench.sensor_shape[0] / 2
    cols = np.arange(region[1].start, region[1].stop) - bench.sensor_shape[1] / 2
    slope_row, slope_col = bench.shading_per_px
    return 1.0 + slope_row * rows[:, None] + slope_col * cols[None, :]


def _disc_coverage(bench: Benchtop, shape: tuple[int, int], centre_px: Floats) -> Floats:
    """Share of each pixel that the circle covers, behind the lens. Exact but for the lens."""
    radius = bench.radius_mm * bench.sensor_px_per_mm
    half = int(np.ceil(radius + 6 * bench.lens_blur_px)) + 4
    corner = np.rint(centre_px).astype(int) - half
    size = 2 * half + 1
    row, col = (centre_px - corner).tolist()
    # Box pixels and the lens: fine samples of the blurred disc, summed over each pixel.
    fine = 4
    blur = Psf("gaussian", (bench.lens_blur_px * fine,))
    inner = ((row + 0.5) * fine - 0.5, (col + 0.5) * fine - 0.5)
    sampled = render_disc((size * fine, size * fine), inner, radius * fine, psf=blur)
    patch = sampled.reshape(size, fine, size, fine).mean(axis=(1, 3))
    coverage = np.zeros(shape)
    _paste(coverage, patch, corner)
    return coverage


def _paste(image: Floats, patch: Floats, corner: NDArray[np.int64]) -> None:
    """Put the part of `patch` that lies inside of `image` at `corner` (row, col)."""
    low = np.maximum(corner, 0)
    high = np.minimum(corner + patch.shape, image.shape)
    if (high <= low).any():
        return
    inner = tuple(slice(a - c, b - c) for a, b, c in zip(low, high, corner, strict=True))
    image[low[0] : high[0], low[1] : high[1]] = patch[inner]


def _sheet_coverage(bench: Benchtop, shape: tuple[int, int], centre_px: Floats) -> Floats:
    """Share of each pixel that the sheet covers; its edges lie along the pixels."""
    along = []
    for axis in (0, 1):
        half = bench.sheet_mm[axis] * bench.sensor_px_per_mm / 2
        edges = np.arange(shape[axis] + 1) - 0.5
        inside = np.clip(edges, centre_px[axis] - half, centre_px[axis] + half)
        along.append(np.diff(inside))
    return np.outer(along[0], along[1])


def _demosaic(colours: Floats) -> Floats:
    """Keep one colour a photosite (RGGB) and interpolate the others linearly from neighbours."""
    cross = np.array([[0.0, 1.0, 0.0], [1.0, 4.0, 1.0], [0.0, 1.0, 0.0]]) / 4
    square = np.array([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]) / 4
    rows, cols = (np.arange(n) % 2 for n in colours.shape[:2])
    even_row, even_col = (rows == 0)[:, None], (cols == 0)[None, :]
    masks = (even_row & even_col, even_row ^ even_col, ~even_row & ~even_col)
    planes = [
        correlate(colours[..., channel] * mask, kernel, mode="mirror")
        for channel, (mask, kernel) in enumerate(zip(masks, (square, cross, square), strict=True))
    ]
    return np.stack(planes, axis=-1)


def _redness(photo: Bytes) -> Floats:
    """Red above the mean of green and blue: 0 and noise of either sign on anything grey."""
    red, green, blue = np.moveaxis(photo.astype(float), -1, 0)
    return red - (green + blue) / 2


def _scale_down(bench: Benchtop, image: Floats, region: Region) -> Floats:
    across, along = (
        _interpolation_matrix(bench, axis, region[axis].start, region[axis].stop) for axis in (0, 1)
    )
    return across @ image @ along.T


@lru_cache(maxsize=16)
def _interpolation_matrix(bench: Benchtop, axis: int, start: int, stop: int) -> Floats:
    """(frame pixels, sensor pixels start..stop): weights, each row of which sums to 1."""
    step = bench.sensor_px_per_mm / bench.px_per_mm
    wider = max(step, 1.0) if bench.antialias else 1.0
    index = np.arange(bench.shape[axis]) + _crop_offset(bench)[axis]
    position = (index + 0.5) * step - 0.5
    distance = np.abs(position[:, None] - np.arange(start, stop)[None, :]) / wider
    kernel = _cubic if bench.interpolation == "bicubic" else _triangle
    weights = kernel(distance)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _triangle(distance: Floats) -> Floats:
    return np.maximum(1 - distance, 0.0)


def _cubic(distance: Floats) -> Floats:
    """Cubic convolution with a = -1/2 (Keys, IEEE TASSP 29:1153, 1981)."""
    d = distance
    near = 1.5 * d**3 - 2.5 * d**2 + 1
    far = -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2
    return np.where(d <= 1, near, np.where(d <= 2, far, 0.0))
