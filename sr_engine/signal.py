"""The noise-free signal of one round object and its surroundings, with derivatives and priors.

    m = (A s(R) + D (s(R + w) - s(R)) + B) (1 + b . x) + a . x,   x = pixel - reference pixel

s(R) unit object of radius R at c through the point spread, A its amplitude, B background,
b relative shading, a slope of the surroundings. Where there is a wall (a shell): D its amplitude
and w its thickness; a thin wall shows D w only.

Priors, of mean zero. Unknown shading costs 10 to 25 % of precision, shading not allowed for
costs 0.45 b R in bias; the prior is what is known of coils:
  b   a mixture: typical shading of 0.5 % a pixel, or (one frame in two) strong, of 3 % a pixel
  a   likewise 0.1 %, or 2 %, of |A| + |B| a pixel
  B   likewise 1 % of |A| (air), or ten times |A| + |B|. A magnitude hardly tells a small B from
      more noise, and B counts by its square alone: left free it takes 4 % off the noise level at
      SNR 10, and with it off the covariance. The centre does not depend on it.
  w   within 40 % of what is expected (the one prior not of mean zero);  D twice |A| + |B|
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sr_engine.model import Patch, Shape, unit_object
from sr_engine.psf import Psf

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROW, COL, RADIUS, AMPLITUDE, BACKGROUND = range(5)
SLOPES, SHADING = slice(5, 7), slice(7, 9)
SURROUNDINGS = [BACKGROUND, 5, 6]
N_PARAMETERS = 9  # 11 with a wall
WALL, WALL_PX = 9, 10

SHADING_SCALES = 0.005, 0.03  # std of the typical and of the strong, relative, per pixel
SLOPE_SCALES = 0.001, 0.02
BACKGROUND_SCALES = 0.01, 10.0
_WALL_SCALE = 2.0
_WALL_SPREAD = 0.4
WALL_BOUNDS_PX = 0.2, 4.0


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixels of a region of interest: values (rows, cols), and which of them count."""

    patch: Patch
    values: Array
    mask: Mask


@dataclass(frozen=True)
class ObjectModel:
    """What is fitted: which object, through which point spread, shading about which pixel."""

    psf: Psf
    shape: Shape
    reference_px: tuple[float, float]
    wall_px: float | None = None  # expected thickness; None: no wall

    @property
    def n_parameters(self) -> int:
        return N_PARAMETERS if self.wall_px is None else N_PARAMETERS + 2


def signal_of(parameters: Array, patch: Patch, model: ObjectModel) -> tuple[Array, Array]:
    """Signal (rows, cols) on the patch, and its derivatives (n_parameters, rows, cols)."""
    row, col, radius, amplitude, background = parameters[:5].tolist()
    a_row, a_col, b_row, b_col = parameters[5:N_PARAMETERS].tolist()
    s, s_row, s_col, s_radius = unit_object(patch, model.psf, model.shape, (row, col), radius)
    x_row = (patch.rows - model.reference_px[0])[:, None]
    x_col = (patch.cols - model.reference_px[1])[None, :]
    shading = (1 + b_row * x_row) + b_col * x_col
    lit = amplitude * shading
    derivatives = np.empty((model.n_parameters, *s.shape))
    derivatives[ROW] = lit * s_row
    derivatives[COL] = lit * s_col
    derivatives[RADIUS] = lit * s_radius
    derivatives[AMPLITUDE] = s * shading
    derivatives[BACKGROUND] = shading
    derivatives[5], derivatives[6] = x_row, x_col
    unshaded = amplitude * s + background
    if model.wall_px is not None:
        wall, thickness = parameters[WALL:].tolist()
        outer = unit_object(patch, model.psf, model.shape, (row, col), radius + thickness)
        unshaded += wall * (outer[0] - s)
        for index, inner in ((ROW, s_row), (COL, s_col), (RADIUS, s_radius)):
            derivatives[index] += wall * shading * (outer[index + 1] - inner)
        derivatives[WALL] = (outer[0] - s) * shading
        derivatives[WALL_PX] = wall * shading * outer[3]
    derivatives[7], derivatives[8] = unshaded * x_row, unshaded * x_col
    return unshaded * shading + (a_row * x_row + a_col * x_col), derivatives


def prior_mean(model: ObjectModel) -> Array:
    """(n_parameters,) what the priors pull towards."""
    mean = np.zeros(model.n_parameters)
    if model.wall_px is not None:
        mean[WALL_PX] = model.wall_px
    return mean


def prior_precision(parameters: Array, model: ObjectModel) -> Array:
    """(n_parameters,) inverse variances of the priors, at the present estimate of the shading.

    A mixture acts as a Gaussian whose precision is the expectation over its two components (an EM
    step), so that strong shading is not held back.
    """
    level = float(abs(parameters[AMPLITUDE]) + abs(parameters[BACKGROUND]))
    precision = np.zeros(model.n_parameters)
    scales = BACKGROUND_SCALES[0] * abs(float(parameters[AMPLITUDE])) / level, BACKGROUND_SCALES[1]
    background = parameters[[BACKGROUND]] / level
    precision[BACKGROUND] = mixture_precision(background, scales) / level**2
    precision[SLOPES] = mixture_precision(parameters[SLOPES] / level, SLOPE_SCALES) / level**2
    precision[SHADING] = mixture_precision(parameters[SHADING], SHADING_SCALES)
    if model.wall_px is not None:
        precision[WALL] = 1 / (_WALL_SCALE * level) ** 2
        precision[WALL_PX] = 1 / (_WALL_SPREAD * model.wall_px) ** 2
    return precision


def mixture_precision(values: Array, scales: tuple[float, float]) -> float:
    """Of values (n,) that are all from the narrow or all from the wide component."""
    narrow, wide = 1 / max(scales[0], 1e-12) ** 2, 1 / scales[1] ** 2
    likelihood = 0.5 * float(values @ values) * (narrow - wide)
    log_odds = 0.5 * values.size * math.log(wide / narrow) + likelihood
    share = 1 / (1 + math.exp(min(log_odds, 700.0)))
    return share * narrow + (1 - share) * wide
