"""Iterative back-projection by gradient descent: the paper's way to a reconstruction.

Minimises  sum_k |D_k B_k M_k X - I_k|^2  over the fine image X: M_k displaces it by d_k
(bilinear), B_k blurs it, D_k averages ``factor`` x ``factor`` fine pixels into one. The step
length is the exact minimiser along the gradient. Irani & Peleg, CVGIP 53:231 (1991).

The paper stops at 100 iterations or when the mean squared error has fallen below 0.01 % of
its start. On noisy frames late iterations only fit noise, so the default stops as soon as the
residual is as small as the noise (discrepancy principle).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from sr_engine.errors import ParameterError
from sr_engine.frames import check_factor, check_frames_and_shifts
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.interpolate import fine_from_frame

Image = NDArray[np.float64]
Observer = Callable[[int, float], None]


@dataclass(frozen=True)
class Stopping:
    """When to stop. ``noise_sigma`` None means: not by the noise."""

    max_iterations: int = 100
    relative_mse: float = 1e-4
    noise_sigma: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.max_iterations <= 100_000:
            raise ParameterError(
                f"max_iterations is {self.max_iterations}; it must lie in 1 to 100000"
            )
        if not 0.0 <= self.relative_mse < 1.0:
            raise ParameterError(f"relative_mse is {self.relative_mse}; it must lie in 0 to 1")
        if self.noise_sigma is not None and not 0.0 <= self.noise_sigma < math.inf:
            raise ParameterError(f"noise_sigma is {self.noise_sigma}; it must be 0 or positive")

    def reason(self, iteration: int, mse: float, start_mse: float) -> str:
        """Why to stop after ``iteration`` iterations at ``mse``; empty while going on."""
        if self.noise_sigma is not None and mse <= self.noise_sigma**2:
            return "noise"
        if mse <= self.relative_mse * start_mse:
            return "relative-mse"
        if iteration >= self.max_iterations:
            return "max-iterations"
        return ""


PAPER = Stopping()
"""100 iterations, or 0.01 % of the mean squared error before optimisation."""


@dataclass(frozen=True, eq=False)
class Descent:
    """The fine image, the mean squared error before and after each iteration, why it ended."""

    image: Image
    residual_history: tuple[float, ...]
    stopped_by: str

    @property
    def iterations(self) -> int:
        return len(self.residual_history) - 1


def reconstruct_ibp(
    frames: ArrayLike,
    shifts_px: ArrayLike,
    factor: int = 2,
    *,
    blur: Blur | None = None,
    stopping: Stopping | None = None,
    observe: Observer | None = None,
) -> Descent:
    """Gradient descent from the mean of the back-projected frames.

    Any number of frames; what they leave undetermined stays as the start has it.
    ``stopping`` None: the paper's rule, or earlier by the discrepancy principle with the noise
    estimated from the frames. ``observe(iteration, mse)`` is called at each iteration.
    Raises ShapeError or NotFiniteError.
    """
    stack, shifts = check_frames_and_shifts(frames, shifts_px)
    if stopping is None:
        stopping = Stopping(noise_sigma=estimate_noise_sigma(stack))
    views = [_View.of(stack[0].shape, tuple(d), check_factor(factor), blur) for d in shifts]
    return _descend(stack, views, _start(stack, views), stopping, observe)


def estimate_noise_sigma(frames: NDArray[np.float64]) -> float:
    """Standard deviation of the noise, from what no smooth scene leaves behind.

    A second difference along both axes removes planes and straight axis-parallel edges; the
    median over all pixels ignores the few on the object's edge. Immerkaer, CVIU 64:300 (1996).
    Too small where a scanner has interpolated, because neighbours then share their noise.
    """
    along_rows = frames[:, :-2] - 2 * frames[:, 1:-1] + frames[:, 2:]
    both = along_rows[:, :, :-2] - 2 * along_rows[:, :, 1:-1] + along_rows[:, :, 2:]
    return float(np.median(np.abs(both)) / 0.6744897501960817 / 6.0)


@dataclass(frozen=True, eq=False)
class _View:
    """A_k = D B M_k of one frame: separable, so one sparse matrix for each axis."""

    rows: sparse.csr_array
    cols: sparse.csr_array
    rows_transposed: sparse.csr_array
    cols_transposed: sparse.csr_array

    @classmethod
    def of(
        cls, shape: tuple[int, ...], shift: tuple[float, ...], factor: int, blur: Blur | None
    ) -> _View:
        seen_as = blur or Blur(box=True)
        rows, cols = (
            view_matrix(size, factor, float(moved), seen_as)
            for size, moved in zip(shape, shift, strict=True)
        )
        return cls(rows, cols, rows.T.tocsr(), cols.T.tocsr())

    def forward(self, image: Image) -> Image:
        return np.asarray(self.rows @ (self.cols @ image.T).T)

    def back(self, residual: Image) -> Image:
        return np.asarray(self.rows_transposed @ (self.cols_transposed @ residual.T).T)


@lru_cache(maxsize=256)
def view_matrix(size: int, factor: int, shift_px: float, blur: Blur) -> sparse.csr_array:
    """One axis of D B M: fine pixels (factor * size) to frame pixels (size). Rows sum to 1."""
    moved = _displacement(size * factor, shift_px * factor)
    blurred = _gaussian(size * factor, blur.gaussian_sigma_px * factor) @ moved
    return sparse.csr_array(_sampling(size, factor, blur.box) @ blurred)


def _displacement(size: int, shift: float) -> sparse.csr_array:
    """Fine pixel j shows what was at j - shift (linear interpolation, border repeated)."""
    return _interpolation(np.arange(size, dtype=np.float64) - shift, size)


def _interpolation(position: Image, size: int) -> sparse.csr_array:
    left = np.floor(position).astype(np.int64)
    part = position - left
    taps = np.clip(np.stack([left, left + 1], axis=1), 0, size - 1)
    values = np.stack([1.0 - part, part], axis=1)
    index = (np.repeat(np.arange(len(position)), 2), taps.ravel())
    return sparse.csr_array((values.ravel(), index), shape=(len(position), size))


def _gaussian(size: int, sigma: float) -> sparse.csr_array:
    if sigma == 0.0:
        return sparse.eye_array(size, format="csr")
    reach = max(1, math.ceil(4 * sigma))
    offsets = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (offsets / sigma) ** 2)
    weights /= weights.sum()
    taps = np.clip(np.arange(size)[:, None] + offsets, 0, size - 1)
    index = (np.repeat(np.arange(size), len(offsets)), taps.ravel())
    return sparse.csr_array((np.tile(weights, size), index), shape=(size, size))


def _sampling(size: int, factor: int, box: bool) -> sparse.csr_array:
    if not box:
        return _interpolation(fine_from_frame(np.arange(size), factor), size * factor)
    index = (np.repeat(np.arange(size), factor), np.arange(size * factor))
    return sparse.csr_array((np.full(size * factor, 1.0 / factor), index))


def _start(stack: Image, views: list[_View]) -> Image:
    """The frames put back where they came from, each fine pixel the mean of what saw it."""
    total = _back_projected(views, list(stack))
    weight = _back_projected(views, [np.ones_like(frame) for frame in stack])
    return np.asarray(total / np.maximum(weight, 1e-12))


def _back_projected(views: list[_View], residuals: list[Image]) -> Image:
    """sum_k A_k^T r_k."""
    return np.asarray(sum(view.back(r) for view, r in zip(views, residuals, strict=True)))


def _descend(
    stack: Image,
    views: list[_View],
    image: Image,
    stopping: Stopping,
    observe: Observer | None,
) -> Descent:
    residuals = [view.forward(image) - seen for view, seen in zip(views, stack, strict=True)]
    history = [_mean_square(residuals)]
    # Below the rounding of the frames themselves there is nothing left to explain.
    rounding = 1e-30 * _mean_square(list(stack))
    while not (why := stopping.reason(len(history) - 1, history[-1], history[0])):
        if history[-1] <= rounding:
            why = "rounding"
            break
        gradient = _back_projected(views, residuals)
        change = [view.forward(gradient) for view in views]
        curvature = sum(_square(c) for c in change)
        if curvature == 0.0:
            why = "stationary"
            break
        step = _square(gradient) / curvature
        image = image - step * gradient
        for residual, moved in zip(residuals, change, strict=True):
            residual -= step * moved
        history.append(_mean_square(residuals))
        if observe is not None:
            observe(len(history) - 1, history[-1])
    return Descent(image, tuple(history), why)


def _mean_square(residuals: list[Image]) -> float:
    return sum(_square(r) for r in residuals) / (len(residuals) * residuals[0].size)


def _square(values: Image) -> float:
    # Not a BLAS product: its threads cost more than they save on images of this size.
    return float(np.sum(np.square(values)))
