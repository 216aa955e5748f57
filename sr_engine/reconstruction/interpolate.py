"""Bicubic enlargement of one frame (Keys' cubic convolution, a = -1/2)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from sr_engine.frames import check_factor, check_frame


def enlarge_bicubic(frame: ArrayLike, factor: int = 2) -> NDArray[np.float64]:
    """``frame`` (rows, cols) on a grid ``factor`` times finer.

    Fine pixel j has its centre at (j + 1/2)/factor - 1/2 frame pixels (pixel areas coincide).
    Beyond the border the frame is mirrored. R. Keys, IEEE TASSP 29:1153 (1981).
    """
    image = check_frame(frame)
    rows, cols = (_weights(size, check_factor(factor)) for size in image.shape)
    return np.asarray(rows @ (cols @ image.T).T)


def fine_from_frame(points_px: ArrayLike, factor: int) -> NDArray[np.float64]:
    """Frame pixel coordinates (..., 2) to those of the fine grid: the half pixel is here."""
    return (np.asarray(points_px, dtype=np.float64) + 0.5) * factor - 0.5


def frame_from_fine(points_px: ArrayLike, factor: int) -> NDArray[np.float64]:
    """Fine grid coordinates (..., 2) to frame pixels."""
    return (np.asarray(points_px, dtype=np.float64) + 0.5) / factor - 0.5


def keys_kernel(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Keys' kernel with a = -1/2 at |distance| in pixels."""
    x = np.abs(distance)
    near = (1.5 * x - 2.5) * x * x + 1.0
    far = ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    return np.where(x <= 1.0, near, np.where(x < 2.0, far, 0.0))


@lru_cache(maxsize=64)
def _weights(size: int, factor: int) -> sparse.csr_array:
    fine = np.arange(size * factor)
    position = frame_from_fine(fine, factor)
    taps = np.floor(position).astype(np.int64)[:, None] + np.arange(-1, 3)
    values = keys_kernel(position[:, None] - taps)
    # Mirrored with the edge pixel repeated, with period 2 * size so that tiny frames work too.
    wrapped = np.mod(taps, 2 * size)
    taps = np.where(wrapped < size, wrapped, 2 * size - 1 - wrapped)
    index = (np.repeat(fine, 4), taps.ravel())
    return sparse.csr_array((values.ravel(), index), shape=(size * factor, size))
