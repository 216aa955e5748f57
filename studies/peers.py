"""Other ways to find the centre of a round object, under one signature, for comparison.

Each takes a frame (rows, cols), a start (row, col) within a pixel or two and a radius in px, both
as given to ours, and returns the centre (row, col) with pixel (0, 0) centred at (0.0, 0.0). A peer
that finds nothing raises PeerFailedError. Circle finders see the part of the frame around the start
at their usual settings; centroids see a bright object on zero, whatever the frame shows.
"""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sr_engine.errors import EngineError
from sr_engine.hough import HoughSettings, Polarity, hough_circles
from sr_engine.localize import localize

Array = NDArray[np.float64]
Point = tuple[float, float]
Peer = Callable[[Array, Point, float], Array]

CROP_MARGIN_PX = 8
FARTHEST_PX = 3.0


class PeerFailedError(Exception):
    """The peer found no circle near the start."""


def ml(frame: Array, start_px: Point, radius_px: float) -> Array:
    """Ours: the maximum-likelihood fit."""
    try:
        radii = (0.6 * radius_px, 1.6 * radius_px)
        return localize(frame, start_px=start_px, radius_px=radii).centre_px
    except EngineError as error:
        raise PeerFailedError(str(error)) from error


def hough_paper(frame: Array, start_px: Point, radius_px: float) -> Array:
    """The paper's: phase-coded circle Hough transform."""
    part, corner = _crop(frame, start_px, radius_px)
    polarity: Polarity = "bright" if _is_bright(frame, start_px, radius_px) else "dark"
    settings = HoughSettings((max(1.0, 0.6 * radius_px), 1.5 * radius_px), polarity=polarity)
    try:
        circles = hough_circles(part, settings)
    except EngineError as error:
        raise PeerFailedError(str(error)) from error
    circles = sorted(circles, key=lambda c: -c.strength)
    return _first_near([np.add(c.centre_px, corner) for c in circles], start_px)


def radial_symmetry(frame: Array, start_px: Point, radius_px: float) -> Array:
    """Parthasarathy, Nat. Methods 9:724 (2012): where the lines along the gradients meet."""
    part, corner = _crop(frame, start_px, radius_px, margin=4)
    row_step, col_step = np.gradient(ndimage.uniform_filter(part, 3))
    size2 = row_step**2 + col_step**2
    rows, cols = np.indices(part.shape, dtype=float)
    middle = np.array([(size2 * rows).sum(), (size2 * cols).sum()]) / max(size2.sum(), 1e-300)
    distance = np.hypot(rows - middle[0], cols - middle[1])
    weight = size2 / np.maximum(distance, 0.5)
    size = np.sqrt(np.maximum(size2, 1e-300))
    across = np.stack([-col_step / size, row_step / size])  # perpendicular to the gradient
    matrix = np.einsum("irc,jrc,rc->ij", across, across, weight)
    places = np.stack([rows, cols])
    right = np.einsum("irc,jrc,jrc,rc->i", across, across, places, weight)
    return np.add(np.linalg.solve(matrix, right), corner)


def opencv_gradient(frame: Array, start_px: Point, radius_px: float) -> Array:
    """OpenCV HoughCircles, HOUGH_GRADIENT."""
    return _opencv(frame, start_px, radius_px, "HOUGH_GRADIENT", (30.0, 20.0, 12.0, 8.0, 5.0))


def opencv_gradient_alt(frame: Array, start_px: Point, radius_px: float) -> Array:
    """OpenCV HoughCircles, HOUGH_GRADIENT_ALT."""
    return _opencv(frame, start_px, radius_px, "HOUGH_GRADIENT_ALT", (0.9, 0.8, 0.6, 0.4, 0.2))


def _opencv(
    frame: Array, start_px: Point, radius_px: float, mode: str, thresholds: tuple[float, ...]
) -> Array:
    """Strictest threshold that finds a circle near the start."""
    import cv2

    part, corner = _crop(frame, start_px, radius_px)
    low, high = part.min(), part.max()
    grey = np.round(255 * (part - low) / (high - low)).astype(np.uint8)
    for threshold in thresholds:
        circles = cv2.HoughCircles(
            grey, getattr(cv2, mode), dp=1.0 if mode == "HOUGH_GRADIENT" else 1.5,
            minDist=max(2.0, radius_px), param1=100.0, param2=threshold,
            minRadius=int(0.6 * radius_px), maxRadius=int(np.ceil(1.5 * radius_px)),
        )  # fmt: skip
        if circles is None:
            continue
        try:
            return _first_near([np.add((c[1], c[0]), corner) for c in circles[0]], start_px)
        except PeerFailedError:
            continue
    raise PeerFailedError("HoughCircles found no circle near the start")


def skimage_hough(frame: Array, start_px: Point, radius_px: float) -> Array:
    """scikit-image canny, hough_circle and hough_circle_peaks."""
    from skimage.feature import canny
    from skimage.transform import hough_circle, hough_circle_peaks

    part, corner = _crop(frame, start_px, radius_px)
    radii = np.arange(max(2, int(0.6 * radius_px)), int(np.ceil(1.5 * radius_px)) + 1)
    accumulator = hough_circle(canny(part / np.ptp(part), sigma=1.0), radii)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, cols, rows, _ = hough_circle_peaks(accumulator, radii, total_num_peaks=10)
    return _first_near([np.add((r, c), corner) for r, c in zip(rows, cols, strict=True)], start_px)


def trackpy_locate(frame: Array, start_px: Point, radius_px: float) -> Array:
    """trackpy.locate: band pass, then the centroid of the neighbourhood, refined."""
    import trackpy

    part, corner = _crop(_upright(frame, start_px, radius_px), start_px, radius_px, margin=12)
    diameter = 2 * int(np.ceil(radius_px)) + 3
    scaled = np.round(1e4 * (part - part.min()) / np.ptp(part)).astype(np.uint16)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = trackpy.locate(scaled, diameter, engine="python", characterize=False)
    if found is None or len(found) == 0:
        raise PeerFailedError("trackpy found nothing")
    return _nearest([np.add((r, c), corner) for r, c in found[["y", "x"]].to_numpy()], start_px)


def photutils_com(frame: Array, start_px: Point, radius_px: float) -> Array:
    """photutils centroid_com: centre of mass above the background."""
    from photutils.centroids import centroid_com

    part, corner = _crop(_upright(frame, start_px, radius_px), start_px, radius_px, margin=3)
    col, row = centroid_com(np.where(part > 0.3 * part.max(), part, 0.0))
    return np.add((float(row), float(col)), corner)


def photutils_2dg(frame: Array, start_px: Point, radius_px: float) -> Array:
    """photutils centroid_2dg: fit of a two-dimensional Gaussian."""
    from photutils.centroids import centroid_2dg

    part, corner = _crop(_upright(frame, start_px, radius_px), start_px, radius_px, margin=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        col, row = centroid_2dg(part)
    return np.add((float(row), float(col)), corner)


PEERS: dict[str, Peer] = {
    "hough (paper)": hough_paper,
    "opencv HOUGH_GRADIENT": opencv_gradient,
    "opencv HOUGH_GRADIENT_ALT": opencv_gradient_alt,
    "skimage hough_circle": skimage_hough,
    "trackpy locate": trackpy_locate,
    "photutils centroid_com": photutils_com,
    "photutils centroid_2dg": photutils_2dg,
    "radial symmetry": radial_symmetry,
}


def run_peer(peer: Peer, frame: Array, start_px: Point, radius_px: float) -> Array:
    """The peer's centre. Raises PeerFailedError for any failure, and for one far from the start."""
    try:
        centre = np.asarray(peer(frame, start_px, radius_px), dtype=float)
    except PeerFailedError:
        raise
    except Exception as error:  # other people's code fails in its own ways; all count alike
        raise PeerFailedError(f"{type(error).__name__}: {error}") from error
    if not np.hypot(*(centre - start_px)) < FARTHEST_PX:
        raise PeerFailedError(f"ended at {centre}, far from the start")
    return centre


def _crop(
    frame: Array, start_px: Point, radius_px: float, margin: int = CROP_MARGIN_PX
) -> tuple[Array, Array]:
    reach = int(np.ceil(radius_px)) + margin
    r0, c0 = (max(0, round(x) - reach) for x in start_px)
    part = frame[r0 : round(start_px[0]) + reach + 1, c0 : round(start_px[1]) + reach + 1]
    return np.ascontiguousarray(part), np.array([r0, c0], dtype=float)


def _levels(frame: Array, start_px: Point, radius_px: float) -> tuple[float, float]:
    """Median inside of the object, and of a ring around it."""
    part, corner = _crop(frame, start_px, radius_px)
    rows, cols = np.indices(part.shape)
    distance = np.hypot(rows + corner[0] - start_px[0], cols + corner[1] - start_px[1])
    ring = (distance > radius_px + 2) & (distance < radius_px + 5)
    return float(np.median(part[distance < 0.7 * radius_px])), float(np.median(part[ring]))


def _is_bright(frame: Array, start_px: Point, radius_px: float) -> bool:
    inside, outside = _levels(frame, start_px, radius_px)
    return inside >= outside


def _upright(frame: Array, start_px: Point, radius_px: float) -> Array:
    """The frame with the object bright on a background about zero."""
    inside, outside = _levels(frame, start_px, radius_px)
    sign = 1.0 if inside >= outside else -1.0
    return np.maximum(sign * (frame - outside), 0.0)


def _first_near(centres: list[Array], start_px: Point) -> Array:
    """The strongest circle near the start."""
    for centre in centres:
        if np.hypot(*(centre - start_px)) < FARTHEST_PX:
            return centre
    raise PeerFailedError("no circle found near the start")


def _nearest(centres: list[Any], start_px: Point) -> Array:
    if not centres:
        raise PeerFailedError("nothing found")
    return np.asarray(min(centres, key=lambda c: float(np.hypot(*(np.asarray(c) - start_px)))))
