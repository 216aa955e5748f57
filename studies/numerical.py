"""One trial of the paper's numerical study, and the parameters that it runs with.

Table I of the paper: draw a circle in very high resolution; blur, scale down, add noise; find
the centre in the base frame, in its bicubic enlargement, in the reconstruction from four
shifted frames; shift the circle by one high-resolution pixel to the right; a hundred times.
Beside these three: the maximum-likelihood fit of one frame and of the same four frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import EngineError
from sr_engine.hough import HoughSettings
from sr_engine.localization import Localization
from sr_engine.localize import localize
from sr_engine.paper import PaperMethod, PaperSettings, localize_paper
from sr_engine.psf import Psf
from sr_engine.reconstruction import shiftset
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.ibp import PAPER
from sr_engine.simulate import filtered_noise, render_disc
from studies.circle_scene import CircleScene

Array = NDArray[np.float64]

METHODS = ("base", "bicubic", "sr", "ml1", "ml")
VARIANTS = ("sr-100", "ml-flat")
SCENES = ("drawn", "flat", "hamming")
"""``drawn``: the paper's circle of pixels. The others: analytic k-space, as on a scanner."""

SCANNER_SHAPE = (120, 128)
START_SPREAD_PX = 1.0


@dataclass(frozen=True)
class StudyPoint:
    """All that one trial depends on, but for its number. ``index`` keeps the random draws apart."""

    index: int = 0
    scene: str = "drawn"
    radius_px: float = 4.0
    snr: float = 20.0
    blur_sigma_px: float = 0.2
    sensitivity: float = 0.85
    shift_set: str = "paper"
    seed: int = 1
    methods: tuple[str, ...] = METHODS

    @property
    def frame_count(self) -> int:
        """Frames that `sr` and `ml` are given."""
        return 4 if self.shift_set == "paper" else len(shiftset.named(self.shift_set))

    @property
    def hough(self) -> HoughSettings:
        return HoughSettings((self.radius_px / 2, 2 * self.radius_px), self.sensitivity)

    @property
    def psf(self) -> Psf:
        """What the maximum-likelihood fit is told: the scanner's settings are known.

        Blur and pixel area of the drawn scene together are nearly Gaussian: variances add.
        """
        if self.scene == "drawn":
            return Psf("gaussian", (math.hypot(self.blur_sigma_px, math.sqrt(1 / 12)),))
        return Psf("hamming") if self.scene == "hamming" else Psf("flat")

    @property
    def blur(self) -> Blur:
        """What gradient descent is told."""
        return Blur(True, self.blur_sigma_px if self.scene == "drawn" else 0.0)


@dataclass(frozen=True)
class Trial:
    """Where the centre was, and what each method said; ``failures`` says why one said nothing."""

    number: int
    truth_px: tuple[float, float]
    estimates_px: dict[str, tuple[float, float]] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)

    def error_px(self, method: str) -> tuple[float, float]:
        row, col = self.estimates_px[method]
        return row - self.truth_px[0], col - self.truth_px[1]


def run_trial(point: StudyPoint, number: int) -> Trial:
    """Trial ``number`` of a point; the same on any machine and in any order."""
    rng = np.random.default_rng([point.seed, point.index, number])
    truth = _true_centre(point, number, rng)
    shifts = _shifts(point, rng)
    frames = np.stack([_frame(point, truth + shift, rng) for shift in shifts])
    start = truth + rng.uniform(-START_SPREAD_PX, START_SPREAD_PX, 2)
    estimates: dict[str, tuple[float, float]] = {}
    failures: dict[str, str] = {}
    for method in point.methods:
        try:
            found = _LOCALIZE[method](point, frames, shifts, start)
        except EngineError as error:
            failures[method] = error.reason
        else:
            estimates[method] = float(found.centre_px[0]), float(found.centre_px[1])
    return Trial(number, (float(truth[0]), float(truth[1])), estimates, failures)


def run_trials(point: StudyPoint, numbers: list[int]) -> list[Trial]:
    """Several trials of one point: the unit of work of a cluster."""
    return [run_trial(point, number) for number in numbers]


def scene_frame(point: StudyPoint, centre_px: Array) -> Array:
    """The noise-free frame of a point."""
    centre = float(centre_px[0]), float(centre_px[1])
    if point.scene == "drawn":
        return CircleScene(point.radius_px, point.blur_sigma_px).frame(centre)
    return render_disc(SCANNER_SHAPE, centre, point.radius_px, psf=point.psf)


def _true_centre(point: StudyPoint, number: int, rng: np.random.Generator) -> Array:
    """In the study proper one high-resolution pixel farther to the right each trial, as in the
    paper; the row's place between pixels is drawn anew, so that nothing hangs on one. In the
    cells of the map, which have fewer trials, both are drawn."""
    shape = np.array(_frame_shape(point))
    middle = np.floor(shape / 2)
    row_phase, col_phase = rng.uniform(-0.5, 0.5, 2)
    if point.scene == "drawn" and point.index == 0:
        step = 1 / CircleScene(point.radius_px, point.blur_sigma_px).factor
        # After a hundred steps start again: the frame is finite.
        col_phase = (number % 100) * step - 1.25
    return np.array([middle[0] + row_phase, middle[1] + col_phase])


def _frame_shape(point: StudyPoint) -> tuple[int, int]:
    if point.scene == "drawn":
        return CircleScene(point.radius_px, point.blur_sigma_px).shape
    return SCANNER_SHAPE


def _shifts(point: StudyPoint, rng: np.random.Generator) -> Array:
    """The reference pose is that of the first frame, whatever the set."""
    if point.shift_set == "paper":
        return shiftset.paper_random(rng, point.frame_count).as_array()
    shifts = shiftset.named(point.shift_set).as_array()
    return np.asarray(shifts - shifts[0])


def _frame(point: StudyPoint, centre: Array, rng: np.random.Generator) -> Array:
    """Magnitude of the scene with noise in both channels.

    SNR is that of the scan: a filter weakens and colours the noise of the image, but it is the
    same scan, and the bound stays the same.
    """
    clean, sigma = scene_frame(point, centre), 1.0 / point.snr
    if point.scene == "hamming":
        sigma *= filtered_share(point.psf)
        channels = [filtered_noise(clean.shape, sigma, point.psf, rng) for _ in range(2)]
    else:
        channels = [rng.normal(0.0, sigma, clean.shape) for _ in range(2)]
    return np.hypot(clean + channels[0], channels[1])


def filtered_share(psf: Psf) -> float:
    """Standard deviation of white noise that a k-space filter lets pass."""
    row, col = (np.fft.fftfreq(size) for size in SCANNER_SHAPE)
    return float(np.sqrt(np.mean(psf.window(row[:, None], col[None, :]) ** 2)))


Localizer = Callable[[StudyPoint, Array, Array, Array], Localization]


def _paper_method(method: PaperMethod, to_the_letter: bool = False) -> Localizer:
    def run(point: StudyPoint, frames: Array, shifts: Array, start: Array) -> Localization:
        count = len(frames) if method == "sr" else 1
        settings = PaperSettings(
            hough=point.hough, blur=point.blur, stopping=PAPER if to_the_letter else None
        )
        return localize_paper(
            frames[:count], shifts[:count], method, start_px=start, settings=settings
        )

    return run


def _likelihood(one_frame: bool, told_psf: bool = True) -> Localizer:
    def run(point: StudyPoint, frames: Array, shifts: Array, start: Array) -> Localization:
        count = 1 if one_frame else len(frames)
        low, high = point.radius_px / 2, 2 * point.radius_px
        return localize(
            frames[:count],
            shifts[:count],
            start_px=start,
            radius_px=(low, high),
            psf=point.psf if told_psf else Psf("flat"),
            noise="rician",
        )

    return run


_LOCALIZE: dict[str, Localizer] = {
    "base": _paper_method("base"),
    "bicubic": _paper_method("bicubic"),
    "sr": _paper_method("sr"),
    "ml1": _likelihood(one_frame=True),
    "ml": _likelihood(one_frame=False),
    "sr-100": _paper_method("sr", to_the_letter=True),
    "ml-flat": _likelihood(one_frame=False, told_psf=False),
}
