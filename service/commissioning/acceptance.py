"""Findings against limits, and the keys that a room's file takes from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from scipy.special import chdtri

from service.commissioning.clocks import ClockFinding
from service.commissioning.imaging import ImagingFinding

_MOST_UNCERTAIN_S = 1.0
_LATEST_S = 120.0
_LEAST_SNR = 8.0
_MOST_CHI2 = 1.5
_MOST_SCATTER = 1.5  # of what a localization says of itself
_BY_CHANCE = 0.001
_OIL_SIGMA = 5.0


@dataclass(frozen=True)
class Item:
    """One line of the acceptance: passed None where there is no limit to pass."""

    what: str
    value: str
    limit: str
    passed: bool | None


def items_of(clock: ClockFinding, imaging: ImagingFinding) -> list[Item]:
    """Every finding with its limit, in the order of the report."""
    promptness = clock.promptness
    return [
        Item(
            "Clock: ours minus the scanner's",
            f"{clock.offset_s:+.2f} ± {clock.uncertainty_s:.2f} s",
            f"known within {_MOST_UNCERTAIN_S:g} s",
            clock.uncertainty_s <= _MOST_UNCERTAIN_S,
        ),
        Item(
            "Acquisition times against the key presses at start and end",
            "agree" if not clock.untruthful_s else f"disagree by {clock.untruthful_s:.2f} s",
            "agree within a person's reaction time",
            not clock.untruthful_s,
        ),
        Item(
            "Delay of a slice after its acquisition",
            f"{promptness.least_s:.2f} to {promptness.most_s:.2f} s",
            f"within {_LATEST_S:g} s",
            promptness.most_s <= _LATEST_S,
        ),
        *(
            Item(
                f"Protocol {protocol}: delays of {len(delays)} slices",
                f"{min(delays):.2f} / {sorted(delays)[len(delays) // 2]:.2f} / {max(delays):.2f} s",
                "min / median / max",
                None,
            )
            for protocol, delays in clock.delays_s.items()
        ),
        *_imaging_items(imaging),
    ]


def _imaging_items(found: ImagingFinding) -> list[Item]:
    psf = "not certain" if found.psf is None else _psf_words(found)
    corrected = {True: "corrected", False: "not corrected", None: "not in the header"}
    return [
        Item(
            "Point spread",
            f"{psf} ({found.agreement:.0%} of the slices)",
            "one",
            found.psf is not None,
        ),
        Item(
            "Signal to noise",
            f"{found.snr:.1f}",
            f"at least {_LEAST_SNR:g}",
            found.snr >= _LEAST_SNR,
        ),
        Item("Noise", f"{found.noise:.3g} stored units", "", None),
        Item(
            "Fiducial's radius", f"{found.radius_mm:.2f} ± {found.radius_sd_mm:.2f} mm", "", None
        ),
        Item(
            "Chi squared per degree of freedom of its model",
            f"{found.chi2_per_dof:.2f}",
            f"at most {_MOST_CHI2:g}",
            found.chi2_per_dof <= _MOST_CHI2,
        ),
        Item(
            "Scatter of the centre against the reported σ",
            f"{found.scatter_px:.4f} px ({found.scatter_dof} degrees of freedom), "
            f"{found.sigma_px:.4f} px",
            f"at most {_MOST_SCATTER:g} of it, beyond chance ({_BY_CHANCE:.1%})",
            found.scatter_px <= _MOST_SCATTER * found.sigma_px * _chance(found.scatter_dof),
        ),
        Item(
            "Pixel size from the header", "{:g} x {:g} mm".format(*found.spacing_mm), "square",
            math.isclose(*found.spacing_mm, rel_tol=1e-3),
        ),
        Item(
            "Chi squared per degree of freedom of the fiducial's own template",
            found.template_problem or f"{found.template_chi2:.2f}",
            f"at most {_MOST_CHI2:g}",
            None if found.template_problem else found.template_chi2 <= _MOST_CHI2,
        ),
        Item("Distortion", corrected[found.distortion_corrected], "", None),
        Item(
            "Oil shift along the readout",
            f"{found.oil_shift_px:+.3f} ± {found.oil_sigma_px:.3f} px, polarity {found.polarity}",
            f"{found.oil_expected_px:.3f} px from the header",
            bool(found.polarity) and _is_as_expected(found),
        ),
    ]  # fmt: skip


def _chance(dof: int) -> float:
    """By what factor a scatter of few values may be too large without being so."""
    return math.sqrt(float(chdtri(dof, _BY_CHANCE)) / dof)


def _psf_words(found: ImagingFinding) -> str:
    assert found.psf is not None
    numbers = ", ".join(f"{value:g}" for value in found.psf.parameters)
    acquired = " x ".join(f"{value:g}" for value in found.psf.acquired)
    return f"{found.psf.kind}({numbers}), {acquired} of k-space"


def _is_as_expected(found: ImagingFinding) -> bool:
    apart_px = abs(abs(found.oil_shift_px) - found.oil_expected_px)
    return apart_px <= max(0.1 * found.oil_expected_px, _OIL_SIGMA * found.oil_sigma_px)


def room_keys(clock: ClockFinding, imaging: ImagingFinding) -> dict[str, dict[str, Any]]:
    """Tables and keys for the room's file: only what was found, and passed."""
    listener: dict[str, Any] = {}
    if not clock.untruthful_s:
        listener = {
            # rounded outwards: a bound may only become wider
            "prompt_delay_s": math.ceil(100 * clock.promptness.most_s) / 100,
            "least_delay_s": math.floor(100 * clock.promptness.least_s) / 100,
            "clock_offset_s": round(clock.offset_s, 3),
            "clock_uncertainty_s": math.ceil(1000 * clock.uncertainty_s + 1) / 1000,
            "clock_compared_at": datetime.fromtimestamp(clock.at_s, UTC),
        }
    image: dict[str, Any] = {}
    if imaging.distortion_corrected is not None:
        image["distortion_corrected"] = imaging.distortion_corrected
    if imaging.polarity and _is_as_expected(imaging):
        image["readout_polarity"] = imaging.polarity
    tables = {"listener": listener, "imaging": image}
    if imaging.psf is not None:
        tables["imaging.point_spread"] = {
            "kind": imaging.psf.kind,
            "parameters": list(imaging.psf.parameters),
            "acquired": list(imaging.psf.acquired),
        }
    return {name: keys for name, keys in tables.items() if keys}


def as_toml(tables: dict[str, dict[str, Any]], evidence: str) -> str:
    """The text to be put into the room's file, with where it comes from above it."""
    lines = [f"# {evidence}"]
    for name, keys in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in keys.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
