"""The answer of every localization."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sr_engine.psf import Psf

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Localization:
    """Centre of the fiducial in the reference pose, and how well it is known.

    centre_px: (row, col), pixel (0, 0) has its centre at (0.0, 0.0).
    covariance_px2: (2, 2) by noise, row and col: what counts between places seen by one method.
    radius_px, amplitude, background, snr: means over the frames; amplitude is negative for an
      object darker than what surrounds it; snr = |amplitude| / noise std per channel.
    residuals_px: (N, 2), what each frame's centre less its shift differs by from centre_px.
    chi2_per_dof: of the residuals against their covariances (2N - 2 degrees of freedom); for one
      frame, of its pixels against the model.
    psf: point spread of the fit; None where the object's own image was fitted.
    systematic_px: std (row, col) of what is common to all poses, beside covariance_px2: it cancels
      between places seen by the same method, and counts where the centre itself does: sigma_px.
    common_px: std (row, col) of that part of covariance_px2 that no other look averages out.
    """

    centre_px: Array
    covariance_px2: Array
    radius_px: float
    amplitude: float
    background: float
    snr: float
    sigma: float
    chi2_per_dof: float
    n_frames: int
    method: str
    residuals_px: Array
    psf: Psf | None
    systematic_px: Array | None = None
    common_px: Array | None = None

    @property
    def sigma_px(self) -> Array:
        """Standard deviations (row, col) of the centre itself: noise and what is systematic."""
        noise = np.sqrt(np.diag(self.covariance_px2))
        common = 0.0 if self.systematic_px is None else self.systematic_px
        return np.asarray(np.hypot(noise, common))
