"""The image of one object from frames at known displacements, in closed form a step.

What a scanner samples is a rectangle of k-space, so the complex image has no frequency beyond
Nyquist, and a displacement is a phase on its spectrum: frames at any displacements are averaged
frequency by frequency, and no finer grid is needed. Its magnitude has: at a zero crossing it has a
kink that no grid resolves. Magnitudes are therefore taken for what they are, the absolute value of
such an image with noise in one or several complex channels, by expectation maximisation (the phase
of each pixel is that of the present image, its expected size as in `magnitude`). Pixels that are no
magnitudes any more (smoothed, denoised) are averaged as they are.

Every frequency is drawn to the course of what is the same all round (of a round object all there
is) as far as what differs from it, there and near by, shows no more than noise: a round fiducial
costs a few numbers, and any other shape is not presumed to be round.
Unit: pixels. Patches are square, of even size n; the object is centred at index n//2.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sr_engine.template.magnitude import expected, in_phase_share

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_FIRST_STEPS, _STEPS = 6, 12
_LIFTS = (0.0, 0.15)  # of the highest value: what is taken for a sign change, inside of the object
_LIFTED = 0.35  # pixels below this share of it
_TILT = 0.05  # of the phase over a radius: a real image would stay real for ever
_ALIKE = 1.2  # frequencies over which the power of what is not round is alike
_FLOOR = 0.3  # of the noise, taken off it: to keep too little of the object costs more
_LEAST_POWER = 1e-3  # of the noise


@dataclass(frozen=True, eq=False)
class ObjectImage:
    """Spectrum (n, n) complex in FFT order, of the object at the origin."""

    spectrum: Complex
    is_magnitude: bool

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
        k, x = _axes(self.size)
        by_row, by_col = (np.exp(np.multiply.outer(x - c, k)) / self.size for c in centre_px)
        half = self.spectrum @ by_col.T
        image = by_row @ half
        d_row = by_row @ (half * -k[:, None])
        d_col = by_row @ (self.spectrum @ (by_col * -k).T)
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


@dataclass(frozen=True, eq=False)
class Averaged:
    """The image of all views, and (M, n, n) the spectra of those that leave out one view each.

    shown (M, n, n): what these show of the view that they leave out. extra: variance of their own
    noise at a pixel, over that of a frame.
    """

    image: ObjectImage
    without: Complex
    shown: Array
    extra: float

    def scaled(self, factor: float) -> "Averaged":
        image = replace(self.image, spectrum=self.image.spectrum * factor)
        return Averaged(image, self.without * factor, self.shown * factor, self.extra)

    def leaving_out(self, view: int) -> ObjectImage:
        return replace(self.image, spectrum=self.without[view])


def averaged_image(views: Views) -> Averaged:
    """The image of which the patches are noisy copies."""
    average = _Average(views, channels=1)
    return average.result(views.patches.astype(complex), is_magnitude=False)


def magnitude_image(
    views: Views, channels: float, radius_px: float, start: Complex | None = None
) -> Averaged:
    """The image of whose magnitude the patches are samples, from so many channels.

    start: its spectrum, where something is known of it: else the likelier of two guesses of what
    changes sign.
    """
    average = _Average(views, channels=2)
    if start is None:
        guesses = [_guess(views, average, channels, radius_px, lift) for lift in _LIFTS]
        spectra = [_maximised(views, average, channels, g, _FIRST_STEPS) for g in guesses]
        left = [_misfit(views, average, channels, spectrum) for spectrum in spectra]
        start = spectra[int(np.argmin(left))]
    spectrum = _maximised(views, average, channels, start, _STEPS)
    complete = _completed(views, average, channels, spectrum)
    return average.result(complete, is_magnitude=True)


class _Average:
    """Weighted mean of the views' spectra, less what is no more than noise."""

    def __init__(self, views: Views, channels: int) -> None:
        n = views.patches.shape[1]
        self.phases = views.phases
        self.back = self.phases.conj()
        self.weights = scipy.fft.ifftshift(
            views.amplitudes[:, None, None] * views.windows, axes=(1, 2)
        )
        self.shares = views.amplitudes**2
        self.total = float(np.sum(self.shares))
        power = channels * views.sigma**2 * float(np.sum(views.windows**2)) / len(views.windows)
        self.noise = power / self.total * views.noise_power
        self.round = _round_basis(n)

    def parts(self, patches: Complex) -> Complex:
        """(M, n, n) what each view, in FFT order about the object, adds to the mean."""
        return np.asarray(scipy.fft.fft2(patches * self.weights) * self.phases)

    def of(self, patches: Complex) -> Complex:
        """Spectrum (n, n) of the image."""
        mean = self.parts(patches).sum(axis=0) / self.total
        same_all_round = self.projected(mean)
        mean = mean - same_all_round
        return np.asarray(same_all_round + mean * self.kept(mean))

    def kept(self, mean: Complex) -> Array:
        """The share of what is not the same all round that is more than noise."""
        power = gaussian_filter(np.abs(mean) ** 2, _ALIKE, mode="wrap", truncate=2.5)
        object_power = np.maximum(power - _FLOOR * self.noise, _LEAST_POWER * self.noise)
        return np.asarray(object_power / (object_power + self.noise))

    def projected(self, spectra: Complex) -> Complex:
        flat = spectra.reshape(-1, self.round.shape[0])
        return np.asarray(((flat @ self.round) @ self.round.T).reshape(spectra.shape))

    def result(self, patches: Complex, is_magnitude: bool) -> Averaged:
        parts = self.parts(scipy.fft.ifftshift(patches, axes=(1, 2)))
        total = parts.sum(axis=0)
        means = (
            np.concatenate([total[None], total - parts])
            / np.concatenate([[self.total], self.total - self.shares])[:, None, None]
        )
        round_ones = self.projected(means)
        rest = means - round_ones
        kept = self.kept(rest[0])
        spectra = round_ones + rest * kept
        extra = float(np.mean(kept**2)) / max(len(parts) - 1, 1)
        shown = scipy.fft.fftshift(scipy.fft.ifft2(spectra[1:] * self.back), axes=(1, 2))
        shown = np.abs(shown) if is_magnitude else shown.real
        return Averaged(ObjectImage(spectra[0], is_magnitude), spectra[1:], shown, extra)

    def views_of(self, spectrum: Complex) -> Complex:
        """(M, n, n) in FFT order about the object's whole pixel."""
        return np.asarray(scipy.fft.ifft2(spectrum * self.back))


@lru_cache(maxsize=8)
def _axes(n: int) -> tuple[Complex, Array]:
    """2 pi i times the frequencies, and the pixels from the middle."""
    return np.asarray(2j * np.pi * np.fft.fftfreq(n)), np.arange(n, dtype=np.float64) - n // 2


@lru_cache(maxsize=8)
def _round_basis(n: int) -> Array:
    """Of what is the same all round."""
    k = np.abs(np.fft.fftfreq(n, 1 / n))
    away = np.hypot(k[:, None], k[None, :])
    return _radial_basis(away.ravel())


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


def _guess(
    views: Views, average: _Average, channels: float, radius_px: float, lift: float
) -> Complex:
    """Spectrum to begin at: the sizes less the noise's floor, averaged, low ones turned about."""
    n = views.patches.shape[1]
    x = np.arange(n) - n // 2
    floor = 2 * channels * views.sigma**2
    if channels > 1:  # each frame by itself would leave its noise, made positive
        patches = scipy.fft.ifftshift(views.patches, axes=(1, 2))
        image = scipy.fft.fftshift(scipy.fft.ifft2(average.of(patches.astype(complex))).real)
        sizes = np.sqrt(np.maximum(image**2 - floor, 0.0))
    else:
        sizes = np.sqrt(np.maximum(views.patches**2 - floor, 0.0))
    top = float(np.percentile(sizes, 99))
    inside = np.hypot(x[:, None], x[None, :]) < radius_px
    started = sizes - lift * top * ((sizes < _LIFTED * top) & inside)
    tilt = np.exp(1j * _TILT * np.add.outer(x, 0.6 * x) / radius_px)
    if channels > 1:
        return np.asarray(scipy.fft.fft2(scipy.fft.ifftshift(started * tilt)))
    spectrum = average.of(scipy.fft.ifftshift(started.astype(complex), axes=(1, 2)))
    return np.asarray(scipy.fft.fft2(scipy.fft.ifft2(spectrum) * scipy.fft.ifftshift(tilt)))


def _maximised(
    views: Views, average: _Average, channels: float, spectrum: Complex, steps: int
) -> Complex:
    """The spectrum after so many steps of expectation and maximisation."""
    patches = scipy.fft.ifftshift(views.patches, axes=(1, 2))
    for _ in range(steps):
        spectrum = average.of(_expected(views, average, channels, spectrum, patches))
    return spectrum


def _expected(
    views: Views, average: _Average, channels: float, spectrum: Complex, patches: Array
) -> Complex:
    """(M, n, n) the complex pixels, in FFT order, as far as magnitude and image tell."""
    images = average.views_of(spectrum)
    size = np.abs(images)
    size += 1e-12 * float(size.max()) + 1e-300
    scaled = size * (views.amplitudes / views.sigma**2)[:, None, None]
    factor = in_phase_share(patches * scaled, channels) * patches / size
    return np.asarray(images * factor)


def _completed(views: Views, average: _Average, channels: float, spectrum: Complex) -> Complex:
    patches = scipy.fft.ifftshift(views.patches, axes=(1, 2))
    complete = _expected(views, average, channels, spectrum, patches)
    return np.asarray(scipy.fft.fftshift(complete, axes=(1, 2)))


def _misfit(views: Views, average: _Average, channels: float, spectrum: Complex) -> float:
    """Sum of squares of what the image does not explain, over what is expected."""
    size = np.abs(average.views_of(spectrum)) * views.amplitudes[:, None, None]
    shown = expected(scipy.fft.fftshift(size, axes=(1, 2)), views.sigma, channels)
    return float(np.sum((views.patches - shown.mean) ** 2 / shown.variance * views.windows))
