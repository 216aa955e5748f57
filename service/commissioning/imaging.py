"""What the slices of a phantom with the fiducial say: point spread, noise, size, oil and water."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dicom_listener.slice_rows import header_for_record
from room_config.imaging import ImagingConfig
from service.commissioning.evidence import CommissioningError, Reception, ScannedSeries
from service.procedure.targets import TargetError, oil_shift_mm
from sr_engine.errors import EngineError
from sr_engine.localization import Localization
from sr_engine.localize import localize
from sr_engine.psf import Psf
from sr_engine.recognise import psf_of_noise
from sr_engine.template import learn_template

LEAST_AGREEMENT = 0.6
_SURE_SIGMA = 5.0


@dataclass(frozen=True, eq=False)
class ImagingFinding:
    """Of the slices with the usual readout.

    psf None: the slices do not agree on one. agreement: share of them that say so. sigma_px: what
    one localization says of itself, scatter_px: what they scatter by, of scatter_dof degrees of
    freedom. distortion_corrected None:
    the header does not say. polarity 0: not known; oil_shift_px: half of what the oil moved by
    along the readout when its sign was changed, ± oil_sigma_px. template_chi2: of the fiducial's
    own image; nan: it was not learnt, for the template_problem.
    """

    psf: Psf | None
    agreement: float
    snr: float
    noise: float
    radius_mm: float
    radius_sd_mm: float
    chi2_per_dof: float
    sigma_px: float
    scatter_px: float
    scatter_dof: int
    spacing_mm: tuple[float, float]
    distortion_corrected: bool | None
    polarity: int
    oil_shift_px: float
    oil_sigma_px: float
    oil_expected_px: float
    template_chi2: float
    template_problem: str


def find_imaging(series: Sequence[ScannedSeries], imaging: ImagingConfig) -> ImagingFinding:
    """Judge the pixels. Raises CommissioningError where the fiducial is not seen."""
    usual = [r for s in series if not s.reversed_readout for r in s.receptions]
    changed = [r for s in series if s.reversed_readout for r in s.receptions]
    psf, agreement = _point_spread(usual)
    found = _fiducials(usual, imaging, psf)
    centres = np.array([one.centre_px for one in found])
    header = usual[0].header
    if header.geometry is None:
        raise CommissioningError(f"the slices have no geometry: {header.geometry_problem}")
    spacing_mm = header.geometry.spacing_mm
    radii_mm = np.array([one.radius_px for one in found]) * float(np.mean(spacing_mm))
    polarity, shift_px, shift_sigma_px, expected_px = _oil(usual, changed, found, imaging, psf)
    moved = (shift_px, shift_sigma_px) if polarity else None
    template_chi2, template_problem = _template(usual, changed, found, moved)
    return ImagingFinding(
        psf=psf,
        agreement=agreement,
        snr=float(np.median([one.snr for one in found])),
        noise=float(np.median([_signal(r, f) / f.snr for r, f in zip(usual, found, strict=True)])),
        radius_mm=float(radii_mm.mean()),
        radius_sd_mm=float(radii_mm.std(ddof=1)) if len(radii_mm) > 1 else float("nan"),
        chi2_per_dof=float(np.median([one.chi2_per_dof for one in found])),
        sigma_px=float(np.sqrt(np.mean([np.mean(np.diag(one.covariance_px2)) for one in found]))),
        scatter_px=float(np.sqrt(np.mean(centres.var(axis=0, ddof=1)))),
        scatter_dof=2 * (len(centres) - 1),
        spacing_mm=spacing_mm,
        distortion_corrected=header.distortion_corrected,
        polarity=polarity,
        oil_shift_px=shift_px,
        oil_sigma_px=shift_sigma_px,
        oil_expected_px=expected_px,
        template_chi2=template_chi2,
        template_problem=template_problem,
    )


def _point_spread(receptions: Sequence[Reception]) -> tuple[Psf | None, float]:
    """What most of the slices show in their noise, and how many of them."""
    votes = Counter(psf_of_noise(reception.pixels) for reception in receptions)
    psf, count = votes.most_common(1)[0]
    agreement = count / len(receptions)
    return (psf if agreement >= LEAST_AGREEMENT else None), agreement


def _fiducials(
    receptions: Sequence[Reception], imaging: ImagingConfig, psf: Psf | None
) -> list[Localization]:
    """In each slice by itself; where to look is found in their mean, for the phantom lies still."""
    geometry = receptions[0].header.geometry
    spacing_mm = 1.0 if geometry is None else float(np.mean(geometry.spacing_mm))
    radii = (
        imaging.fiducial_radius_min_mm / spacing_mm,
        imaging.fiducial_radius_max_mm / spacing_mm,
    )
    if len({reception.pixels.shape for reception in receptions}) > 1:
        raise CommissioningError("the slices differ in size: scan with one protocol")
    mean = np.mean([reception.pixels for reception in receptions], axis=0)
    try:
        start_px = _start(mean, imaging, radii)
        return [
            localize(reception.pixels, start_px=start_px, radius_px=radii, psf=psf)
            for reception in receptions
        ]
    except EngineError as error:
        raise CommissioningError(f"the fiducial was not found in the slices: {error}") from None


def _start(
    mean: NDArray[np.float64], imaging: ImagingConfig, radii: tuple[float, float]
) -> NDArray[np.float64]:
    """The one round object of the region in which the room looks for it."""
    r0, c0, r1, c1 = 0, 0, mean.shape[0] - 1, mean.shape[1] - 1
    if imaging.start_region_px is not None:
        r0, c0, r1, c1 = (round(value) for value in imaging.start_region_px)
    found = localize(mean[r0 : r1 + 1, c0 : c1 + 1], radius_px=radii)
    return np.asarray(found.centre_px) + np.array([r0, c0])


def _signal(reception: Reception, found: Localization) -> float:
    """What the slice shows in the middle of the fiducial, stored units."""
    row, col = np.rint(found.centre_px).astype(int).tolist()
    return float(reception.pixels[row, col])


def _oil(
    usual: Sequence[Reception],
    changed: Sequence[Reception],
    found: Sequence[Localization],
    imaging: ImagingConfig,
    psf: Psf | None,
) -> tuple[int, float, float, float]:
    """(polarity, shift, its sigma, what the header lets expect), px along the readout."""
    along, expected_px = _expected(usual[0])
    if not changed or along is None:
        return 0, float("nan"), float("nan"), expected_px
    others = _fiducials(changed, imaging, psf)
    moved = _mean(found) - _mean(others)
    shift_px = float(moved @ along) / 2
    sigma_px = float(np.hypot(_sigma(found, along), _sigma(others, along))) / 2
    if not abs(shift_px) > _SURE_SIGMA * sigma_px:
        return 0, shift_px, sigma_px, expected_px
    return (1 if shift_px > 0 else -1), shift_px, sigma_px, expected_px


def _template(
    usual: Sequence[Reception],
    changed: Sequence[Reception],
    found: Sequence[Localization],
    moved: tuple[float, float] | None,
) -> tuple[float, str]:
    """(chi squared per degree of freedom, why there is none) of the fiducial's own template.

    The oil is what moves when the readout's sign is changed, so that its image can be learnt as in
    a calibration; from half of the slices, and tried on the others.
    """
    along, _ = _expected(usual[0])
    if moved is None or along is None:
        return float("nan"), "it needs the series with the readout direction reversed"
    learnt = usual[: len(usual) // 2]
    shift_px, sigma_px = moved
    shifts_px = [0 * along] * len(learnt) + [-2 * shift_px * along] * len(changed)
    radius_px = float(np.median([one.radius_px for one in found]))
    try:
        template = learn_template(
            np.array([reception.pixels for reception in (*learnt, *changed)]),
            np.array(shifts_px),
            radius_px=(0.7 * radius_px, 1.4 * radius_px),
            centre_px=_mean(found),
            shift_sigma_px=2 * sigma_px,
        )
        fits = [template.fit(r.pixels, template.reference_px) for r in usual[len(learnt) :]]
    except EngineError as error:
        return float("nan"), str(error)
    return float(np.median([fit.chi2_per_dof for fit in fits])), ""


def _expected(reception: Reception) -> tuple[NDArray[np.float64] | None, float]:
    """(unit vector (row, col) of growing indices along the readout, shift in px)."""
    geometry = reception.header.geometry
    if geometry is None:
        return None, float("nan")
    try:
        shift_mm = oil_shift_mm(header_for_record(reception.header), geometry.spacing_mm, 1)
    except TargetError:
        return None, float("nan")
    shift_px = np.asarray(shift_mm, dtype=float) / np.asarray(geometry.spacing_mm)
    size_px = float(np.linalg.norm(shift_px))
    return (None, size_px) if not size_px > 0 else (shift_px / size_px, size_px)


def _mean(found: Sequence[Localization]) -> NDArray[np.float64]:
    return np.asarray(np.mean([one.centre_px for one in found], axis=0))


def _sigma(found: Sequence[Localization], along: NDArray[np.float64]) -> float:
    """Of the mean, from the scatter: whatever moves the centre from slice to slice is in it."""
    values = [float(one.centre_px @ along) for one in found]
    if len(values) < 2:
        return float(np.sqrt(along @ found[0].covariance_px2 @ along))
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))
