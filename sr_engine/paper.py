"""The paper's three ways to the fiducial's centre: `base`, `bicubic`, `sr`.

Each ends in the circle Hough transform: on the frame as it is, on the frame enlarged twofold by
bicubic interpolation, or on the twofold reconstruction by gradient descent from all frames.
They are the baseline that the maximum-likelihood method is held against. A Hough transform has
no error estimate of its own; the covariance reported is the paper's measured mean error, or, of
several frames that scatter more than that lets expect, what their scatter says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.checks import checked_radii, refuse_saturated
from sr_engine.errors import (
    AmbiguousObjectError,
    InconsistentFramesError,
    NoRoundObjectError,
    ObjectAtBorderError,
    OutsideGateError,
    ParameterError,
)
from sr_engine.frames import Region, check_factor, check_frames_and_shifts
from sr_engine.hough import Circle, HoughSettings, hough_circles
from sr_engine.localization import Localization
from sr_engine.psf import Psf
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.ibp import Stopping, estimate_noise_sigma
from sr_engine.reconstruction.interpolate import enlarge_bicubic, frame_from_fine
from sr_engine.reconstruction.reconstruct import Reconstruction, reconstruct

Array = NDArray[np.float64]
PaperMethod = Literal["base", "bicubic", "sr"]

PAPER_MEAN_ERROR_PX = {"base": 0.156, "bicubic": 0.135, "sr": 0.066}
"""Mean distance from the truth in the paper's numerical study."""

DEFAULT_RADII_PX = (2.0, 12.0)
SEARCH_PX = 3.0
SEARCHED_BEYOND = 1.5
MARGIN_PX = 6.0
AMBIGUOUS_RATIO = 0.95
MIN_CONTRAST = 2.5
"""Of the disc against its surroundings, in standard deviations of the noise: a Hough transform
finds circles in noise as well."""
SR_SHARE = 0.7
"""Error of the reconstruction's circle over the RMS of the frames' own circles around it: 0.71 in
simulated slices, 0.63 in camera frames (SNR 10, radius 4 px, four random shifts)."""
MAX_RESIDUAL_PX = 1.0
"""A frame whose own circle lies farther off than this was not taken at its shift."""


@dataclass(frozen=True)
class PaperSettings:
    """What the paper leaves open. ``hough`` has its radii in frame pixels.

    ``stopping`` None: the paper's rule or, earlier, the discrepancy principle;
    ``sr_engine.reconstruction.ibp.PAPER`` is the paper's rule to the letter.
    """

    hough: HoughSettings = field(default_factory=lambda: HoughSettings(DEFAULT_RADII_PX))
    factor: int = 2
    blur: Blur = field(default_factory=lambda: Blur(box=True))
    stopping: Stopping | None = None


def localize_paper(
    frames: ArrayLike,
    shifts_px: ArrayLike | None = None,
    method: str = "sr",
    *,
    start_px: ArrayLike | None = None,
    radius_px: tuple[float, float] | float | None = None,
    gate_px: float | None = None,
    saturation_level: float | None = None,
    settings: PaperSettings | None = None,
) -> Localization:
    """The centre in the reference pose by one of the paper's methods.

    frames: (N, rows, cols); shifts_px: (N, 2), the fiducial's displacement (row, col) in each.
    `base` and `bicubic` average the de-shifted circles of all frames given (the paper gives
    one). start_px: where the fiducial is in the reference pose to within 3 px; what lies
    farther off is ignored. Without it the strongest circle of the first frame is taken.
    radius_px: (low, high), or one number; the transform searches half as far again, because
    its phases cannot tell the ends of their range apart. Default: what ``settings`` say.

    Raises NoRoundObjectError, AmbiguousObjectError, ObjectAtBorderError, OutsideGateError,
    SaturatedError, InconsistentFramesError, and the errors of bad frames and shifts.
    """
    if method not in get_args(PaperMethod):
        raise ParameterError(f"method is {method!r}; base, bicubic or sr is needed")
    settings = settings or PaperSettings()
    check_factor(settings.factor)
    if (radii := checked_radii(radius_px)) is not None:
        wider = (max(1.0, radii[0] / SEARCHED_BEYOND), radii[1] * SEARCHED_BEYOND)
        settings = replace(settings, hough=replace(settings.hough, radius_px=wider))
    stack, shifts = check_frames_and_shifts(frames, shifts_px)
    start = _checked_start(start_px, gate_px)
    if start is None:
        start = np.array(_only_circle(stack[0], settings.hough).centre_px) - shifts[0]
    per_frame = "base" if method == "base" else "bicubic"
    circles = [
        _circle_in(frame, start + shift, per_frame, settings)
        for frame, shift in zip(stack, shifts, strict=True)
    ]
    centres = np.array([circle.centre_px for circle in circles]) - shifts
    if method == "sr":
        found = _circle_in_reconstruction(stack, shifts, start, settings)
        centre, radius = np.array(found.centre_px), found.radius_px
    else:
        centre = centres.mean(axis=0)
        radius = float(np.mean([circle.radius_px for circle in circles]))
    _refuse_outside(centre, radius, start, gate_px, (stack.shape[1], stack.shape[2]))
    for frame, shift in zip(stack, shifts, strict=True):
        disc = frame[_region(frame.shape, centre + shift, settings.hough).slices]
        refuse_saturated(disc, radius, saturation_level)
    residuals = centres - centre
    _refuse_inconsistent(residuals)
    return _localization(stack, shifts, method, centre, radius, residuals)


def sigma_px(method: str) -> float:
    """Standard deviation per axis that belongs to the paper's mean distance (Rayleigh)."""
    return PAPER_MEAN_ERROR_PX[method] / math.sqrt(math.pi / 2)


def _checked_start(start_px: ArrayLike | None, gate_px: float | None) -> Array | None:
    if start_px is None:
        if gate_px is not None:
            raise ParameterError("a gate needs a predicted position: give start_px")
        return None
    start = np.asarray(start_px, dtype=np.float64)
    if start.shape != (2,) or not np.isfinite(start).all():
        raise ParameterError(f"start_px must be a finite (row, col), is {start.tolist()}")
    return start


def _only_circle(frame: Array, hough: HoughSettings) -> Circle:
    """The strongest circle of a frame, unless another one is as good."""
    found = hough_circles(frame, hough)
    _refuse_none(found, hough)
    best = found[0]
    for other in found[1:]:
        apart = math.dist(best.centre_px, other.centre_px)
        if other.strength > AMBIGUOUS_RATIO * best.strength and apart > hough.radius_px[0]:
            raise AmbiguousObjectError(
                "two circles are equally good, at "
                + " and at ".join(
                    f"row {c.centre_px[0]:.1f} col {c.centre_px[1]:.1f}" for c in (best, other)
                )
                + ": give a start or a narrower radius range"
            )
    return best


def _region(shape: tuple[int, ...], centre: Array, hough: HoughSettings) -> Region:
    reach = hough.radius_px[1] + SEARCH_PX + MARGIN_PX
    low, high = np.floor(centre - reach).astype(int), np.ceil(centre + reach).astype(int) + 1
    return Region(
        max(0, int(low[0])),
        max(0, int(low[1])),
        min(shape[0], int(high[0])),
        min(shape[1], int(high[1])),
    )


def _circle_in(frame: Array, expected: Array, method: str, settings: PaperSettings) -> Circle:
    """The circle of one frame near ``expected``, in frame pixels."""
    _refuse_expected_outside(expected, frame.shape)
    region = _region(frame.shape, expected, settings.hough)
    cut = frame[region.slices]
    corner = np.array([region.row_start, region.col_start])
    factor = 1 if method == "base" else settings.factor
    image = cut if factor == 1 else enlarge_bicubic(cut, factor)
    near = (expected - corner + 0.5) * factor - 0.5
    circle = _nearest_strong(image, near, factor, settings.hough)

    row, col = frame_from_fine(circle.centre_px, factor) + corner
    return Circle((float(row), float(col)), circle.radius_px / factor, circle.strength)


def _circle_in_reconstruction(
    stack: Array, shifts: Array, start: Array, settings: PaperSettings
) -> Circle:
    shape = (int(stack.shape[1]), int(stack.shape[2]))
    region = _region(shape, start, settings.hough)
    done: Reconstruction = reconstruct(
        stack,
        shifts,
        settings.factor,
        "ibp",
        region=region,
        blur=settings.blur,
        stopping=settings.stopping,
    )
    near = done.fine_from_frame(start)
    circle = _nearest_strong(done.image, near, settings.factor, settings.hough)
    row, col = done.frame_from_fine(circle.centre_px)
    return Circle((float(row), float(col)), circle.radius_px / settings.factor, circle.strength)


def _nearest_strong(image: Array, near: Array, factor: int, hough: HoughSettings) -> Circle:
    scaled = hough.scaled(factor)
    found = [
        circle
        for circle in hough_circles(image, scaled)
        if math.dist(circle.centre_px, near) <= SEARCH_PX * factor
    ]
    _refuse_none(found, hough)
    return found[0]


def _refuse_none(found: list[Circle], hough: HoughSettings) -> None:
    if not found:
        low, high = hough.radius_px
        raise NoRoundObjectError(
            f"no circle of radius {low:g} to {high:g} px at sensitivity {hough.sensitivity:g}"
        )


def _refuse_expected_outside(expected: Array, shape: tuple[int, ...]) -> None:
    if not all(-0.5 <= x <= n - 0.5 for x, n in zip(expected, shape, strict=True)):
        raise ObjectAtBorderError(
            f"the fiducial is expected at row {expected[0]:.1f}, col {expected[1]:.1f}, outside "
            f"the {shape[0]} x {shape[1]} frame"
        )


def _refuse_outside(
    centre: Array, radius: float, start: Array, gate_px: float | None, shape: tuple[int, int]
) -> None:
    for name, at, size in zip(("row", "col"), centre, shape, strict=True):
        if not radius - 1.0 <= at <= size - radius:
            raise ObjectAtBorderError(
                f"circle of radius {radius:.1f} px at {name} {at:.1f} is cut by the border"
            )
    distance = math.dist(centre, start)
    if gate_px is not None and not distance <= gate_px:
        raise OutsideGateError(
            f"circle found {distance:.2f} px from its predicted position, allowed {gate_px:g} px"
        )


def _refuse_inconsistent(residuals: Array) -> None:
    distance = np.hypot(residuals[:, 0], residuals[:, 1])
    worst = int(np.argmax(distance))
    if not distance[worst] <= MAX_RESIDUAL_PX:
        raise InconsistentFramesError(
            f"frame {worst} disagrees with its shift by {distance[worst]:.2f} px "
            f"(row {residuals[worst, 0]:+.2f}, col {residuals[worst, 1]:+.2f}), allowed "
            f"{MAX_RESIDUAL_PX:g} px"
        )


def _localization(
    stack: Array,
    shifts: Array,
    method: str,
    centre: Array,
    radius: float,
    residuals: Array,
) -> Localization:
    count = len(stack)
    used = count if method != "sr" else 1
    single = sigma_px("base" if method == "base" else "bicubic")
    inside, outside = _levels(stack[0], centre + shifts[0], radius)
    sigma = estimate_noise_sigma(stack)
    if not abs(inside - outside) >= MIN_CONTRAST * sigma:
        raise NoRoundObjectError(
            f"the circle at row {centre[0]:.1f}, col {centre[1]:.1f} does not stand out from the "
            f"noise (contrast {abs(inside - outside):.3g}, noise {sigma:.3g})"
        )
    return Localization(
        centre_px=centre,
        covariance_px2=np.eye(2)
        * max(sigma_px(method) ** 2 / used, _scatter_px2(method, residuals)),
        radius_px=radius,
        amplitude=inside - outside,
        background=outside,
        snr=abs(inside - outside) / max(sigma, 1e-12 * abs(inside) + 1e-300),
        sigma=sigma,
        chi2_per_dof=float(np.sum(residuals**2)) / single**2 / max(2, 2 * count - 2),
        n_frames=count,
        method=method,
        residuals_px=residuals,
        psf=Psf(),
    )


def _scatter_px2(method: str, residuals: Array) -> float:
    """Variance per axis that the frames' own circles lend to the one of their reconstruction."""
    if method != "sr":
        return 0.0
    return SR_SHARE**2 * float(np.mean(residuals**2))


def _levels(frame: Array, centre: Array, radius: float) -> tuple[float, float]:
    """Medians inside of the circle and in a ring around it."""
    rows, cols = np.indices(frame.shape)
    distance = np.hypot(rows - centre[0], cols - centre[1])
    inside = frame[distance <= max(1.0, 0.6 * radius)]
    around = frame[(distance >= radius + 2.0) & (distance <= radius + 5.0)]
    return float(np.median(inside)), float(np.median(around)) if around.size else 0.0
