"""What every engine function asks of its pixels: finite, two-dimensional, of one size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.errors import NotFiniteError, ParameterError, ShapeError

MIN_SIDE_PX = 4


def check_frame(frame: ArrayLike, what: str = "the frame") -> NDArray[np.float64]:
    """One frame (rows, cols) as float64. Raises ShapeError or NotFiniteError."""
    if np.iscomplexobj(frame):
        raise ShapeError(f"{what} is complex; magnitude pixels are needed")
    try:
        image = np.asarray(frame, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{what} is not a rectangular array of numbers") from error
    if image.ndim != 2 or min(image.shape) < MIN_SIDE_PX:
        raise ShapeError(
            f"{what} has shape {image.shape}; (rows, cols) of at least {MIN_SIDE_PX} px is needed"
        )
    if not np.isfinite(image).all():
        row, col = (int(i) for i in np.argwhere(~np.isfinite(image))[0])
        raise NotFiniteError(f"{what} has a non-finite value at row {row}, col {col}")
    return image


def check_frames(frames: ArrayLike) -> NDArray[np.float64]:
    """Frames as float64 (N, rows, cols); one frame (rows, cols) becomes N = 1."""
    if isinstance(frames, np.ndarray) and frames.ndim == 2:
        frames = frames[None]
    listed = list(frames)  # type: ignore[arg-type]
    if not listed:
        raise ShapeError("the list of frames is empty; at least one frame is needed")
    checked = [check_frame(frame, f"frame {index}") for index, frame in enumerate(listed)]
    for index, frame in enumerate(checked):
        if frame.shape != checked[0].shape:
            raise ShapeError(f"frame {index} is {frame.shape} but frame 0 is {checked[0].shape}")
    return np.stack(checked)


def check_frames_and_shifts(
    frames: ArrayLike, shifts_px: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frames (N, rows, cols) and as many shifts (N, 2); no shifts are right for one frame only."""
    stack = check_frames(frames)
    if shifts_px is None:
        if len(stack) != 1:
            raise ShapeError(f"{len(stack)} frames without shifts; give one (row, col) pair each")
        return stack, np.zeros((1, 2))
    return stack, check_shifts(shifts_px, count=len(stack))


def check_shifts(shifts_px: ArrayLike, count: int | None = None) -> NDArray[np.float64]:
    """Shifts as a float64 array (N, 2); ``count`` is the number of frames they belong to."""
    try:
        shifts = np.asarray(shifts_px, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError("shifts_px must be a list of (row, col) pairs of numbers") from error
    if shifts.size == 0:
        raise ShapeError("the list of shifts is empty; at least one (row, col) pair is needed")
    if shifts.ndim != 2 or shifts.shape[1] != 2:
        raise ShapeError(f"shifts_px has shape {shifts.shape}; (N, 2) for (row, col) is needed")
    if not np.isfinite(shifts).all():
        bad = int(np.flatnonzero(~np.isfinite(shifts).all(axis=1))[0])
        raise NotFiniteError(f"shifts_px[{bad}] is not finite: {tuple(shifts[bad].tolist())}")
    if count is not None and len(shifts) != count:
        raise ShapeError(f"one shift per frame is needed: frames {count}, shifts {len(shifts)}")
    return shifts


def check_factor(factor: int) -> int:
    if isinstance(factor, bool) or factor not in (2, 3, 4):
        raise ParameterError(f"factor is {factor!r}; 2, 3 and 4 are supported")
    return int(factor)


@dataclass(frozen=True)
class Region:
    """Rows [row_start, row_stop), columns [col_start, col_stop) of a frame."""

    row_start: int
    col_start: int
    row_stop: int
    col_stop: int

    def check(self, shape: tuple[int, int]) -> Region:
        """Itself if it lies in a frame of ``shape`` and is no smaller than MIN_SIDE_PX."""
        tall = 0 <= self.row_start <= self.row_stop - MIN_SIDE_PX <= shape[0] - MIN_SIDE_PX
        wide = 0 <= self.col_start <= self.col_stop - MIN_SIDE_PX <= shape[1] - MIN_SIDE_PX
        if not (tall and wide):
            raise ShapeError(
                f"region rows {self.row_start} to {self.row_stop}, cols {self.col_start} to "
                f"{self.col_stop} does not lie in a frame of {shape[0]} x {shape[1]} px "
                f"or is smaller than {MIN_SIDE_PX} px"
            )
        return self

    def grown(self, margin: int, shape: tuple[int, int]) -> Region:
        """Wider by ``margin`` px on all sides, as far as the frame reaches."""
        return Region(
            max(0, self.row_start - margin),
            max(0, self.col_start - margin),
            min(shape[0], self.row_stop + margin),
            min(shape[1], self.col_stop + margin),
        )

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.row_start, self.row_stop), slice(self.col_start, self.col_stop)

    @property
    def shape(self) -> tuple[int, int]:
        return self.row_stop - self.row_start, self.col_stop - self.col_start


def whole(shape: tuple[int, int]) -> Region:
    return Region(0, 0, *shape)
