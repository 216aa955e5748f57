"""Frames of fiducials that no fit models: drawn on a fine grid, scanned, processed as consoles do.

A scene is drawn sixteen times finer than the frame; its spectrum, cut to the matrix, is what a
scanner samples, and a displacement is a phase on it. Nothing here shares code with what is
fitted. Unit: acquired pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sr_engine.bound import rician_information

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Process = Callable[[Array], Array]

MATRIX = 64
FINER = 16
SNR = 20.0
_GYRO_PHASE = 2.6  # of a tube's field at its wall, rad, at the echo


@dataclass(frozen=True)
class Kind:
    """One kind of fiducial, and how it is scanned.

    draw: density (complex where a field adds phase) over row and column distances from the
    middle. window: weight of k-space over |k_row|, |k_col|, 0 to 1 at the border. finer: zero
    filling. coils: root of the sum of squares over so many. scene: what stands still, over rows
    and columns. process: of the finished magnitudes. jump_px: between the halves of k-space.
    """

    name: str
    draw: Callable[[Array, Array], Array | Complex]
    window: Callable[[Array, Array], Array] | None = None
    finer: int = 1
    coils: int = 1
    process: Process | None = None
    scene: Callable[[Array, Array], Array] | None = None
    shading: Callable[[Array, Array], Array] | None = None
    jump_px: float = 0.0
    grey: float = 400.0  # levels of the plateau


def ellipse(
    row: Array, col: Array, a: float, b: float | None = None, angle: float = 0.0,
    at: tuple[float, float] = (0.0, 0.0),
) -> Array:  # fmt: skip
    """1 inside of half axes a and b."""
    y, x = row - at[0], col - at[1]
    u = y * np.cos(angle) + x * np.sin(angle)
    v = x * np.cos(angle) - y * np.sin(angle)
    return ((u / a) ** 2 + (v / (b or a)) ** 2 <= 1).astype(float)


def sphere(row: Array, col: Array, radius: float, offset: float, thickness: float = 3.0) -> Array:
    """A sphere in a slice with soft flanks, offset from its centre."""
    z = np.linspace(-1.6, 1.6, 13) * thickness / 2
    profile = 1 / (1 + np.exp((np.abs(2 * z / thickness) - 1) * 9))
    away = row**2 + col**2
    parts = [w * (away + (offset + h) ** 2 <= radius**2) for w, h in zip(profile, z, strict=True)]
    return np.asarray(np.sum(parts, axis=0) / profile.sum())


def tube(
    row: Array, col: Array, outer: float, inner: float, strength: float, angle: float = 0.0
) -> Complex:
    """An oil ring about a metal tube whose field turns its phase and, where steep, eats it."""
    away = np.maximum(np.hypot(row, col), inner)
    turn = strength * _GYRO_PHASE * (inner / away) ** 2 * np.cos(2 * np.arctan2(row, col) - angle)
    ring = ellipse(row, col, outer) - ellipse(row, col, inner)
    return np.asarray(ring * np.exp(1j * turn - (strength * (inner / away) ** 3) ** 2))


def bilinear(by_px: float) -> Process:
    """What a distortion correction does: resampled at places that drift through the pixels."""

    def process(frame: Array) -> Array:
        rows, cols = np.indices(frame.shape, dtype=float)
        middle = (frame.shape[0] - 1) / 2
        away = ((rows - middle) ** 2 + (cols - middle) ** 2) / middle**2
        places = [x + by_px + 0.02 * (x - middle) * away for x in (rows, cols)]
        return np.asarray(ndimage.map_coordinates(frame, places, order=1, mode="nearest"))

    return process


def total_variation(frame: Array) -> Array:
    from skimage.restoration import denoise_tv_chambolle

    top = float(np.percentile(frame, 99.5))
    return np.asarray(denoise_tv_chambolle(frame / top, weight=0.05)) * top


def hamming(row: Array, col: Array) -> Array:
    return np.asarray((0.54 + 0.46 * np.cos(np.pi * row)) * (0.54 + 0.46 * np.cos(np.pi * col)))


def tukey(row: Array, col: Array) -> Array:
    parts = [0.5 + 0.5 * np.cos(np.pi * np.clip(2 * k - 1, 0, 1)) for k in (row, col)]
    return np.asarray(parts[0] * parts[1])


def inside_ellipse(row: Array, col: Array) -> Array:
    return (np.hypot(row, col) <= 1).astype(float)


def body(row: Array, col: Array) -> Array:
    """A bright body above, its edge a dozen pixels from the fiducial."""
    return np.broadcast_to(0.9 * (row < -11.3), np.broadcast_shapes(row.shape, col.shape))


def _disc(y: Array, x: Array) -> Array:
    return ellipse(y, x, 4.0)


def _oval(ratio: float, angle: float) -> Callable[[Array, Array], Array]:
    return lambda y, x: ellipse(y, x, 4 * ratio**0.5, 4 / ratio**0.5, angle)


def _ring(y: Array, x: Array) -> Array:
    return ellipse(y, x, 5.0) - ellipse(y, x, 2.0)


def _shell(y: Array, x: Array) -> Array:
    shell = ellipse(y, x, 5.0, at=(0.0, 0.7)) - ellipse(y, x, 4.0, at=(0.0, 0.7))
    return ellipse(y, x, 4.0) + 0.6 * shell


def _bubble(y: Array, x: Array) -> Array:
    return ellipse(y, x, 4.0) * (1 - ellipse(y, x, 1.3, at=(-2.7, 0.4)))


SHAPES = (
    Kind("disc", _disc),
    Kind("oval 1.02", _oval(1.02, 0.3)),
    Kind("oval 1.06", _oval(1.06, 1.1)),
    Kind("oval 1.15", _oval(1.15, 2.2)),
    Kind("ring with void", _ring),
    Kind("shell, shifted", _shell),
    Kind("bubble", _bubble),
    Kind("sphere off centre", lambda y, x: sphere(y, x, 4.5, 1.5)),
    Kind("disc, hamming", _disc, hamming),
    Kind("disc, elliptical", _disc, inside_ellipse),
    Kind("disc, zero-filled", _disc, finer=2),
)

PROCESSED = (
    Kind("tukey", lambda y, x: sphere(y, x, 4.2, 0.0), tukey),
    Kind("ring, hamming, finer", _ring, hamming, finer=2),
    Kind("three quarters of the phases", _disc, lambda r, c: (r <= 0.75).astype(float)),
    Kind("sum of squares of 8", _disc, coils=8),
    Kind("sum of squares of 16", _ring, coils=16),
    Kind("sum of squares of 32", _disc, coils=32),
    Kind("8 grey levels", _disc, grey=8.0),
    Kind("30 grey levels", _ring, grey=30.0),
    Kind("smoothed 3 x 3", _disc, process=lambda f: ndimage.uniform_filter(f, 3)),
    Kind("median 3 x 3", _disc, process=lambda f: ndimage.median_filter(f, 3)),
    Kind("denoised, total variation", _disc, process=total_variation),
    Kind("distortion corrected", _disc, process=bilinear(0.37)),
    Kind("ring, distortion corrected", _ring, process=bilinear(0.2)),
    Kind("shaded, curved", _disc, shading=lambda y, x: 1 + 0.03 * x - 0.0008 * y**2),
    Kind("body near by", _disc, scene=body),
    Kind("jump in the middle", _disc, jump_px=0.12),
    Kind("brass, gradient echo", lambda y, x: tube(y, x, 5.0, 2.0, 1.0, 0.4)),
    Kind("brass, spin echo", lambda y, x: tube(y, x, 4.0, 1.8, 0.4)),
    Kind("thin ring", lambda y, x: ellipse(y, x, 4.6) - ellipse(y, x, 2.9)),
)
KINDS = {kind.name: kind for kind in (*SHAPES, *PROCESSED)}


@dataclass(frozen=True, eq=False)
class Frames:
    """frames (M, rows, cols); centres_px (M, 2) true, in frame pixels; finer: zero filling."""

    frames: Array
    centres_px: Array
    finer: int


def frames_of(kind: Kind, count: int, rng: np.random.Generator, snr: float = SNR) -> Frames:
    """Frames of one object at random places within a few pixels, with independent noise."""
    places = rng.uniform(-3, 3, (count, 2))
    clean = np.array([clean_image(kind, place) for place in places])
    sigma = _plateau(clean) / snr
    shape = (kind.coils, *clean.shape)
    sensitivity = _coils(kind.coils, clean.shape[1])[:, None]
    noise = [_noise(kind, shape, rng) * sigma for _ in range(2)]
    channels = clean * sensitivity + noise[0] + 1j * noise[1]
    frames = np.sqrt(np.sum(np.abs(channels) ** 2, axis=0)) * (kind.grey / _plateau(clean))
    if kind.process is not None:
        frames = np.array([kind.process(frame) for frame in frames])
    return Frames(np.rint(frames), _middle(kind) + places * kind.finer, kind.finer)


def clean_image(kind: Kind, place_px: Array) -> Complex:
    """(n, n) noise-free complex image with the object at place_px from the middle."""
    k = np.fft.fftfreq(MATRIX)

    def phase(row: float, col: float) -> Complex:
        return np.exp(-2j * np.pi * np.add.outer(k * row, k * col))

    spectrum = _spectrum(kind.name) * phase(*place_px)
    if kind.jump_px:
        late = (k > 0)[:, None]
        spectrum = spectrum * np.where(
            late, phase(kind.jump_px / 2, 0), phase(-kind.jump_px / 2, 0)
        )
    if kind.scene is not None:
        spectrum = spectrum + _still(kind.name)
    image = _image(spectrum * _window(kind), kind.finer)
    if kind.shading is not None:
        x = (np.arange(len(image)) - len(image) // 2) / kind.finer
        image = image * kind.shading(x[:, None], x[None, :])
    return image


def _middle(kind: Kind) -> float:
    return MATRIX * kind.finer // 2


def _plateau(clean: Complex) -> float:
    middle = np.abs(clean)[:, clean.shape[1] // 4 : -clean.shape[1] // 4]
    return float(np.percentile(middle[:, :, clean.shape[2] // 4 : -clean.shape[2] // 4], 97))


def _window(kind: Kind) -> Array:
    k = np.abs(np.fft.fftfreq(MATRIX)) * 2
    return _kind_window(kind, k[:, None], k[None, :])


def _kind_window(kind: Kind, row: Array, col: Array) -> Array:
    shape = np.broadcast_shapes(row.shape, col.shape)
    window = np.ones(shape) if kind.window is None else kind.window(row, col)
    return np.asarray(np.broadcast_to(window, shape), dtype=float)


def _image(spectrum: Complex, finer: int) -> Complex:
    """Of spectra (..., n, n) in FFT order, their origin at index n//2 of the image."""
    edge = MATRIX * (finer - 1) // 2
    pad = [(0, 0)] * (spectrum.ndim - 2) + [(edge, edge)] * 2
    padded = np.pad(np.fft.fftshift(spectrum, axes=(-2, -1)), pad)
    image = np.fft.ifft2(np.fft.ifftshift(padded, axes=(-2, -1))) * finer**2
    return np.asarray(np.fft.fftshift(image, axes=(-2, -1)))


def _noise(kind: Kind, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Of unit std, as the window and the zero filling leave it."""
    window = _window(kind)
    white = rng.standard_normal((*shape[:-2], MATRIX, MATRIX))
    if kind.finer == 1 and kind.window is None:
        return white
    noise = _image(np.fft.fft2(white) * window, kind.finer).real
    return np.asarray(noise / np.std(noise))


def _coils(count: int, size: int) -> Array:
    """(count, size, size) sensitivities about a ring, root sum of squares 1 in the middle."""
    if count == 1:
        return np.ones((1, size, size))
    x = np.arange(size) - size / 2
    angles = 2 * np.pi * np.arange(count) / count
    reach = 0.9 * size
    away = [
        np.hypot(x[:, None] - reach * np.sin(a), x[None, :] - reach * np.cos(a)) for a in angles
    ]
    sensitivity = np.array([(reach / d) ** 2 for d in away])
    root = np.sqrt(np.sum(sensitivity**2, axis=0))[size // 2, size // 2]
    return np.asarray(sensitivity / root)


@lru_cache(maxsize=64)
def _spectrum(name: str) -> Complex:
    return _cut(KINDS[name].draw)


@lru_cache(maxsize=8)
def _still(name: str) -> Complex:
    scene = KINDS[name].scene
    assert scene is not None
    return _cut(scene)


def _cut(draw: Callable[[Array, Array], Array | Complex]) -> Complex:
    """Spectrum (n, n) of what is drawn about the middle, as a matrix of n samples it."""
    fine = MATRIX * FINER
    x = (np.arange(fine) - fine // 2) / FINER
    spectrum = np.fft.fft2(np.fft.ifftshift(draw(x[:, None], x[None, :]) + 0j)) / FINER**2
    half = MATRIX // 2
    keep = np.r_[0:half, -half:0]
    return np.asarray(spectrum[np.ix_(keep, keep)])


def bound_px(kind: Kind, snr: float = SNR) -> float:
    """Least std of a displacement's axis, of one frame against the known image, px acquired.

    Magnitude pixels; centre, amplitude and background unknown. Of kinds without processing.
    """
    variances = [_variance(kind, snr, np.array(p)) for p in ((0.0, 0.0), (0.3, 0.4), (0.1, -0.35))]
    return float(np.sqrt(np.mean(variances)))


def _variance(kind: Kind, snr: float, place: Array) -> float:
    window = _window(kind)
    # a filter weighs noise as it weighs the object: what counts is what was sampled, unweighed
    sampled = replace(
        kind, finer=1, window=lambda r, c: np.where(_kind_window(kind, r, c) > 0, 1.0, 0.0)
    )
    step = 1e-3
    image = np.abs(clean_image(sampled, place))
    slopes = [
        (np.abs(clean_image(sampled, place + d)) - np.abs(clean_image(sampled, place - d)))
        / (2 * step)
        for d in np.eye(2) * step
    ]
    sigma = _plateau(clean_image(kind, place)[None]) / snr / float(np.sqrt(np.mean(window**2)))
    weights = rician_information(image.ravel() / sigma) / sigma**2
    by = np.stack([*(s.ravel() for s in slopes), image.ravel(), np.ones(image.size)])
    covariance = np.linalg.inv((by * weights) @ by.T)
    return float((covariance[0, 0] + covariance[1, 1]) / 2)
