"""Analytic images of round objects, as a scanner makes them from finitely many k-space samples.

A disc of radius R has the spectrum S(k) = R J1(2 pi R |k|)/|k| exp(-2 pi i k.c). Spectrum and
window are real and even in each frequency but for that phase, so the image at pixel (r, c) is a
sum of products of cosines, and an image of any rectangle of pixels is two small matrix products
(rows, columns) without a Fourier transform of the whole frame. The derivatives with respect to the
centre replace cosines by sines.

Unit: pixels. Frequencies: cycles per pixel. `period` is the frame's shape (rows, cols): k-space is
sampled at multiples of 1/period, as by the scanner whose field of view the frame is.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

from sr_engine.psf import Psf

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class KSpace:
    """One quadrant of sampled k-space: frequencies, and windows times quadrature weights."""

    k_row: Array  # (P,)
    k_col: Array  # (Q,)
    k_abs: Array  # (P, Q)
    weight: Array  # (P, Q)


@lru_cache(maxsize=64)
def k_space(period: tuple[int, int], psf: Psf) -> KSpace:
    """The samples that a frame of shape `period` is made of, for a given point spread."""
    extent = psf.extent
    k_row, count_row = _half_axis(period[0], extent[0], psf.folds)
    k_col, count_col = _half_axis(period[1], extent[1], psf.folds)
    window = psf.window(k_row[:, None], k_col[None, :])
    weight = window * np.outer(count_row / period[0], count_col / period[1])
    return KSpace(k_row, k_col, np.hypot(k_row[:, None], k_col[None, :]), weight)


def _half_axis(n: int, extent: float, folds: bool) -> tuple[Array, Array]:
    """Frequencies j/n from 0 up to extent/2, and how often each occurs with its mirror image."""
    last = int(np.floor(extent * n / 2 + 1e-9))
    k = np.arange(last + 1) / n
    count = np.full(last + 1, 2.0)
    count[0] = 1.0
    if not folds and n % 2 == 0 and last == n // 2:
        count[-1] = 1.0  # +1/2 and -1/2 are one sample of an even matrix
    return k, count


def disc_spectrum(k_abs: Array, radius_px: float) -> Array:
    """Fourier transform of a unit disc at the origin; its area at k = 0."""
    k = np.maximum(k_abs, 1e-12)
    return np.asarray(radius_px * j1(2 * np.pi * radius_px * k) / k)


def sphere_slab_spectrum(
    k_abs: Array, radius_px: float, slab_px: tuple[float, float], nodes: int = 24
) -> Array:
    """Spectrum of a unit sphere cut by a slab and projected; divided by the slab's thickness.

    slab_px = (z_offset, thickness): the slab is centred z_offset away from the sphere's centre.
    Gauss-Legendre over the part of the slab that meets the sphere: a sum of discs of radius
    sqrt(a^2 - z^2). Zero thickness is the disc at z_offset.
    """
    z_offset, thickness = slab_px
    if thickness == 0:
        radius = np.sqrt(max(radius_px**2 - z_offset**2, 0.0))
        return disc_spectrum(k_abs, radius)
    low = max(z_offset - thickness / 2, -radius_px)
    high = min(z_offset + thickness / 2, radius_px)
    total = np.zeros_like(k_abs)
    if high <= low:
        return total
    # z = a sin(t) takes the square-root ends of the sphere out of the integrand
    t_low, t_high = np.arcsin(low / radius_px), np.arcsin(high / radius_px)
    x, w = np.polynomial.legendre.leggauss(nodes)
    for t, weight in zip((t_high - t_low) / 2 * x + (t_high + t_low) / 2, w, strict=True):
        ring = radius_px * np.cos(t)
        total += weight * ring * disc_spectrum(k_abs, ring)
    return total * (t_high - t_low) / 2 / thickness


def image_of(
    spectrum: Array, space: KSpace, rows: Array, cols: Array, centre_px: tuple[float, float]
) -> Array:
    """Image at pixel rows x cols of an even spectrum (P, Q) displaced to centre_px."""
    across = np.cos(2 * np.pi * np.outer(rows - centre_px[0], space.k_row))
    along = np.cos(2 * np.pi * np.outer(cols - centre_px[1], space.k_col))
    return np.asarray(across @ (spectrum * space.weight) @ along.T)


@dataclass(frozen=True)
class Shape:
    """What the round object is: a disc, or a sphere cut by a slab (z_offset, thickness) in px."""

    slab_px: tuple[float, float] | None = None

    def spectrum(self, k_abs: Array, radius_px: float) -> Array:
        if self.slab_px is None:
            return disc_spectrum(k_abs, radius_px)
        return sphere_slab_spectrum(k_abs, radius_px, self.slab_px)


DISC = Shape()
_RADIUS_STEP = 0.125  # between expansion points; third order then errs by 1e-6 of the peak


@lru_cache(maxsize=192)
def _expansion(period: tuple[int, int], psf: Psf, shape: Shape, radius_px: float) -> Array:
    """(4, P, Q): weighted spectrum at radius_px and its Taylor coefficients in the radius."""
    space = k_space(period, psf)
    k, w = space.k_abs, space.weight
    if shape.slab_px is not None:
        h = _RADIUS_STEP / 2
        low, mid, high = (shape.spectrum(k, radius_px + d) * w for d in (-h, 0.0, h))
        second = (high - 2 * mid + low) / (2 * h * h)
        return np.stack([mid, (high - low) / (2 * h), second, np.zeros_like(w)])
    q = 2 * np.pi * k
    b0, b1 = j0(q * radius_px), j1(q * radius_px)
    first = 2 * np.pi * radius_px * b0
    second = 2 * np.pi * (b0 - q * radius_px * b1)
    third = -2 * np.pi * q * (b1 + q * radius_px * b0)
    zeroth = disc_spectrum(k, radius_px)
    return np.stack([zeroth * w, first * w, second * w / 2, third * w / 6])


def spectrum_near(period: tuple[int, int], psf: Psf, shape: Shape, radius_px: float) -> Array:
    """(2, P, Q): weighted spectrum, and its derivative in the radius, by the nearest expansion."""
    base = max(round(radius_px / _RADIUS_STEP), 1) * _RADIUS_STEP
    d = radius_px - base
    powers = np.array([[1.0, d, d**2, d**3], [0.0, 1.0, 2 * d, 3 * d**2]])
    coefficients = _expansion(period, psf, shape, base)
    # one matrix product is several times faster than the sums it stands for
    both = powers @ coefficients.reshape(4, -1)
    return both.reshape(2, *coefficients.shape[1:])


@dataclass(frozen=True, eq=False)
class Patch:
    """A rectangle of consecutive pixels of a frame, and the period of that frame."""

    rows: Array
    cols: Array
    period: tuple[int, int]


@lru_cache(maxsize=32)
def _waves(n: int, period: tuple[int, int], psf: Psf, axis: int) -> tuple[Complex, Array]:
    """exp(i q x) at x = 0..n-1 (n, K), and q = 2 pi k (K,), along one axis."""
    space = k_space(period, psf)
    q = 2 * np.pi * (space.k_row if axis == 0 else space.k_col)
    return np.exp(1j * np.outer(np.arange(n), q)), q


def _displaced_waves(
    pixels: Array, period: tuple[int, int], psf: Psf, axis: int, centre_px: float
) -> tuple[Array, Array]:
    """cos of q (x - centre) at consecutive pixels, and its derivative in the centre: (n, K)."""
    first = int(pixels[0])
    waves, q = _waves(len(pixels), period, psf, axis)
    displaced = waves * np.exp(-1j * (centre_px - first) * q)
    return displaced.real, displaced.imag * q


def unit_object(
    patch: Patch, psf: Psf, shape: Shape, centre_px: tuple[float, float], radius_px: float
) -> tuple[Array, Array, Array, Array]:
    """Image of a unit object on the patch, and its derivatives by row, column and radius."""
    spectrum, by_radius = spectrum_near(patch.period, psf, shape, radius_px)
    row, d_row = _displaced_waves(patch.rows, patch.period, psf, 0, centre_px[0])
    col, d_col = _displaced_waves(patch.cols, patch.period, psf, 1, centre_px[1])
    half = spectrum @ col.T
    return row @ half, d_row @ half, row @ (spectrum @ d_col.T), row @ (by_radius @ col.T)
