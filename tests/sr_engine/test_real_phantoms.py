"""Real phantom slices: the vials are found, and nothing round where nothing is."""

import numpy as np
import pydicom
import pytest
from real_slices import DICOM, manifest, needs_large_set

from sr_engine.detect import detect
from sr_engine.errors import EngineError
from sr_engine.locate import Located, locate_all

# pydicom warns of what vendors write
pytestmark = pytest.mark.filterwarnings("ignore")
VIAL_RADII_MM = (4.5, 12.0)


def _rows(part: str) -> list[dict[str, str]]:
    return [row for row in manifest() if part in row["path"]]


def _pixels(path: str) -> tuple[np.ndarray, float]:
    """Rescaled pixels of the first frame, and the spacing in mm."""
    data_set = pydicom.dcmread(DICOM / path, force=True)
    pixels = data_set.pixel_array.astype(float)
    pixels = pixels[0] if pixels.ndim == 3 else pixels
    slope = float(getattr(data_set, "RescaleSlope", 1) or 1)
    intercept = float(getattr(data_set, "RescaleIntercept", 0) or 0)
    return pixels * slope + intercept, float(getattr(data_set, "PixelSpacing", [1.0])[0])


def _noise_px(found: Located) -> float:
    return float(np.sqrt(np.diag(found.covariance_px2).max()))


def _series() -> list[str]:
    return sorted({row["rep_group"] for row in _rows("nist_") if row["rep_group"]})


@pytest.mark.parametrize("series", _series())
def test_the_fourteen_vials_and_three_posts_of_a_plate_are_seen(series: str) -> None:
    paths = sorted(row["path"] for row in _rows("nist_") if row["rep_group"] == series)
    seen, total = 0, 0
    for path in paths[:: max(1, len(paths) // 4)]:
        pixels, spacing = _pixels(path)
        if path.endswith("Z842"):
            continue  # at this inversion time the bath is dark: five vials have no contrast
        found = detect(pixels, (VIAL_RADII_MM[0] / spacing, VIAL_RADII_MM[1] / spacing))
        seen += min(len(found), 17)
        total += 17
        assert len(found) <= 17
    assert seen >= 0.95 * total


@needs_large_set
def test_every_vial_of_a_slice_is_located_with_its_wall() -> None:
    pixels, spacing = _pixels(
        sorted(row["path"] for row in _rows("nist_T2_site4_philips_plate4"))[0]
    )
    found = locate_all(pixels, (VIAL_RADII_MM[0] / spacing, VIAL_RADII_MM[1] / spacing))
    assert len(found) == 17
    vials = [f for f in found if 7.0 < f.radius_px * spacing < 8.6]
    assert len(vials) >= 14
    assert np.median([_noise_px(f) for f in found]) < 0.02
    # their walls and caps are not the same all round: that counts beside the noise
    assert np.median([np.max(f.systematic_px) for f in found]) < 0.15


NOTHING_ROUND = ("snr_philips_cor", "snr_ge_sag", "noise_only", "dicom2nifti/hdr", "prisma_phase")


@pytest.mark.parametrize("part", [part for part in NOTHING_ROUND if _rows(part)])
def test_a_file_without_a_round_object_yields_none(part: str) -> None:
    rows = [r for r in _rows(part) if r["subject"] in ("phantom", "pixels_scrambled")]
    assert rows
    for row in rows:
        pixels, _ = _pixels(row["path"])
        try:
            found = detect(pixels, (3.0, 0.48 * min(pixels.shape)))
        except EngineError:
            continue
        assert found == [], row["path"]


LARGE_PHANTOMS = ("snr_pairs/SNR_BODY", "ghosting_philips", "epi_rep17")


@pytest.mark.parametrize("part", [part for part in LARGE_PHANTOMS if _rows(part)])
def test_a_single_large_phantom_is_located(part: str) -> None:
    row = _rows(part)[0]
    pixels, _ = _pixels(row["path"])
    found = locate_all(pixels, (15.0, 0.48 * min(pixels.shape)))
    assert len(found) == 1
    assert _noise_px(found[0]) < 0.1
    assert np.max(found[0].systematic_px) < 0.5  # its outline is not the same on both sides
