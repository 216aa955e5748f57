"""What must hold of frames, shifts and start values before anything is computed from them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.errors import (
    ConstantFrameError,
    NonSquarePixelsError,
    NotFiniteError,
    ParameterError,
    SaturatedError,
    ShapeError,
)

Array = NDArray[np.float64]

_SMALLEST_FRAME = 8  # pixels along an axis; less does not hold an object and its surroundings
_SQUARE_WITHIN = 0.01  # an ellipse of so little moves no centre and few radii
_SATURATED_SHARE = 0.25  # of the object's area at the very same highest value


def checked_frames(frames: ArrayLike) -> Array:
    """Frames as float64 (N, rows, cols), from one frame (rows, cols) or several of one size."""
    try:
        array = np.asarray(frames, dtype=float)
    except (ValueError, TypeError) as error:
        shapes = [np.shape(f) for f in frames] if np.iterable(frames) else []
        raise ShapeError(
            f"frames must be numeric and of the same size, got shapes {shapes}"
        ) from error
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[0] == 0:
        raise ShapeError(f"expected one frame or a list of frames, got shape {array.shape}")
    if min(array.shape[1:]) < _SMALLEST_FRAME:
        raise ShapeError(
            f"frames need at least {_SMALLEST_FRAME} pixels along each axis, got {array.shape[1:]}"
        )
    for k, frame in enumerate(array):
        if not np.isfinite(frame).all():
            bad = int(np.count_nonzero(~np.isfinite(frame)))
            raise NotFiniteError(f"frame {k} has {bad} pixels that are not finite")
        if np.ptp(frame) == 0:
            raise ConstantFrameError(f"frame {k} is constant: every pixel is {frame[0, 0]:g}")
    return array


def checked_shifts(shifts_px: ArrayLike | None, n_frames: int) -> Array:
    """Shifts (N, 2) in px, zero for one frame without any."""
    if shifts_px is None:
        if n_frames != 1:
            raise ShapeError(f"{n_frames} frames need shifts; none were given")
        return np.zeros((1, 2))
    shifts = np.asarray(shifts_px, dtype=float)
    if shifts.shape != (n_frames, 2):
        raise ShapeError(
            f"{n_frames} frames need shifts of shape ({n_frames}, 2), got {shifts.shape}"
        )
    if not np.isfinite(shifts).all():
        raise NotFiniteError("a shift is not finite")
    return shifts


def checked_radii(radius_px: tuple[float, float] | float | None) -> tuple[float, float] | None:
    """Radius range (low, high); a single number means 25 % to either side."""
    if radius_px is None:
        return None
    pair = np.atleast_1d(np.asarray(radius_px, dtype=float))
    low, high = (0.75 * pair[0], 1.25 * pair[0]) if pair.size == 1 else pair
    if not 0 < low < high < np.inf:
        raise ParameterError(f"radius range must be 0 < low < high, got ({low}, {high}) px")
    return float(low), float(high)


def checked_point(point_px: ArrayLike | None, name: str) -> tuple[float, float] | None:
    """(row, col), or None."""
    if point_px is None:
        return None
    point = np.asarray(point_px, dtype=float)
    if point.shape != (2,):
        raise ShapeError(f"{name} must be (row, col), got shape {point.shape}")
    if not np.isfinite(point).all():
        raise NotFiniteError(f"{name} is not finite: {point}")
    return float(point[0]), float(point[1])


def refuse_non_square(spacing_mm: tuple[float, float]) -> None:
    """Raise NonSquarePixelsError where the sides of a pixel differ by more than 1 %."""
    between_rows, between_cols = spacing_mm
    if not abs(between_rows / between_cols - 1) <= _SQUARE_WITHIN:
        raise NonSquarePixelsError(
            f"pixels of {between_rows:g} x {between_cols:g} mm (between rows, between columns) "
            "are not square: a round object would appear as an ellipse"
        )


def refuse_saturated(values: Array, radius_px: float, level: float | None) -> None:
    """Raise where much of the object, or of what surrounds it, stands at the highest value.

    level: value at which the source saturates, where it is known. Otherwise many pixels at one
    highest value among noise are taken for it; without noise (a drawing) they prove nothing.
    """
    top = float(values.max()) if level is None else level
    at_top = int(np.count_nonzero(values >= top))
    if at_top < _SATURATED_SHARE * np.pi * radius_px**2:
        return
    others = values[values < top]
    noiseless = others.size == 0 or np.unique(others).size < 0.5 * others.size
    if level is not None or not noiseless:
        raise SaturatedError(f"{at_top} pixels at or near the object are saturated at {top:g}")
