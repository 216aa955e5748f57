"""Where in a frame the template's object is: normalised correlation with its image."""

from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from sr_engine.errors import AmbiguousObjectError, NoRoundObjectError
from sr_engine.template.fit import Metric
from sr_engine.template.image import ObjectImage

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LEAST_LIKENESS = 0.45  # correlation of frame and template under the template's mask
_AMBIGUOUS = 0.93  # a second place of this share of the best likeness is as good


def find_object(
    frame: Array,
    image: ObjectImage,
    metric: Metric,
    region: tuple[int, int, int, int] | None = None,
) -> Array:
    """(row, col) to about a pixel, within region (r0, c0, r1, c1) where one is given.

    Raises NoRoundObjectError where nothing is like the template, AmbiguousObjectError where two
    things are alike.
    """
    n = int(metric.mask.sum())
    corner = np.zeros(2)
    inside = (slice(None), slice(None))
    if region is not None:  # the rest of the frame tells nothing of it
        margin = len(metric.mask)
        low, high = np.maximum(region[:2], 0), np.minimum(region[2:], frame.shape)
        if not np.all(low < high):
            raise NoRoundObjectError("the region to look in lies outside of the frame")
        (r0, c0), (r1, c1) = np.maximum(low - margin, 0), high + margin
        frame, corner = frame[r0:r1, c0:c1], np.array([r0, c0], dtype=float)
        inside = (slice(low[0] - r0, high[0] - r0), slice(low[1] - c0, high[1] - c0))
    like, total, square = _correlated(frame, image, metric)
    spread = np.maximum(square - total**2 / n, 1e-9 * float(square.mean()) + 1e-300)
    likeness = like / np.sqrt(spread)
    within = np.full(likeness.shape, -1.0)
    within[inside] = likeness[inside]
    reach = int(np.sqrt(n / np.pi))
    peaks = np.where(within == maximum_filter(within, 2 * reach + 1), within, -1.0)
    order = [int(np.argmax(peaks))]
    best = float(peaks.flat[order[0]])
    peaks.flat[order[0]] = -1.0
    order.append(int(np.argmax(peaks)))
    second = float(peaks.flat[order[1]])
    places = [np.array(np.unravel_index(i, peaks.shape), float) + corner for i in order]
    if not best > LEAST_LIKENESS:
        raise NoRoundObjectError(
            f"nothing in the frame resembles the template (likeness {best:.2f}, at "
            f"least {LEAST_LIKENESS:g} needed)"
        )
    if second > _AMBIGUOUS * best:
        (row, col), (row2, col2) = places
        raise AmbiguousObjectError(
            f"two objects resemble the template, at row {row:.0f} col {col:.0f} and at row "
            f"{row2:.0f} col {col2:.0f}: say where to look"
        )
    return places[0]


def _correlated(frame: Array, image: ObjectImage, metric: Metric) -> tuple[Array, Array, Array]:
    """Sums of pixels times model, of pixels, and of squares, in the mask about every pixel."""
    size = len(metric.mask)
    padded = np.pad(frame - frame.mean(), size // 2, mode="edge")
    rows, cols = (scipy.fft.next_fast_len(n, real=True) for n in padded.shape)
    by_model, by_window = _spectra(image, metric, (rows, cols))
    pixels, squares = scipy.fft.rfft2(np.stack([padded, padded**2]), (rows, cols))
    products = np.stack([pixels * by_model, pixels * by_window, squares * by_window])
    sums = scipy.fft.irfft2(products, (rows, cols))
    like, total, square = sums[:, : frame.shape[0], : frame.shape[1]]
    return like, total, square


@lru_cache(maxsize=8)
def _spectra(image: ObjectImage, metric: Metric, shape: tuple[int, int]) -> Complex:
    """(2, ...) conjugate spectra of the template, of mean 0 and norm 1, and of its mask."""
    mask = metric.mask
    model = np.where(mask, metric.expected(image.at(np.zeros(2))[0]).mean, 0.0)
    model = np.where(mask, model - model[mask].mean(), 0.0)
    model /= np.linalg.norm(model)
    return np.asarray(scipy.fft.rfft2(np.stack([model, mask.astype(float)]), shape).conj())
