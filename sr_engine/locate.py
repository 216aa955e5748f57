"""All round objects of one slice, each with centre, covariance and radius.

Detection says where round objects are; each is then fitted with the model that explains it best: a
plain disc or one with a wall, through the point spread that the slice shows.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.checks import checked_frames
from sr_engine.detect import Candidate, detect
from sr_engine.errors import EngineError, NoRoundObjectError
from sr_engine.fit import DiscFit, fit_disc
from sr_engine.localize import noise_kind, region_of_interest
from sr_engine.lopsided import frame_noise, with_lopsidedness
from sr_engine.model import DISC, unit_object
from sr_engine.psf import Psf
from sr_engine.signal import Pixels

Array = NDArray[np.float64]

START_RADII = (0.75, 0.85, 0.95, 1.0, 1.05, 1.15, 1.25, 1.4)  # of the candidate's
START_WALLS_PX = (None, 1.2, 2.2)
START_MARGIN_PX = 6.0
PSFS = (
    Psf("flat"),
    Psf("elliptical"),
    Psf("fermi"),
    Psf("hamming"),
    Psf("hamming", acquired=(0.75, 0.75)),
    Psf("hamming", acquired=(0.6, 0.6)),
)
PSF_RADII_PX = (-0.25, 0.0, 0.25)  # about the start's radius, which depends on the point spread
PSF_OBJECTS = 3  # of a slice, that its point spread is judged by
RADIUS_FREEDOM = (0.6, 1.6)  # of the start's radius
GROSS_SIGMA = 20.0  # pixels are left out beyond it: a bubble is, an imperfect outline is not
FARTHEST_PX = 2.0  # that a fit may go from its candidate, or a third of the radius if that is more


@dataclass(frozen=True, eq=False)
class Located:
    """One round object of a slice.

    centre_px (row, col) with covariance_px2 (2, 2) by noise, and systematic_px, std (row, col) of
    what its shape does beside it, see `lopsided`; radius_px of the inner edge where there is a
    wall (wall_px thick, 0 for none); amplitude over the surroundings, negative if darker.
    snr: largest step at the edge over the noise, which includes what the model does not describe.
    """

    centre_px: Array
    covariance_px2: Array
    systematic_px: Array
    radius_px: float
    wall_px: float
    amplitude: float
    snr: float
    chi2_per_dof: float
    strength: float
    psf: Psf
    method: str = "ml"

    @property
    def sigma_px(self) -> Array:
        """Standard deviations (row, col) of the centre itself: noise and what is systematic."""
        return np.asarray(np.hypot(np.sqrt(np.diag(self.covariance_px2)), self.systematic_px))


def locate_all(
    frame: ArrayLike,
    radius_px: tuple[float, float] | float | None = None,
    *,
    max_objects: int = 50,
    roi: tuple[int, int, int, int] | None = None,
    psf: Psf | None = None,
) -> list[Located]:
    """Every round object of a frame of magnitude pixels (rows, cols), strongest first.

    radius_px: (low, high) or one number within 25 %; default 2 to 40 px. roi: (row0, col0, row1,
    col1) bounds of the centres. psf: point spread; by default the likeliest of `PSFS`.
    Raises NoRoundObjectError where nothing round is seen, or nothing that is seen can be fitted
    (the message says which and why); ConstantFrameError, NotFiniteError, ShapeError,
    ParameterError for input that is none.
    """
    image = checked_frames(frame)[0]
    candidates = detect(image, radius_px, max_objects=max_objects, roi=roi)
    if not candidates:
        raise NoRoundObjectError("no round object of the allowed size stands out from the slice")
    psf = psf or likeliest_psf(image, candidates[:PSF_OBJECTS])
    found: list[Located] = []
    refusals: list[str] = []
    for candidate in candidates:
        try:
            found.append(refine(image, candidate, psf))
        except EngineError as error:
            refusals.append(str(error))
    if not found:
        raise NoRoundObjectError(f"no round object fits ({len(refusals)} seen): {refusals[0]}")
    return found


def likeliest_psf(image: Array, candidates: list[Candidate]) -> Psf:
    """The point spread through which the candidates of a slice are explained best together."""
    scores = np.zeros(len(PSFS))
    for candidate in candidates:
        radius, wall_px = _best_starts(image, candidate, PSFS[0])[0]
        outer = radius + (wall_px or 0.0)
        try:
            pixels = region_of_interest(image, (*candidate.centre_px, outer), PSFS[0])
        except EngineError:
            continue
        for i, psf in enumerate(PSFS):
            left = min(
                _misfit(pixels, psf, candidate.centre_px, radius + d, wall_px) for d in PSF_RADII_PX
            )
            scores[i] += np.count_nonzero(pixels.mask) * np.log(left)
    return PSFS[int(np.argmin(scores))]


def refine(image: Array, candidate: Candidate, psf: Psf) -> Located:
    """Fit one candidate with the wall, if any, that its surroundings speak for.

    Raises the EngineError of the likeliest model where no model fits.
    """
    errors: list[EngineError] = []
    for radius, wall_px in _best_starts(image, candidate, psf):
        try:
            return _located(_fit(image, candidate, radius, wall_px, psf), candidate, psf)
        except EngineError as error:
            errors.append(error)
    raise errors[0]


def _fit(
    image: Array, candidate: Candidate, radius: float, wall_px: float | None, psf: Psf
) -> DiscFit:
    row, col = candidate.centre_px
    noise = noise_kind(image, psf)
    pixels = region_of_interest(image, (row, col, radius + (wall_px or 0.0)), psf)
    fit = fit_disc(
        pixels,
        (row, col, radius),
        psf,
        radius_bounds_px=(RADIUS_FREEDOM[0] * radius, RADIUS_FREEDOM[1] * radius),
        wall_px=wall_px,
        noise=noise,
        outlier_sigma=GROSS_SIGMA,
        whiten=False,  # on real slices the model's own imperfection is what remains
    )
    moved = float(np.hypot(*(fit.centre_px - candidate.centre_px)))
    if not moved < max(FARTHEST_PX, candidate.radius_px / 3):
        raise NoRoundObjectError(f"the fit at row {row:.1f}, col {col:.1f} ran {moved:.1f} px away")
    return with_lopsidedness(fit, pixels, frame_noise(image, noise))


def _best_starts(image: Array, candidate: Candidate, psf: Psf) -> list[tuple[float, float | None]]:
    """(radius, wall thickness) to begin at, likeliest first: one for each wall, and for none."""
    centre = candidate.centre_px
    pixels = region_of_interest(image, (*centre, candidate.radius_px), psf, START_MARGIN_PX)
    radii = {max(1.0, round(share * candidate.radius_px * 4) / 4) for share in START_RADII}
    starts = []
    for wall_px in START_WALLS_PX:
        tried = [(_misfit(pixels, psf, centre, r, wall_px), r) for r in sorted(radii)]
        left, radius = min(tried)
        starts.append((left, radius, wall_px))
    starts.sort(key=lambda start: start[0])
    return [(radius, wall_px) for _, radius, wall_px in starts]


def _misfit(
    pixels: Pixels, psf: Psf, centre: tuple[float, float], radius: float, wall_px: float | None
) -> float:
    """What least squares leave, times the information criterion's price of a parameter."""
    inside = pixels.mask
    rows, cols = pixels.patch.rows - centre[0], pixels.patch.cols - centre[1]
    x_row, x_col = np.broadcast_arrays(rows[:, None], cols[None, :])
    s, *_ = unit_object(pixels.patch, psf, DISC, centre, radius)
    columns = [s[inside], np.ones(int(inside.sum())), x_row[inside], x_col[inside]]
    if wall_px is not None:
        outer, *_ = unit_object(pixels.patch, psf, DISC, centre, radius + wall_px)
        columns.append(outer[inside])
    basis, _ = np.linalg.qr(np.stack(columns, axis=1))
    values = pixels.values[inside]
    left = values - basis @ (basis.T @ values)
    price = np.exp(2 * (len(columns) + (wall_px is not None)) * 5 / values.size)
    return float(left @ left * price)


def _located(fit: DiscFit, candidate: Candidate, psf: Psf) -> Located:
    return Located(
        centre_px=fit.centre_px,
        covariance_px2=fit.covariance_px2,
        systematic_px=fit.systematic_px,
        radius_px=fit.radius_px,
        wall_px=fit.wall_px,
        amplitude=fit.amplitude,
        snr=fit.snr,
        chi2_per_dof=fit.chi2_per_dof,
        strength=candidate.strength,
        psf=psf,
    )
