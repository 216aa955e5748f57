"""Circles by phase-coded Hough transform: how the paper finds its fiducial.

Written from the published description (T. J. Atherton, D. J. Kerbyson, "Size invariant circle
detection", Image and Vision Computing 17:795, 1999) and the documented behaviour of the
function that the paper used: Sobel gradients; edge pixels above a fraction of the largest
gradient (Otsu); each votes along its gradient at every radius with the radius as a phase; the
modulus of the accumulator, median-filtered; its h-maxima. Known to be inaccurate for radii of
5 px and less, and sensitive to ``sensitivity``: it is here as the baseline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from skimage.measure import label
from skimage.morphology import local_maxima, reconstruction

from sr_engine.errors import ConstantFrameError, NoRoundObjectError, ParameterError
from sr_engine.frames import check_frame

Polarity = Literal["bright", "dark", "both"]
Image = NDArray[np.float64]


@dataclass(frozen=True)
class Circle:
    """Centre (row, col) and radius in px; ``strength`` is the height of the accumulator's peak."""

    centre_px: tuple[float, float]
    radius_px: float
    strength: float


@dataclass(frozen=True)
class HoughSettings:
    """``radius_px`` is the range searched, in steps of ``radius_step_px``.

    ``sensitivity`` in 0..1: peaks lower than 1 - sensitivity above their surroundings are
    dropped, and the rest are cut off that far below their tops. ``edge_threshold`` in 0..1 is
    a fraction of the largest gradient; None takes Otsu's. ``polarity`` is that of the object.
    """

    radius_px: tuple[float, float]
    sensitivity: float = 0.85
    edge_threshold: float | None = None
    polarity: Polarity = "bright"
    radius_step_px: float = 0.5

    def __post_init__(self) -> None:
        low, high = self.radius_px
        if not 1.0 <= low < high < math.inf:
            raise ParameterError(f"radius range is {low} to {high} px; 1 <= low < high is needed")
        if not 0.0 < self.sensitivity < 1.0:
            raise ParameterError(
                f"sensitivity is {self.sensitivity}; it must lie strictly between 0 and 1"
            )
        if self.edge_threshold is not None and not 0.0 <= self.edge_threshold < 1.0:
            raise ParameterError(f"edge_threshold is {self.edge_threshold}; 0 <= t < 1 is needed")
        if not 0.05 <= self.radius_step_px <= 10.0:
            raise ParameterError(f"radius_step_px is {self.radius_step_px}; 0.05 to 10 is needed")
        if self.polarity not in ("bright", "dark", "both"):
            raise ParameterError(f"polarity is {self.polarity!r}; bright, dark or both is needed")

    def scaled(self, factor: int) -> HoughSettings:
        """The same search on an image ``factor`` times finer."""
        low, high = self.radius_px
        return HoughSettings(
            (low * factor, high * factor),
            self.sensitivity,
            self.edge_threshold,
            self.polarity,
            self.radius_step_px,
        )


def hough_circles(image: ArrayLike, settings: HoughSettings) -> list[Circle]:
    """All circles in ``image`` (rows, cols), strongest first; none is an empty list.

    Raises ShapeError, NotFiniteError, ConstantFrameError.
    """
    accumulator = accumulate(check_frame(image, "the image"), settings)
    height = 1.0 - settings.sensitivity
    modulus = np.abs(accumulator)
    # Zeros beyond the border, as in the paper's tool.
    smooth = ndimage.median_filter(modulus, size=5, mode="constant")
    if smooth.max() <= height:
        return []
    cut = reconstruction(smooth - height, smooth)
    plateaus = label(local_maxima(cut), connectivity=2)
    found = [
        _circle(accumulator, modulus, cut, where, settings)
        for where in _members(plateaus)
        if cut[where[0][0], where[1][0]] > 0.0
    ]
    return sorted(found, key=lambda circle: -circle.strength)


def strongest_circle(image: ArrayLike, settings: HoughSettings) -> Circle:
    """The strongest circle. Raises NoRoundObjectError when there is none."""
    found = hough_circles(image, settings)
    if not found:
        low, high = settings.radius_px
        raise NoRoundObjectError(
            f"no circle of radius {low:g} to {high:g} px at sensitivity {settings.sensitivity:g}"
        )
    return found[0]


def accumulate(image: Image, settings: HoughSettings) -> NDArray[np.complex128]:
    """The complex accumulator, same shape as ``image``: a full circle adds up to about 1."""
    points, directions = _edges(image, settings.edge_threshold)
    radii = _radii(settings)
    votes = np.exp(1j * _phase_of_radius(radii, settings)) / (2 * math.pi * radii)
    # The gradient points uphill: to the centre of a bright disc, away from that of a dark one.
    signs = {"bright": (1,), "dark": (-1,), "both": (1, -1)}[settings.polarity]
    reach = np.concatenate([sign * radii for sign in signs])
    weights = np.tile(votes, len(signs))
    at = np.rint(points[:, None, :] + reach[None, :, None] * directions[:, None, :])
    inside = ((at >= 0) & (at < image.shape)).all(axis=2)
    cells = at[inside].astype(np.intp) @ np.array([image.shape[1], 1])
    weight = np.broadcast_to(weights, inside.shape)[inside]
    real, imag = (np.bincount(cells, part, image.size) for part in (weight.real, weight.imag))
    return (real + 1j * imag).reshape(image.shape)


def otsu_threshold(values: Image, bins: int = 256) -> float:
    """The threshold in 0..1 that splits ``values`` (0..1) into the two tightest groups."""
    counts, edges = np.histogram(values, bins=bins, range=(0.0, 1.0))
    middle = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)
    above = below[-1] - below
    mass = np.cumsum(counts * middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (mass / below - (mass[-1] - mass) / above) ** 2
    between = np.nan_to_num(between[:-1], nan=-1.0)
    # A flat top (no value between two peaks) counts as its middle.
    best = np.flatnonzero(between == between.max())
    return float(edges[1:][best].mean())


def _edges(image: Image, threshold: float | None) -> tuple[Image, Image]:
    """Edge pixels (E, 2) and the unit gradients there (E, 2), (row, col)."""
    gradient = np.stack([ndimage.sobel(image, axis, mode="nearest") for axis in (0, 1)], axis=-1)
    size = np.hypot(gradient[..., 0], gradient[..., 1])
    largest = size.max()
    if largest <= 1e-12 * np.abs(image).max():
        raise ConstantFrameError("the image is constant: it has no edge")
    relative = size / largest
    strong = relative > (otsu_threshold(relative) if threshold is None else threshold)
    return np.argwhere(strong).astype(np.float64), gradient[strong] / size[strong][:, None]


def _radii(settings: HoughSettings) -> Image:
    low, high = settings.radius_px
    steps = math.floor((high - low) / settings.radius_step_px + 1e-9)
    return np.asarray(low + settings.radius_step_px * np.arange(steps + 1), dtype=np.float64)


def _phase_of_radius(radii: Image, settings: HoughSettings) -> Image:
    low, high = (math.log(radius) for radius in settings.radius_px)
    return 2 * math.pi * (np.log(radii) - low) / (high - low) - math.pi


def _radius_of_phase(phase: float, settings: HoughSettings) -> float:
    low, high = (math.log(radius) for radius in settings.radius_px)
    return math.exp((phase + math.pi) / (2 * math.pi) * (high - low) + low)


def _members(labels: NDArray[np.int64]) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Rows and columns of each labelled plateau."""
    boxes = ndimage.find_objects(labels)
    members = []
    for number, box in enumerate(boxes, start=1):
        rows, cols = np.nonzero(labels[box] == number)
        members.append((rows + box[0].start, cols + box[1].start))
    return members


def _circle(
    accumulator: NDArray[np.complex128],
    modulus: Image,
    cut: Image,
    where: tuple[NDArray[np.intp], NDArray[np.intp]],
    settings: HoughSettings,
) -> Circle:
    weight = modulus[where]
    if weight.sum() == 0.0:
        weight = np.ones_like(weight)
    row, col = (float(np.average(index, weights=weight)) for index in where)
    phase = float(np.angle(accumulator[round(row), round(col)]))
    return Circle(
        (row, col),
        _radius_of_phase(phase, settings),
        float(cut[where][0]) + 1.0 - settings.sensitivity,
    )
