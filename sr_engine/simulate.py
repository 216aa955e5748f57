"""Frames with known truth, made the way a scanner makes them: analytic k-space, window, noise.

Noise-free images are real and may undershoot below zero next to an edge; `rician` takes the
magnitude, as a scanner does.
"""

import numpy as np
from numpy.typing import NDArray

from sr_engine.errors import ParameterError, ShapeError
from sr_engine.model import KSpace, disc_spectrum, image_of, k_space, sphere_slab_spectrum
from sr_engine.psf import Psf

Array = NDArray[np.float64]


def render_disc(
    shape: tuple[int, int],
    centre_px: tuple[float, float],
    radius_px: float,
    amplitude: float = 1.0,
    background: float = 0.0,
    psf: Psf | None = None,
    slopes: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Noise-free image (rows, cols) of a disc.

    amplitude: disc above background. slopes: shading per pixel along (row, col), relative, zero
    at the disc's centre: the image is multiplied by 1 + slopes . (x - centre_px).
    The object repeats with the period of the frame, as it does on a scanner.
    """
    psf = psf or Psf()
    space = _checked_space(shape, radius_px, psf)
    spectrum = amplitude * disc_spectrum(space.k_abs, radius_px)
    return _finish(spectrum, shape, centre_px, background, psf, slopes)


def render_sphere_slab(
    shape: tuple[int, int],
    centre_px: tuple[float, float],
    radius_px: float,
    slab_px: tuple[float, float] = (0.0, 1.0),
    amplitude: float = 1.0,
    background: float = 0.0,
    psf: Psf | None = None,
    slopes: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Noise-free image of a sphere cut by a slice.

    slab_px = (z_offset, thickness): through-plane distance of the slice's middle from the
    sphere's centre, and slice thickness, in pixels. A pixel that the sphere fills through the
    whole slab has the value background + amplitude. Otherwise as `render_disc`.
    """
    psf = psf or Psf()
    if not slab_px[1] >= 0:
        raise ParameterError(f"slab thickness must not be negative, is {slab_px[1]} px")
    space = _checked_space(shape, radius_px, psf)
    spectrum = amplitude * sphere_slab_spectrum(space.k_abs, radius_px, slab_px)
    return _finish(spectrum, shape, centre_px, background, psf, slopes)


def rician(image: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Magnitude of the image with Gaussian noise of std `sigma` in each of its two channels."""
    if not sigma >= 0:
        raise ParameterError(f"noise must not be negative, is {sigma}")
    image = np.asarray(image, dtype=float)
    real = image + sigma * rng.standard_normal(image.shape)
    imaginary = sigma * rng.standard_normal(image.shape)
    return np.hypot(real, imaginary)


def filtered_noise(
    shape: tuple[int, int], sigma: float, psf: Psf, rng: np.random.Generator
) -> Array:
    """Noise (rows, cols) as the k-space window of `psf` leaves it: of std `sigma`, coloured."""
    k_row, k_col = np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1])
    window = psf.window(k_row[:, None], k_col[None, :])
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * window).real
    return noise * sigma / np.sqrt(np.mean(window**2))


def _checked_space(shape: tuple[int, int], radius_px: float, psf: Psf) -> KSpace:
    if len(shape) != 2 or not min(shape) > 0:
        raise ShapeError(f"a frame needs rows and columns, shape is {shape}")
    if not 0 < radius_px < np.inf:
        raise ParameterError(f"radius must be positive, is {radius_px} px")
    return k_space((int(shape[0]), int(shape[1])), psf)


def _finish(
    spectrum: Array,
    shape: tuple[int, int],
    centre_px: tuple[float, float],
    background: float,
    psf: Psf,
    slopes: tuple[float, float],
) -> Array:
    rows, cols = np.arange(shape[0], dtype=float), np.arange(shape[1], dtype=float)
    centre = (float(centre_px[0]), float(centre_px[1]))
    object_only = image_of(spectrum, k_space((shape[0], shape[1]), psf), rows, cols, centre)
    shading = 1 + slopes[0] * (rows - centre[0])[:, None] + slopes[1] * (cols - centre[1])[None, :]
    return np.asarray((object_only + background) * shading)
