"""The least uncertainty that any unbiased estimate of the centre can have (Cramer-Rao).

Fisher information of magnitude (Rician) pixels about the parameters of the model that is fitted,
with the priors that the fit uses. For a disc through all of square k-space, in white noise and
with all else known, it is close to 0.533/(SNR sqrt(R N)) px an axis.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, i1e

from sr_engine.errors import ParameterError
from sr_engine.model import DISC, Patch, Shape
from sr_engine.psf import Psf
from sr_engine.signal import (
    AMPLITUDE,
    BACKGROUND,
    N_PARAMETERS,
    RADIUS,
    ObjectModel,
    prior_precision,
    signal_of,
)

Array = NDArray[np.float64]

_MARGIN_PX = 12.0
_PHASES = ((0.0, 0.0), (0.25, 0.4), (0.5, 0.15))


def rician_information(ratio: Array) -> Array:
    """Fisher information about the signal, in units of 1/sigma^2, at signal/sigma; 0 to 1."""
    ratios, information = _information_table()
    return np.interp(np.abs(ratio), ratios, information, right=1.0)


@lru_cache(maxsize=1)
def _information_table() -> tuple[Array, Array]:
    ratios = np.concatenate([np.linspace(0, 8, 321), np.geomspace(8.1, 200, 60)])
    return ratios, np.array([_information_at(float(r)) for r in ratios])


def _information_at(ratio: float) -> float:
    """Mean square of the score of a Rician pixel with unit sigma, by quadrature."""
    x = np.linspace(max(1e-9, ratio - 12), ratio + 12, 4001)
    z = x * ratio
    density = x * np.exp(-((x - ratio) ** 2) / 2) * i0e(z)
    score = x * i1e(z) / i0e(z) - ratio
    return float(np.trapezoid(density * score**2, x))


def bound_px(
    radius_px: float,
    snr: float,
    *,
    n_frames: int = 1,
    background: float = 0.0,
    psf: Psf | None = None,
    shape: Shape = DISC,
    shift_sigma_px: float = 0.0,
    with_nuisance: bool = True,
) -> float:
    """Least std (px, one axis) of the centre from n_frames frames, mean over pixel phases.

    snr: amplitude over noise std per channel. background: in units of the amplitude.
    with_nuisance: shading and slopes unknown but for their priors; otherwise only centre, radius,
    amplitude and background are. White noise: what the flat k-space of `psf` gives.
    """
    if not (radius_px > 0 and snr > 0 and n_frames >= 1 and shift_sigma_px >= 0):
        raise ParameterError(
            f"bound needs positive radius, SNR and frames, got {radius_px}, {snr}, {n_frames}"
        )
    psf = psf or Psf()
    variances = [
        _variance(radius_px, snr, background, psf, shape, phase, with_nuisance) for phase in _PHASES
    ]
    return float(np.sqrt((np.mean(variances) + shift_sigma_px**2) / n_frames))


def _variance(
    radius_px: float,
    snr: float,
    background: float,
    psf: Psf,
    shape: Shape,
    phase: tuple[float, float],
    with_nuisance: bool,
) -> float:
    """Mean variance of row and column, for one pixel phase, one frame, unit amplitude."""
    half = int(np.ceil(radius_px + _MARGIN_PX))
    pixels = np.arange(2 * half + 1, dtype=float)
    parameters = np.zeros(N_PARAMETERS)
    parameters[:2] = half + phase[0], half + phase[1]
    parameters[RADIUS], parameters[AMPLITUDE], parameters[BACKGROUND] = radius_px, 1.0, background
    period = 4 * half
    model = ObjectModel(psf, shape, (half, half))
    signal, derivatives = signal_of(parameters, Patch(pixels, pixels, (period, period)), model)
    weights = rician_information(signal.ravel() * snr) * snr**2
    by_parameter = derivatives.reshape(N_PARAMETERS, -1)
    information = (by_parameter * weights) @ by_parameter.T
    information += np.diag(prior_precision(parameters, model))
    if not with_nuisance:
        information = information[:5, :5]
    covariance = np.linalg.inv(information)
    return float((covariance[0, 0] + covariance[1, 1]) / 2)
