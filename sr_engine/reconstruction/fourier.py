"""Super-resolution in closed form: one small linear system a frequency, solved in advance.

The scene X lives on a grid ``factor`` times finer than the frames. Frame k sees it displaced by
d_k, blurred by H and sampled. In Fourier space the frames' frequency u mixes the aliases u_m:

    G_k(u) = s^-2 sum_m H(u_m) exp(-2 pi i u_m.d_k) F(u_m)

and the minimiser of  sum_k |A_k X - I_k|^2 + lambda |Gamma X|^2  is
F = (B^H B + lambda Gamma)^-1 B^H G, exactly. The filters depend on the shifts alone, so they
are made once; each reconstruction is N FFTs, one small multiply a frequency, one inverse FFT.

All operators are real: at the Nyquist frequency of the fine grid the phase is its cosine.
References: Elad & Hel-Or, IEEE TIP 10:1187 (2001); Zhao et al., IEEE TIP 25:3683 (2016);
Robinson & Milanfar, IEEE TIP 15:1413 (2006).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from sr_engine.errors import ParameterError
from sr_engine.frames import check_factor, check_frames_and_shifts, check_shifts
from sr_engine.reconstruction.blur import Blur
from sr_engine.reconstruction.shiftset import MAX_CONDITION_NUMBER, require_regular

Complex = NDArray[np.complex128]

REGULARIZATION_FLOOR = 1e-13
"""Keeps the fine Nyquist frequency solvable where the shifts leave it undetermined."""


@dataclass(frozen=True)
class Prior:
    """lambda and Gamma of the closed form.

    ``strength`` is lambda in units of N / factor^2, the diagonal of sum_k A_k^T A_k without
    blur: roughly noise power over signal power. ``smooth`` weighs frequencies by
    (4 - 2 cos - 2 cos)/8, which leaves the mean brightness untouched; otherwise all are
    weighed alike.
    """

    strength: float = 1e-3
    smooth: bool = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.strength <= 1e6:
            raise ParameterError(f"prior strength is {self.strength}; it must lie in 0 to 1e6")


@dataclass(frozen=True, eq=False)
class FourierFilters:
    """The solved systems of one shift set, frame shape and factor.

    ``weights`` has shape (N, factor, rows, factor * cols // 2 + 1): for each frame, what its
    spectrum contributes to each frequency of the fine grid (fine row = first * rows + second).
    """

    shape: tuple[int, int]
    factor: int
    weights: Complex
    alias_cols: NDArray[np.intp]

    def apply(self, frames: NDArray[np.float64]) -> NDArray[np.float64]:
        """Frames (N, rows, cols) to the scene (factor * rows, factor * cols)."""
        factor, (rows, cols) = self.factor, self.shape
        fine = np.zeros(self.weights.shape[1:], dtype=np.complex128)
        product = np.empty_like(fine)
        for frame, weight in zip(frames, self.weights, strict=True):
            spectrum = _full_columns(fft.rfft2(frame), cols, self.alias_cols)
            np.multiply(weight, spectrum, out=product)
            fine += product
        fine_shape = (factor * rows, factor * cols)
        half = fine.reshape(fine_shape[0], -1)
        return np.asarray(fft.irfft2(half, s=fine_shape, overwrite_x=True))


def reconstruct_fourier(
    frames: ArrayLike,
    shifts_px: ArrayLike,
    factor: int = 2,
    *,
    blur: Blur | None = None,
    prior: Prior | None = None,
    max_condition_number: float = MAX_CONDITION_NUMBER,
) -> NDArray[np.float64]:
    """The scene (factor * rows, factor * cols) in the reference pose.

    Frames are taken as periodic, which MR frames are by their nature; ``reconstruct`` extends
    cut-outs and camera frames first. Fine pixel j lies at (j + 1/2)/factor - 1/2 frame pixels.
    Raises ShapeError, NotFiniteError, SingularShiftSetError.
    """
    stack, shifts = check_frames_and_shifts(frames, shifts_px)
    shape = (int(stack.shape[1]), int(stack.shape[2]))
    filters = prepare_filters(
        shape, shifts, factor, blur=blur, prior=prior, max_condition_number=max_condition_number
    )
    return filters.apply(stack)


def prepare_filters(
    shape: tuple[int, int],
    shifts_px: ArrayLike,
    factor: int = 2,
    *,
    blur: Blur | None = None,
    prior: Prior | None = None,
    max_condition_number: float = MAX_CONDITION_NUMBER,
) -> FourierFilters:
    """The filters, solved once and remembered. ``max_condition_number=inf`` accepts singular
    sets: the prior alone then decides what the shifts leave open."""
    shifts = check_shifts(shifts_px)
    require_regular(shifts, check_factor(factor), max_condition_number)
    as_key = tuple((float(row), float(col)) for row, col in shifts)
    return _solved(shape, as_key, factor, blur or Blur(), prior or Prior())


# Few: at factor 4 the filters of a large frame take hundreds of megabytes.
@lru_cache(maxsize=4)
def _solved(
    shape: tuple[int, int],
    shifts: tuple[tuple[float, float], ...],
    factor: int,
    blur: Blur,
    prior: Prior,
) -> FourierFilters:
    count, (rows, cols) = len(shifts), shape
    half_cols = factor * cols // 2 + 1
    row_transfer = _transfer(rows, factor, [shift[0] for shift in shifts], blur)
    col_transfer = _transfer(cols, factor, [shift[1] for shift in shifts], blur)
    penalty = _penalty(shape, factor, count, prior)
    by_row, by_col = _grouped(row_transfer, factor), _grouped(col_transfer, factor)
    weights = np.empty((count, factor, rows, factor * cols), dtype=np.complex128)
    into = weights.reshape(count, factor, rows, factor, cols)
    # A block of rows at a time: at factor 4 the systems of a large frame would fill the memory.
    block = max(1, 2**22 // (cols * factor**4))
    for start in range(0, rows, block):
        part = slice(start, min(rows, start + block))
        solved = _solve(by_row[:, :, part], by_col, penalty[:, part])
        into[:, :, part] = solved
    return FourierFilters(
        shape=shape,
        factor=factor,
        weights=np.ascontiguousarray(weights[..., :half_cols]),
        alias_cols=np.arange(half_cols) % cols,
    )


def _transfer(size: int, factor: int, shifts: list[float], blur: Blur) -> Complex:
    """Per axis: fine frequency to frame k, shape (N, factor * size), without the aliasing."""
    fine = factor * size
    index = np.arange(fine)
    index = np.where(2 * index > fine, index - fine, index)
    frequency = index / size
    # The fine grid is centred on the frame's: fine pixel 0 lies (s-1)/(2s) px before pixel 0.
    reach = (factor - 1) / (2 * factor) - np.array(shifts)[:, None]
    phase = np.exp(2j * math.pi * frequency * reach)
    phase = np.where(2 * index == fine, phase.real, phase)
    return np.asarray(phase * blur.transfer(frequency) / factor)


def _grouped(transfer: Complex, factor: int) -> Complex:
    """(N, factor * size) to (N, factor, size): aliases of one frame frequency side by side."""
    return transfer.reshape(len(transfer), factor, -1)


def _penalty(shape: tuple[int, int], factor: int, count: int, prior: Prior) -> NDArray[np.float64]:
    """lambda * Gamma a frequency, as the systems want it: (factor, rows, factor, cols)."""
    if prior.smooth:
        row_angle, col_angle = (
            2 * math.pi * np.arange(factor * size) / (factor * size) for size in shape
        )
        gamma = (4 - 2 * np.cos(row_angle)[:, None] - 2 * np.cos(col_angle)[None, :]) / 8
    else:
        gamma = np.ones((factor * shape[0], factor * shape[1]))
    # N/s^2 makes it lambda; one more 1/s^2 because the fine grid has s^2 as many frequencies.
    scaled = np.maximum(prior.strength * gamma, REGULARIZATION_FLOOR) * count / factor**4
    return scaled.reshape(factor, shape[0], factor, shape[1])


def _solve(by_row: Complex, by_col: Complex, penalty: NDArray[np.float64]) -> Complex:
    """(B^H B + penalty)^-1 B^H for a block of rows: (N, factor, rows, factor, cols)."""
    count, factor, rows = by_row.shape
    cols = by_col.shape[2]
    mixing = np.einsum("kar,kbc->rckab", by_row, by_col).reshape(rows, cols, count, factor**2)
    adjoint = mixing.conj().swapaxes(-1, -2)
    system = adjoint @ mixing
    diagonal = np.einsum("...ii->...i", system)
    diagonal += penalty.transpose(1, 3, 0, 2).reshape(rows, cols, factor**2)
    weights = np.linalg.solve(system, adjoint).reshape(rows, cols, factor, factor, count)
    return weights.transpose(4, 2, 0, 3, 1)


def _full_columns(half: Complex, cols: int, wanted: NDArray[np.intp]) -> Complex:
    """Columns ``wanted`` of the full spectrum of a real frame, from its half spectrum."""
    known = half.shape[1]
    missing = wanted[known:]
    if not len(missing):
        return half[:, wanted]
    spectrum = np.empty((half.shape[0], len(wanted)), dtype=half.dtype)
    spectrum[:, :known] = half
    mirrored = np.where(missing < known, missing, cols - missing)
    rest = half[:, mirrored]
    flip = missing >= known
    negative_rows = -np.arange(half.shape[0]) % half.shape[0]
    rest[:, flip] = rest[negative_rows][:, flip].conj()
    spectrum[:, known:] = rest
    return spectrum
