"""The image of one object from frames at known displacements, in closed form a step.

What a scanner samples is a rectangle of k-space, so the complex image has no frequency beyond
Nyquist, and a displacement is a phase on its spectrum: frames at any displacements are averaged
frequency by frequency, and no finer grid is needed. Its magnitude has: at a zero crossing it has a
kink that no grid resolves. Magnitudes are therefore taken for what they are, the absolute value of
such an image with noise in two channels, by expectation maximisation (the phase of each pixel is
that of the present image, its expected size y I1(ys/v)/I0(ys/v)). Pixels that are no magnitudes any
more (smoothed, denoised, combined) are averaged as they are.

Every frequency is drawn to its annulus's own course (of a round object all there is) as far as
what differs from it shows no more than noise: a round fiducial costs a few numbers, and any other
shape is not presumed to be round.
Unit: pixels. Patches are square, of even size n; the object is centred at index n//2.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import i0e, i1e

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_STEPS = 30
_LIFTS = (0.0, 0.15)  # of the highest value: what is taken for a sign change, inside of the object
_LIFTED = 0.35  # pixels below this share of it
_TILT = 0.05  # of the phase over a radius: a real image would stay real for ever
_LEAST_POWER = 1e-3  # of the noise: what an annulus is left with


@dataclass(frozen=True, eq=False)
class ObjectImage:
    """Spectrum (n, n) complex in FFT order, of the object at the origin.

    leverage: share of the noise of a frame that the image takes over from it.
    """

    spectrum: Complex
    is_magnitude: bool
    leverage: float

    @property
    def size(self) -> int:
        return len(self.spectrum)

    def recentred(self, middle_px: Array) -> "ObjectImage":
        """The same object about another origin, which lies at middle_px from this one."""
        k = np.fft.fftfreq(self.size)
        phase = np.exp(2j * np.pi * np.add.outer(k * middle_px[0], k * middle_px[1]))
        return replace(self, spectrum=self.spectrum * phase)

    def at(self, centre_px: Array) -> tuple[Array, Array, Array]:
        """Image (n, n) with the object at centre_px from index n//2; derivatives in row and col."""
        n = self.size
        k = np.fft.fftfreq(n)
        x = np.arange(n) - n // 2
        by_row = np.exp(2j * np.pi * np.outer(x - centre_px[0], k)) / n
        by_col = np.exp(2j * np.pi * np.outer(x - centre_px[1], k)) / n
        slope = -2j * np.pi * k
        half = self.spectrum @ by_col.T
        image = by_row @ half
        d_row = (by_row * slope) @ half
        d_col = by_row @ (self.spectrum @ (by_col * slope).T)
        if not self.is_magnitude:
            return image.real, d_row.real, d_col.real
        size = np.abs(image) + 1e-12 * np.abs(self.spectrum[0, 0])
        phase = image.conj() / size
        return size, (phase * d_row).real, (phase * d_col).real


@dataclass(frozen=True, eq=False)
class Views:
    """Patches (M, n, n) of one object less their surroundings, and where it is in each.

    offsets_px (M, 2) from index n//2; windows (M, n, n) 1 about the object and 0 at the border;
    amplitudes (M,) of the object; sigma: noise std per channel; noise_power (n, n): its spectrum,
    of mean 1, in FFT order.
    """

    patches: Array
    offsets_px: Array
    windows: Array
    amplitudes: Array
    sigma: float
    noise_power: Array

    @property
    def phases(self) -> Complex:
        """(M, n, n) what brings each view's object back to the origin."""
        k = np.fft.fftfreq(self.patches.shape[1])
        row, col = self.offsets_px[:, 0, None, None], self.offsets_px[:, 1, None, None]
        return np.asarray(np.exp(2j * np.pi * (k[:, None] * row + k[None, :] * col)))


def averaged_image(views: Views) -> ObjectImage:
    """The image of which the patches are noisy copies."""
    spectrum, kept = _Average(views, channels=1).of(views.patches.astype(complex))
    return ObjectImage(spectrum, False, _leverage(views, kept))


def magnitude_image(views: Views, radius_px: float) -> ObjectImage:
    """The image of whose magnitude, with Rician noise, the patches are samples."""
    average = _Average(views, channels=2)
    images = [_maximised(views, average, radius_px, lift) for lift in _LIFTS]
    _, spectrum, kept = max(images, key=lambda image: image[0])
    return ObjectImage(spectrum, True, _leverage(views, kept))


def _leverage(views: Views, kept: Array) -> float:
    seen = float(np.sum(views.windows**2)) / len(views.windows)
    return min(float(kept.sum()) / len(views.windows) / max(seen, 1.0), 0.9)


class _Average:
    """Weighted mean of the views' spectra, less what is no more than noise."""

    def __init__(self, views: Views, channels: int) -> None:
        n = views.patches.shape[1]
        self.phases = views.phases
        self.weights = views.amplitudes[:, None, None] * views.windows
        total = float(np.sum(views.amplitudes**2))
        power = channels * views.sigma**2 * float(np.sum(views.windows**2)) / len(views.windows)
        self.total, self.noise = total, power / total * views.noise_power
        k = np.abs(np.fft.fftfreq(n, 1 / n))
        self.annuli = np.rint(np.hypot(k[:, None], k[None, :])).astype(int)
        self.counts = np.bincount(self.annuli.ravel())
        self.round = _radial_basis(np.hypot(k[:, None], k[None, :]).ravel())

    def of(self, patches: Complex) -> tuple[Complex, Array]:
        """Spectrum (n, n), and the share of it that is kept at each frequency."""
        rolled = scipy.fft.ifftshift(patches * self.weights, axes=(1, 2))
        mean = np.sum(scipy.fft.fft2(rolled) * self.phases, axis=0) / self.total
        same_all_round = (self.round @ (self.round.T @ mean.ravel())).reshape(mean.shape)
        mean = mean - same_all_round
        power = np.bincount(self.annuli.ravel(), (np.abs(mean) ** 2).ravel()) / self.counts
        floor = np.bincount(self.annuli.ravel(), self.noise.ravel()) / self.counts
        object_power = np.maximum(power - floor, _LEAST_POWER * floor)[self.annuli]
        kept = object_power / (object_power + self.noise)
        return same_all_round + mean * kept, kept

    def views_of(self, spectrum: Complex) -> Complex:
        images = scipy.fft.ifft2(spectrum[None] * self.phases.conj())
        return np.asarray(scipy.fft.fftshift(images, axes=(1, 2)))


def _radial_basis(k: Array) -> Array:
    """(n*n, K) orthonormal, smooth functions of the distance from the origin of k-space."""
    knots = np.arange(int(np.ceil(k.max())) + 2, dtype=float)
    away = np.abs(k[:, None] - knots)
    # cubic B-splines, even about the origin
    values = _cubic(away) + np.where(knots > 0, _cubic(np.abs(k[:, None] + knots)), 0.0)
    basis, triangle = np.linalg.qr(values)
    return np.asarray(basis[:, np.abs(np.diag(triangle)) > 1e-6])


def _cubic(x: Array) -> Array:
    near, far = (4 - 6 * x**2 + 3 * x**3) / 6, np.maximum(2 - x, 0.0) ** 3 / 6
    return np.where(x < 1, near, far)


def _maximised(
    views: Views, average: _Average, radius_px: float, lift: float
) -> tuple[float, Complex, Array]:
    """(log likelihood but for a constant, spectrum, kept share), from one guess of the signs."""
    n = views.patches.shape[1]
    x = np.arange(n) - n // 2
    sizes = np.sqrt(np.maximum(views.patches**2 - 2 * views.sigma**2, 0.0))
    top = float(np.percentile(sizes, 99))
    inside = np.hypot(x[:, None], x[None, :]) < radius_px
    started = sizes - lift * top * ((sizes < _LIFTED * top) & inside)
    spectrum, kept = average.of(started.astype(complex))
    tilt = np.exp(1j * _TILT * np.add.outer(x, 0.6 * x) / radius_px)
    spectrum = scipy.fft.fft2(scipy.fft.ifft2(spectrum) * scipy.fft.ifftshift(tilt))
    scale = views.amplitudes[:, None, None]
    for _ in range(_STEPS):
        images = average.views_of(spectrum) * scale
        size = np.abs(images) + 1e-12 * top
        z = np.minimum(views.patches * size / views.sigma**2, 1e6)
        expected = views.patches * (i1e(z) / i0e(z)) * images / size
        spectrum, kept = average.of(expected)
    size = np.abs(average.views_of(spectrum) * scale)
    z = views.patches * size / views.sigma**2
    each = np.log(i0e(z)) - (views.patches - size) ** 2 / (2 * views.sigma**2)
    return float(np.sum(each * views.windows)), spectrum, kept
