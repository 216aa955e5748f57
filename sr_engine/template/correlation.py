"""How the noise of frames is correlated from pixel to pixel, by what the frames themselves show.

Scanners filter, interpolate and denoise what they show, each in its own way: no list of names
covers it. What is left of several frames of one object beside their common image is noise, and
shows its correlation at the place where it counts.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_SIGMA = 3.5  # of a lag's own uncertainty, before it is believed
WHITE_SHARE = 0.3  # of the noise power, in the weights: what is measured is not leant on entirely


def lag_correlation(residuals: Array, mask: Mask, reach: int) -> tuple[Array, Array]:
    """Correlation at lags (0..reach rows, 0..reach columns), and its standard error.

    residuals: (M, rows, cols) standardised; mask: (rows, cols) pixels that count. Lags to the left
    and to the right are taken together.
    """
    sums = np.zeros((reach + 1, reach + 1))
    pairs = np.zeros_like(sums)
    values = np.where(mask, residuals, 0.0)
    rows, cols = mask.shape
    for i in range(min(reach, rows - 1) + 1):
        for j in range(-min(reach, cols - 1), min(reach, cols - 1) + 1):
            here = np.s_[: rows - i, max(0, -j) : cols - max(0, j)]
            there = np.s_[i:, max(0, j) : cols - max(0, -j)]
            sums[i, abs(j)] += float(np.sum(values[:, *here] * values[:, *there]))
            pairs[i, abs(j)] += len(values) * np.count_nonzero(mask[here] & mask[there])
    mean = sums / np.maximum(pairs, 1)
    return mean / mean[0, 0], 1 / np.sqrt(np.maximum(pairs, 1))


def believed(correlation: Array, error: Array) -> Array:
    """The lags that stand out from chance; the others are taken for 0."""
    table = np.where(np.abs(correlation) > LEAST_SIGMA * error, correlation, 0.0)
    table[0, 0] = 1.0
    return table


def correlation_matrix(table: Array, mask: Mask) -> Array:
    """(n, n) of the pixels of a mask, positive semi-definite, ones on its diagonal."""
    row, col = np.nonzero(mask)
    lag_row, lag_col = np.abs(row[:, None] - row), np.abs(col[:, None] - col)
    reach = len(table) - 1
    near = (lag_row <= reach) & (lag_col <= reach)
    matrix = np.where(near, table[np.minimum(lag_row, reach), np.minimum(lag_col, reach)], 0.0)
    values, vectors = np.linalg.eigh(matrix)
    matrix = (vectors * np.maximum(values, 0.0)) @ vectors.T
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(matrix / np.outer(scale, scale))


def weight_matrix(matrix: Array) -> Array:
    """(n, n) inverse of the correlation with a share of white noise: the weights of a fit."""
    softened = (1 - WHITE_SHARE) * matrix + WHITE_SHARE * np.eye(len(matrix))
    return np.asarray(np.linalg.inv(softened))
