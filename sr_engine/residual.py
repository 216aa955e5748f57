"""What a fitted round object leaves of a frame: shape that the model lacks shows here."""

import numpy as np
from numpy.typing import NDArray

from sr_engine.model import DISC, Patch, unit_object
from sr_engine.psf import Psf

Array = NDArray[np.float64]
_MARGIN_PX = 6.0


def residual_image(
    frame: Array, centre_px: tuple[float, float], radius_px: float, psf: Psf
) -> Array:
    """A frame (rows, cols) less the disc and its background within 6 px of its edge, 0 beyond.

    Amplitude and background are those that leave least (least squares).
    """
    reach = radius_px + _MARGIN_PX
    rows, cols = (
        np.arange(max(0, np.ceil(at - reach)), min(n - 1, np.floor(at + reach)) + 1)
        for at, n in zip(centre_px, frame.shape, strict=True)
    )
    left = np.zeros_like(frame, dtype=np.float64)
    if not len(rows) or not len(cols):
        return left
    period = (frame.shape[0], frame.shape[1])
    unit = unit_object(Patch(rows, cols, period), psf, DISC, centre_px, radius_px)[0]
    box = np.ix_(rows.astype(int), cols.astype(int))
    design = np.column_stack([unit.ravel(), np.ones(unit.size)])
    seen = np.asarray(frame[box], dtype=np.float64)
    weights, *_ = np.linalg.lstsq(design, seen.ravel(), rcond=None)
    left[box] = seen - (design @ weights).reshape(seen.shape)
    return left
