"""Slices from the camera: fresh pictures, averaged, and what can be said against them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.config import BenchRoom, CameraError
from bench.optics import Lens, Resampler, colour_plane, read_lens
from bench.source import Exposure, FrameSource, Picture
from sr_engine.detect import detect
from sr_engine.errors import EngineError

Floats = NDArray[np.float64]
_TOP = 254
_FAINT = 0.4  # of the strongest contrast


@dataclass(frozen=True, eq=False)
class BenchSlice:
    """pixels (rows, cols): the circle is bright; acquired between `from_s` and `to_s`."""

    pixels: Floats
    from_s: float
    to_s: float
    averages: int
    overexposed: float


@dataclass(frozen=True)
class Sharpness:
    """overexposed: share of pixels at the top of the range; focus: contrast of the steepest edge in
    a picture, 1 where it rises within one pixel; circles: found at the allowed sizes."""

    overexposed: float
    focus: float
    circles: int


class BenchCamera:
    """Owns nothing but its settings; the source is opened by whoever reads it."""

    def __init__(self, room: BenchRoom) -> None:
        self._room = room
        self.config = room.camera
        self._lens: Lens | None = None
        if self.config.lens_file:
            self._lens = read_lens(room.folder / Path(self.config.lens_file))
        self._resampler: Resampler | None = None

    def acquire(self, source: FrameSource, since_s: float) -> BenchSlice:
        """Average pictures exposed after `since_s` (time.time). Raises CameraError."""
        exposures = source.exposed_after(since_s, self.config.frames)
        taken = self.slice_of(exposures)
        if not taken.overexposed <= self.config.most_overexposed:
            raise CameraError(
                f"{100 * taken.overexposed:.0f} % of the pixels are overexposed: shorten the "
                "exposure or dim the light"
            )
        return taken

    def slice_of(self, exposures: list[Exposure]) -> BenchSlice:
        pictures = [exposure.picture for exposure in exposures]
        resample = self._resampler_for(pictures[0])
        planes = [colour_plane(picture, self.config.colour) for picture in pictures]
        return BenchSlice(
            pixels=resample(np.mean(planes, axis=0)),
            from_s=min(exposure.from_s for exposure in exposures),
            to_s=max(exposure.to_s for exposure in exposures),
            averages=len(exposures),
            overexposed=max(map(overexposed_share, pictures)),
        )

    def judge(self, exposure: Exposure) -> Sharpness:
        """What a person at the camera wants to know."""
        taken = self.slice_of([exposure])
        return Sharpness(taken.overexposed, focus_of(exposure.picture), self.circles_in(taken))

    def circles_in(self, taken: BenchSlice) -> int:
        low_mm, high_mm = self._room.radius_mm
        radii_px = (low_mm / self.config.pixel_mm, high_mm / self.config.pixel_mm)
        try:
            contrasts = [abs(found.contrast) for found in detect(taken.pixels, radii_px)]
        except EngineError:
            return 0
        # what is faint beside the circle (a corner of the sheet, a shadow) is none
        return sum(contrast > _FAINT * max(contrasts) for contrast in contrasts)

    def complaint_about(self, circles: int) -> str:
        """One line where the circle is not the one thing in view; else ''."""
        low_mm, high_mm = self._room.radius_mm
        if circles == 0:
            return (
                f"no circle of {low_mm:g} to {high_mm:g} mm radius in view: move the camera or the "
                f"stages, or set camera.colour (now {self.config.colour}); or the scale is wrong"
            )
        if circles > 1:
            return f"{circles} circles in view: cover all but the robot's"
        return ""

    def _resampler_for(self, picture: Picture) -> Resampler:
        if self._resampler is None:
            rows, cols = picture.shape[:2]
            self._resampler = Resampler(self.config, (int(rows), int(cols)), self._lens)
        return self._resampler


def overexposed_share(picture: Picture) -> float:
    """Share of pixels of which every channel stands at the top: white paper that burns out hides
    nothing by itself, but a colour difference at its edge then lies."""
    return float(np.mean(picture.min(axis=2) >= _TOP))


def focus_of(picture: Picture) -> float:
    """Steepest step between neighbours over the picture's whole contrast (0 to 1)."""
    grey = picture.mean(axis=2)
    contrast = float(np.subtract(*np.percentile(grey, (99.5, 0.5))))
    if contrast < 1:
        return 0.0
    steps = (
        np.abs(np.diff(grey, axis=0)).max(initial=0),
        np.abs(np.diff(grey, axis=1)).max(initial=0),
    )
    return float(min(1.0, max(steps) / contrast))
