"""Where the fiducial is, with covariance, from one frame or several at known shifts.

Every frame is fitted by itself (see `fit`); the centres, less their shifts, are averaged with the
inverse of their covariances as weights. This equals the joint fit, because the centre is
orthogonal to all that a frame has of its own. What is left over, frame by frame, tells whether
the frames agree with their shifts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from sr_engine.checks import (
    checked_frames,
    checked_point,
    checked_radii,
    checked_shifts,
    refuse_saturated,
)
from sr_engine.detect import detect
from sr_engine.errors import (
    AmbiguousObjectError,
    InconsistentFramesError,
    NoRoundObjectError,
    NotConvergedError,
    ObjectAtBorderError,
    OutsideGateError,
    ParameterError,
)
from sr_engine.fit import DiscFit, fit_disc
from sr_engine.localization import Localization
from sr_engine.lopsided import frame_noise, with_lopsidedness
from sr_engine.match import best_matches, correlate, radius_grid
from sr_engine.model import DISC, Patch, Shape
from sr_engine.noise import NoiseKind
from sr_engine.paper import localize_paper
from sr_engine.psf import Psf
from sr_engine.recognise import recognise_psf
from sr_engine.signal import Pixels

Array = NDArray[np.float64]

MARGIN_PX = 4.0  # of surroundings that are fitted with the object
INNER_BAND_PX = 10.0  # inside of the edge
SEARCH_PX = 3.0  # how far from a given start the object may be
DEFAULT_RADII_PX = (1.5, 12.0)
LEAST_EXPLAINED = 0.3  # of the variance near a given start, by the matched filter
AMBIGUOUS_RATIO = 0.9  # a second candidate of this share of the best score is as good
MINIMUM_EXPLAINED = 60.0  # chi2 that an object must take away to be one
CONSISTENCY_P = 1e-5  # frames that agree look as bad as this once in 100,000 measurements
MODEL_FLOOR_PX = 0.01  # what an imperfect point spread may do to one frame; check only
MISFIT = 1.6  # of the frame's noise, left by a disc: then a ring is tried
RING_WALLS, MOST_WALL_PX = (0.6, 0.4), 3.5  # of the outer radius
LEAST_VOID_PX = 0.6
RING_GAIN = 0.7  # of what a disc leaves
FOLDING_MARGIN_PX = 6.0
LARGEST_PERIOD_PX = 160  # ringing that comes round from farther away is below 1e-4 of the object


def localize(
    frames: ArrayLike,
    shifts_px: ArrayLike | None = None,
    *,
    start_px: ArrayLike | None = None,
    radius_px: tuple[float, float] | float | None = None,
    method: str = "ml",
    psf: Psf | Literal["auto"] | None = None,
    shape: Shape = DISC,
    wall_px: float | None = None,
    noise: NoiseKind | None = None,
    sigma: float | None = None,
    shift_sigma_px: float = 0.0,
    gate_px: float | None = None,
    saturation_level: float | None = None,
    robust: bool = True,
) -> Localization:
    """Localize one round object in frames of one size taken at known shifts.

    frames: (rows, cols) or (N, rows, cols), magnitude pixels (whole frames: their size tells the
      sampling of k-space).
    shifts_px: (N, 2), displacement (row, col) of the object in frame k from the reference pose.
      May be left out for one frame.
    start_px: where the object is in the reference pose, to within 3 px; else it is looked for.
    radius_px: (low, high), or one number within 25 %; default 1.5 to 12 px.
    method: "ml", or one of the paper's, "sr", "bicubic", "base" (see `paper`), which heed
      start_px, radius_px, gate_px and saturation_level alone.
    psf: point spread; default flat k-space; "auto" recognises it in the first frame (slow, see
      `recognise`). noise: "rician", or "gaussian" (default for a psf
      that folds, a camera, and where pixels are negative).
    sigma: noise std per channel, where known.
    wall_px: expected thickness of a shell about the object, where it has one. Without, a ring about
      a void is told from a disc.
    shift_sigma_px: std per axis of a frame's shift (the motor's repeatability).
    gate_px: refuse an object farther than this from start_px.
    saturation_level: pixel value at which the source saturates, where known.

    Raises a subclass of EngineError; never returns a centre that it does not stand for.
    """
    if method in ("base", "bicubic", "sr"):
        return localize_paper(
            frames, shifts_px, method, start_px=start_px, radius_px=radius_px, gate_px=gate_px,
            saturation_level=saturation_level,
        )  # fmt: skip
    if method != "ml":
        raise ParameterError(f"unknown method '{method}', known: ml, sr, bicubic, base")
    stack = checked_frames(frames)
    shifts = checked_shifts(shifts_px, len(stack))
    radii = checked_radii(radius_px) or DEFAULT_RADII_PX
    start = checked_point(start_px, "start_px")
    guess = _first_guess(stack[0], start, shifts[0], radii)
    if psf == "auto":
        psf = _recognised(stack[0], guess, shifts[0], radii, noise)
    psf = psf or Psf()
    noise = noise or noise_kind(stack, psf)
    fits: list[DiscFit] = []
    bounds = (0.8 * radii[0], 1.2 * radii[1])
    how = _How(psf, bounds, shape, wall_px, noise, sigma, robust)
    for frame, shift in zip(stack, shifts, strict=True):
        begin = (guess[0] + shift[0], guess[1] + shift[1], guess[2])
        pixels = region_of_interest(frame, begin, psf)
        refuse_saturated(pixels.values, guess[2], saturation_level)
        level = frame_noise(frame, noise) if sigma is None else sigma
        if fits:  # the first frame tells the others all but the place
            fit = how.fit(pixels, fits[-1].moved_to(np.array(begin[:2])))
        else:
            how, fit = _disc_or_ring(pixels, begin, how, level)
        if fit.n_masked > np.count_nonzero(~pixels.mask):
            whole = _without_mask(pixels, fit, how)
            fit = fit if whole is None else _widened_by_mask(fit, whole)
        if not psf.folds:  # what a camera folds differs from pixel to pixel, and draws no edge
            fit = with_lopsidedness(fit, pixels, level)
            if not fit.sigma < MISFIT * level:
                fit = _widened_by_misfit(fit)
        _refuse_doubtful(fit, begin, frame.shape)
        fits.append(fit)
        guess = (*(fit.centre_px - shift), fit.outer_px)
    radius = float(np.mean([fit.outer_px for fit in fits]))
    common = np.sqrt(np.mean([fit.systematic_px**2 for fit in fits], axis=0))
    result = combined(fits, shifts, radius, shift_sigma_px, psf=psf, systematic_px=common)
    _refuse_outside_gate(result.centre_px, start, gate_px)
    return result


@dataclass(frozen=True)
class _How:
    """What is fitted, and how; see `fit_disc`."""

    psf: Psf
    bounds_px: tuple[float, float]
    shape: Shape
    wall_px: float | None
    noise: NoiseKind
    sigma: float | None
    robust: bool

    def fit(self, pixels: Pixels, start: tuple[float, float, float] | DiscFit) -> DiscFit:
        return fit_disc(
            pixels, start, self.psf, radius_bounds_px=self.bounds_px, shape=self.shape,
            wall_px=self.wall_px, noise=self.noise, sigma=self.sigma, robust=self.robust,
        )  # fmt: skip


def _disc_or_ring(
    pixels: Pixels, begin: tuple[float, float, float], how: _How, noise_std: float
) -> tuple[_How, DiscFit]:
    """The disc, or, where that leaves more than noise, a ring about a void if it leaves less."""
    disc: DiscFit | None = None
    try:
        disc = how.fit(pixels, begin)
    except (NoRoundObjectError, NotConvergedError) as error:
        if how.wall_px is not None or how.shape != DISC:
            raise
        failed = error
    if disc is not None and (how.wall_px is not None or disc.sigma < MISFIT * noise_std):
        return how, disc
    best = None
    for share in RING_WALLS:
        wall_px = min(share * begin[2], MOST_WALL_PX)
        ring = replace(how, wall_px=wall_px, bounds_px=(LEAST_VOID_PX, how.bounds_px[1]))
        try:
            fit = ring.fit(pixels, (begin[0], begin[1], begin[2] - wall_px))
        except (NoRoundObjectError, NotConvergedError):
            continue
        outer = fit.radius_px + fit.wall_px
        is_like = fit.is_ring and how.bounds_px[0] < outer < how.bounds_px[1]
        if is_like and (best is None or fit.sigma < best[1].sigma):
            best = ring, fit
    if best is not None and (disc is None or best[1].sigma < RING_GAIN * disc.sigma):
        return best
    if disc is None:
        raise failed
    return how, disc


def _without_mask(pixels: Pixels, like: DiscFit, how: _How) -> DiscFit | None:
    """The fit to all pixels; None where it does not settle."""
    try:
        return replace(how, robust=False).fit(pixels, like)
    except (NoRoundObjectError, NotConvergedError):
        return None


def _widened_by_mask(fit: DiscFit, whole: DiscFit) -> DiscFit:
    """What the pixels left out would have done to the centre belongs to its uncertainty.

    A bubble is left out rightly, one end of an oval outline is not, and one frame does not always
    tell which it was.
    """
    apart = fit.centre_px - whole.centre_px
    if not np.any(np.abs(apart) > np.sqrt(np.diag(fit.covariance_px2))):
        return fit
    covariance = fit.covariance.copy()
    covariance[:2, :2] += np.outer(apart, apart)
    return replace(fit, covariance=covariance)


def _widened_by_misfit(fit: DiscFit) -> DiscFit:
    """Of what is no disc another frame may show another centre: one frame does not tell how much
    of what draws it is common to all, so half of it counts to each."""
    covariance = fit.covariance.copy()
    covariance[:2, :2] += np.diag(fit.systematic_px**2) / 2
    return replace(fit, covariance=covariance, systematic_px=fit.systematic_px / np.sqrt(2))


def _recognised(
    frame: Array,
    guess: tuple[float, float, float],
    shift: Array,
    radii: tuple[float, float],
    noise: NoiseKind | None,
) -> Psf:
    begin = (guess[0] + shift[0], guess[1] + shift[1], guess[2])
    pixels = region_of_interest(frame, begin, Psf())
    noise = noise or noise_kind(frame, Psf())
    return recognise_psf(frame, pixels, begin, (0.8 * radii[0], 1.2 * radii[1]), noise)


def noise_kind(frames: Array, psf: Psf) -> NoiseKind:
    """Magnitudes are Rician; a camera's pixels, and signed ones, are not magnitudes."""
    return "gaussian" if psf.folds or frames.min() < 0 else "rician"


def region_of_interest(
    frame: Array, guess: tuple[float, float, float], psf: Psf, margin_px: float = MARGIN_PX
) -> Pixels:
    """The pixels within radius + margin of the guess (row, col, radius), clipped at the frame.

    Of a large object only a band inside of the edge: the rest tells nothing of the centre, and
    shading that no straight line follows would only mislead.
    Raises ObjectAtBorderError where the object itself is not wholly inside of the frame.
    """
    row, col, radius = guess
    refuse_cut_by_border((row, col), radius, (frame.shape[0], frame.shape[1]))
    reach = radius + margin_px
    spans = []
    for centre, n in ((row, frame.shape[0]), (col, frame.shape[1])):
        spans.append(
            (max(0, int(np.floor(centre - reach))), min(n, int(np.ceil(centre + reach)) + 1))
        )
    (r0, r1), (c0, c1) = spans
    rows, cols = np.arange(r0, r1, dtype=float), np.arange(c0, c1, dtype=float)
    distance = np.hypot(rows[:, None] - row, cols[None, :] - col)
    mask = (distance <= reach) & (distance >= radius - INNER_BAND_PX)
    period = _period((frame.shape[0], frame.shape[1]), reach, psf)
    return Pixels(Patch(rows, cols, period), frame[r0:r1, c0:c1], mask)


def _period(shape: tuple[int, int], reach_px: float, psf: Psf) -> tuple[int, int]:
    """The frame's own shape, or a smaller one that makes no difference so near the object."""
    if psf.folds:  # such a point spread ends after a pixel or two
        size = int(np.ceil(2 * (reach_px + FOLDING_MARGIN_PX)))
        return size, size
    enough = max(LARGEST_PERIOD_PX, 2 * int(np.ceil(2 * reach_px)))
    return min(shape[0], enough), min(shape[1], enough)


def refuse_cut_by_border(
    centre_px: tuple[float, float], radius_px: float, shape: tuple[int, int]
) -> None:
    """Raise ObjectAtBorderError unless the disc lies wholly inside of the frame."""
    for name, centre, n in zip(("row", "col"), centre_px, shape, strict=True):
        if not radius_px - 0.5 <= centre <= n - 0.5 - radius_px:
            raise ObjectAtBorderError(
                f"object of radius {radius_px:.1f} px at {name} {centre:.1f} is cut by the border "
                f"of {n} {name}s"
            )


def _first_guess(
    frame: Array,
    start: tuple[float, float] | None,
    shift: Array,
    radii: tuple[float, float],
) -> tuple[float, float, float]:
    """(row, col, radius) in the reference pose, from the matched filter on the first frame."""
    if start is None:
        centre, radius = _search(frame, radii)
    else:
        expected = (start[0] + shift[0], start[1] + shift[1])
        inside = all(-0.5 <= x <= n - 0.5 for x, n in zip(expected, frame.shape, strict=True))
        if not inside:
            raise ObjectAtBorderError(
                f"start ({expected[0]:.1f}, {expected[1]:.1f}) is outside the frame"
            )
        centre, radius = _search_near(frame, expected, radii)
    return centre[0] - shift[0], centre[1] - shift[1], radius


def _search_near(
    frame: Array, expected: tuple[float, float], radii: tuple[float, float]
) -> tuple[tuple[float, float], float]:
    reach = int(np.ceil(radii[1] + MARGIN_PX + SEARCH_PX))
    r0, c0 = (max(0, round(x) - reach) for x in expected)
    part = frame[r0 : round(expected[0]) + reach + 1, c0 : round(expected[1]) + reach + 1]
    found = correlate(part, radius_grid(*radii, step_px=1.0))
    rows, cols = np.indices(part.shape)
    far = np.hypot(rows + r0 - expected[0], cols + c0 - expected[1]) > SEARCH_PX
    found.explained[:, far] = 0.0
    match = best_matches(found, 1, 1.0, LEAST_EXPLAINED)
    if not match:
        raise NoRoundObjectError(
            f"no round object within {SEARCH_PX:g} px of row {expected[0]:.1f}, "
            f"col {expected[1]:.1f}"
        )
    row, col = match[0].centre_px
    return (row + r0, col + c0), match[0].radius_px


def _search(frame: Array, radii: tuple[float, float]) -> tuple[tuple[float, float], float]:
    """The one round object of the frame."""
    found = detect(frame, radii, max_objects=2)
    if not found:
        raise NoRoundObjectError(
            f"no round object of radius {radii[0]:.1f} to {radii[1]:.1f} px stands out"
        )
    if len(found) > 1 and found[1].strength > AMBIGUOUS_RATIO * found[0].strength:
        (row0, col0), (row1, col1) = found[0].centre_px, found[1].centre_px
        raise AmbiguousObjectError(
            f"two round objects are equally good, at row {row0:.1f} col {col0:.1f} and at row "
            f"{row1:.1f} col {col1:.1f}: give a start or a narrower radius range"
        )
    return found[0].centre_px, found[0].radius_px


def _refuse_doubtful(
    fit: DiscFit, begin: tuple[float, float, float], frame_shape: tuple[int, ...]
) -> None:
    if not fit.explained > MINIMUM_EXPLAINED:
        raise NoRoundObjectError(
            f"the object found at row {begin[0]:.1f}, col {begin[1]:.1f} does not stand out from "
            f"the noise (chi2 {fit.explained:.0f}, needs {MINIMUM_EXPLAINED:.0f})"
        )
    moved = float(np.hypot(*(fit.centre_px - begin[:2])))
    if not moved < max(2.0, 0.5 * begin[2]):
        raise NotConvergedError(f"the fit moved {moved:.1f} px away from its start")
    refuse_cut_by_border(
        (float(fit.centre_px[0]), float(fit.centre_px[1])),
        fit.outer_px,
        (frame_shape[0], frame_shape[1]),
    )


class FrameFit(Protocol):
    """What a fit says of one frame."""

    @property
    def centre_px(self) -> Array: ...
    @property
    def covariance_px2(self) -> Array: ...
    @property
    def amplitude(self) -> float: ...
    @property
    def background(self) -> float: ...
    @property
    def snr(self) -> float: ...
    @property
    def sigma(self) -> float: ...
    @property
    def chi2_per_dof(self) -> float: ...


def combined(
    fits: Sequence[FrameFit],
    shifts: Array,
    radius_px: float,
    shift_sigma_px: float,
    *,
    method: str = "ml",
    psf: Psf | None = None,
    systematic_px: Array | None = None,
) -> Localization:
    """One place from the fits of frames at known shifts (N, 2), each by its own covariance.

    Raises InconsistentFramesError where they disagree with their shifts.
    """
    centres = np.array([fit.centre_px for fit in fits]) - shifts
    jitter = np.eye(2) * shift_sigma_px**2
    covariances = np.array([fit.covariance_px2 for fit in fits]) + jitter
    information = np.linalg.inv(covariances)
    covariance = np.linalg.inv(information.sum(axis=0))
    centre = covariance @ np.einsum("kij,kj->i", information, centres)
    residuals = centres - centre
    chi2_per_dof = fits[0].chi2_per_dof
    if len(fits) > 1:
        chi2_per_dof = _checked_consistency(residuals, covariances)
    return Localization(
        centre_px=centre,
        covariance_px2=covariance,
        radius_px=radius_px,
        amplitude=float(np.mean([fit.amplitude for fit in fits])),
        background=float(np.mean([fit.background for fit in fits])),
        snr=float(np.mean([fit.snr for fit in fits])),
        sigma=float(np.mean([fit.sigma for fit in fits])),
        chi2_per_dof=chi2_per_dof,
        n_frames=len(fits),
        method=method,
        residuals_px=residuals,
        psf=psf,
        systematic_px=systematic_px,
    )


def _checked_consistency(residuals: Array, covariances: Array) -> float:
    """chi2 per degree of freedom of the residuals; raises where chance does not explain them."""
    dof = residuals.size - 2
    exact = np.einsum("ki,kij,kj->k", residuals, np.linalg.inv(covariances), residuals)
    widened = np.linalg.inv(covariances + np.eye(2) * MODEL_FLOOR_PX**2)
    guarded = np.einsum("ki,kij,kj->k", residuals, widened, residuals)
    if not guarded.sum() < chdtri(dof, CONSISTENCY_P):
        worst = int(np.argmax(guarded))
        row, col = residuals[worst]
        raise InconsistentFramesError(
            f"the frames disagree with their shifts (chi2 {guarded.sum():.0f} for {dof} degrees "
            f"of freedom), worst in frame {worst}, by row {row:+.3f} col {col:+.3f} px"
        )
    return float(exact.sum() / dof)


def _refuse_outside_gate(
    centre_px: Array, start: tuple[float, float] | None, gate_px: float | None
) -> None:
    if gate_px is None:
        return
    if start is None:
        raise ParameterError("a gate needs a predicted position: give start_px")
    distance = float(np.hypot(centre_px[0] - start[0], centre_px[1] - start[1]))
    if not distance <= gate_px:
        raise OutsideGateError(
            f"object found {distance:.2f} px from its predicted position, allowed {gate_px:g} px"
        )
