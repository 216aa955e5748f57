"""Where in a frame the template's object is: normalised correlation with its image."""

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from sr_engine.errors import AmbiguousObjectError, NoRoundObjectError
from sr_engine.template.fit import Metric
from sr_engine.template.image import ObjectImage

Array = NDArray[np.float64]

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
    mask = metric.mask
    n = int(mask.sum())
    model = np.where(mask, metric.expected(image.at(np.zeros(2))[0]).mean, 0.0)
    model = np.where(mask, model - model[mask].mean(), 0.0)
    model /= np.linalg.norm(model)
    size = len(mask)
    padded = np.pad(frame - frame.mean(), size // 2, mode="edge")
    like, total, square = _correlated(padded, model, mask.astype(float))
    spread = np.maximum(square - total**2 / n, 1e-9 * float(np.mean(padded**2)) * n + 1e-300)
    likeness = like / np.sqrt(spread)
    if region is not None:
        r0, c0, r1, c1 = region
        inside = np.zeros(likeness.shape, dtype=bool)
        inside[r0:r1, c0:c1] = True
        likeness = np.where(inside, likeness, -1.0)
    reach = int(np.sqrt(n / np.pi))
    peaks = np.where(likeness == maximum_filter(likeness, 2 * reach + 1), likeness, -1.0)
    order = np.argsort(peaks, axis=None)[::-1][:2]
    places = [np.array(np.unravel_index(int(i), peaks.shape), float) for i in order]
    best, second = (float(peaks.flat[i]) for i in order)
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


def _correlated(padded: Array, model: Array, window: Array) -> tuple[Array, Array, Array]:
    """Sums of pixels times model, of pixels, and of squares, in the window at every place."""
    shape = padded.shape
    full = tuple(scipy.fft.next_fast_len(n, real=True) for n in shape)
    pixels, squares = scipy.fft.rfft2(np.stack([padded, padded**2]), full)
    by_model, by_window = scipy.fft.rfft2(np.stack([model, window]), full).conj()
    products = np.stack([pixels * by_model, pixels * by_window, squares * by_window])
    sums = scipy.fft.irfft2(products, full)
    rows, cols = (n - size // 2 * 2 for n, size in zip(shape, window.shape, strict=True))
    like, total, square = sums[:, :rows, :cols]
    return like, total, square
