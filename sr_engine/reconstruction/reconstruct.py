"""One finer image from frames taken at known shifts: the methods behind one function."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from sr_engine.errors import ParameterError
from sr_engine.frames import Region, check_factor, check_frames_and_shifts, whole
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.fourier import Prior, prepare_filters
from sr_engine.reconstruction.ibp import Observer, Stopping, reconstruct_ibp
from sr_engine.reconstruction.interpolate import fine_from_frame, frame_from_fine
from sr_engine.reconstruction.shiftset import (
    MAX_CONDITION_NUMBER,
    condition_number,
    noise_factor,
)

Method = Literal["fourier", "ibp"]
Border = Literal["periodic", "blend"]

MARGIN_PX = 8
"""Around a region of interest: wide enough that the cut does not ring into it."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A finer image in the reference pose, and how far to trust it.

    ``region`` is the part of the frame that ``image`` covers; fine pixel (0, 0) is the first
    of the ``factor`` x ``factor`` that share the region's first frame pixel.
    ``condition_number`` and ``noise_factor`` are those of the shift set (1 is ideal; inf: the
    shifts leave something open). ``residual_history`` is the mean squared error before and
    after each iteration, empty for the closed form; ``stopped_by`` says why it ended.
    """

    image: NDArray[np.float64]
    factor: int
    method: Method
    region: Region
    n_frames: int
    condition_number: float
    noise_factor: float
    residual_history: tuple[float, ...] = ()
    stopped_by: str = "closed-form"

    @property
    def iterations(self) -> int:
        return max(0, len(self.residual_history) - 1)

    def frame_from_fine(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Positions in ``image`` (..., 2) to pixels of the frame they came from."""
        return frame_from_fine(points_px, self.factor) + self._corner()

    def fine_from_frame(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Pixels of the frame (..., 2) to positions in ``image``."""
        return fine_from_frame(np.asarray(points_px) - self._corner(), self.factor)

    def _corner(self) -> NDArray[np.float64]:
        return np.array([self.region.row_start, self.region.col_start], dtype=np.float64)


def reconstruct(
    frames: ArrayLike,
    shifts_px: ArrayLike,
    factor: int = 2,
    method: Method = "fourier",
    *,
    region: Region | None = None,
    blur: Blur | None = None,
    border: Border = "periodic",
    prior: Prior | None = None,
    max_condition_number: float = MAX_CONDITION_NUMBER,
    stopping: Stopping | None = None,
    observe: Observer | None = None,
) -> Reconstruction:
    """Frames (N, rows, cols) at shifts_px (N, 2) to one image ``factor`` times finer.

    ``shifts_px[k]`` is the displacement (row, col) of the fiducial in frame k. ``region``
    keeps out what does not move with the robot. ``blur`` None: points for ``fourier``, pixel
    areas for ``ibp``. ``border`` "blend" extends frames whose opposite borders differ (camera
    frames) by a smooth bridge; cut-outs are always bridged. ``prior`` and
    ``max_condition_number`` belong to ``fourier``, ``stopping`` and ``observe`` to ``ibp``.

    Raises ShapeError, NotFiniteError, ParameterError, SingularShiftSetError (``fourier``).
    """
    stack, shifts = check_frames_and_shifts(frames, shifts_px)
    check_factor(factor)
    shape = (int(stack.shape[1]), int(stack.shape[2]))
    wanted = (region or whole(shape)).check(shape)
    read = wanted if wanted == whole(shape) else wanted.grown(_margin(shifts), shape)
    cut = stack[(slice(None), *read.slices)]
    history: tuple[float, ...] = ()
    stopped_by = "closed-form"
    if method == "fourier":
        bridged = border == "blend" or read != whole(shape)
        fine = _fourier(cut, shifts, factor, bridged, blur, prior, max_condition_number)
    elif method == "ibp":
        descent = reconstruct_ibp(
            cut, shifts, factor, blur=blur, stopping=stopping, observe=observe
        )
        fine, history, stopped_by = descent.image, descent.residual_history, descent.stopped_by
    else:
        raise ParameterError(f"method is {method!r}; fourier or ibp is needed")
    return Reconstruction(
        image=_inner(fine, wanted, read, factor),
        factor=factor,
        method=method,
        region=wanted,
        n_frames=len(stack),
        condition_number=condition_number(shifts, factor),
        noise_factor=noise_factor(shifts, factor),
        residual_history=history,
        stopped_by=stopped_by,
    )


def _margin(shifts: NDArray[np.float64]) -> int:
    return MARGIN_PX + math.ceil(float(np.abs(shifts).max()))


def _fourier(
    stack: NDArray[np.float64],
    shifts: NDArray[np.float64],
    factor: int,
    bridged: bool,
    blur: Blur | None,
    prior: Prior | None,
    max_condition_number: float,
) -> NDArray[np.float64]:
    rows, cols = stack.shape[1:]
    if bridged:
        stack = bridge(bridge(stack, shifts, axis=1), shifts, axis=2)
    shape = (int(stack.shape[1]), int(stack.shape[2]))
    filters = prepare_filters(
        shape, shifts, factor, blur=blur, prior=prior, max_condition_number=max_condition_number
    )
    return filters.apply(stack)[: factor * rows, : factor * cols]


def bridge(
    stack: NDArray[np.float64], shifts: NDArray[np.float64], axis: int
) -> NDArray[np.float64]:
    """``stack`` with pixels appended along ``axis`` that lead smoothly from its end to its start.

    What a Fourier transform takes for the neighbour of the last pixel is the first one; a step
    between them would ring through the image. The bridge moves with the frames' shifts, as if
    it stood in the scene; a bridge that contradicts the shifts would ring as well.
    """
    size = stack.shape[axis]
    added = int(fft.next_fast_len(size + 2 * MARGIN_PX, real=True)) - size
    way = (np.arange(added) + 1 - shifts[:, axis - 1 : axis]) / (added + 1)
    weight = 0.5 - 0.5 * np.cos(math.pi * np.clip(way, 0.0, 1.0))
    weight = weight[:, :, None] if axis == 1 else weight[:, None, :]
    last, first = (np.take(stack, [end], axis=axis) for end in (-1, 0))
    return np.concatenate([stack, last * (1 - weight) + first * weight], axis=axis)


def _inner(
    fine: NDArray[np.float64], wanted: Region, read: Region, factor: int
) -> NDArray[np.float64]:
    row, col = wanted.row_start - read.row_start, wanted.col_start - read.col_start
    rows, cols = wanted.shape
    return np.ascontiguousarray(
        fine[row * factor : (row + rows) * factor, col * factor : (col + cols) * factor]
    )
