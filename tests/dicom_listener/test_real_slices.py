"""Every file of the real data is used, or set aside for the reason that it deserves."""

import hashlib
from collections import defaultdict
from pathlib import Path

import numpy as np
import pydicom
import pytest
from real_slices import DICOM, IS_LARGE_SET, manifest, needs_large_set

from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.header import read_header
from dicom_slice.pixels import check_pixels, magnitude_pixels
from dicom_slice.quirks import Kind
from dicom_slice.read import dicom_files, read_frames
from dicom_slice.reasons import Reason, UnusableError

USED = "used"
ANY_ORIENTATION = SliceRules(coronal_tolerance_deg=None)

# Folder or file -> what happens to its frames when any orientation is wanted: one word, or the
# number of frames by outcome. The longest prefix of a path counts.
EXPECTED: dict[str, str | dict[str, int]] = {
    "hazen/": USED,
    "hazen/nist_T1_site2_20180925_plate5/": Reason.REAL,
    "hazen/nist_templates/Plate4_T1_signed": Reason.REAL,
    "hazen/snr_philips_cor/": Reason.REAL,
    "hazen/diffusion_epi/DIFFUSION_READ_ADC": Reason.DERIVED,
    "hazen/toshiba/": Reason.LOCALIZER,
    "hazen/localiser/": USED,  # nothing in the header says so but the orientation
    "hazen/localiser/ACR_PRELOCALISER.dcm": {USED: 3},
    "dcm_qa_xa30i/epi_rep17/": USED,
    "dcm_qa_xa30i/noise_only/": Reason.LOCALIZER,
    "dcm_qa_xa30i/scout_mpr/": Reason.LOCALIZER,
    "dcm_qa_xa30i/rgb_sc/": Reason.SCREEN_SAVE,
    "dcm_qa_frag/": USED,
    "dcm_qa_agfa/": {USED: 25},
    "dcm_qa_nih/": Reason.MOSAIC,
    "dcm_qa_fmap/prisma_mag": USED,
    "dcm_qa_fmap/prisma_phase": Reason.PHASE,
    "dcm_qa_enh/": {USED: 32, Reason.NOT_MAGNITUDE: 32},
    "dcm_qa_philips/": USED,
    "dcm_qa_ts/": Reason.MOSAIC,
    "dcm_qa_uih/": Reason.MOSAIC,
    "dcm_qa_canon_61/": USED,
    "dcm_qa_deident/": USED,
    "dcmstack/": USED,
    "heudiconv/": Reason.LOCALIZER,
    "pydicom/mr_small/": Reason.DERIVED,
    "pydicom/odd/MR_small_padded.dcm": Reason.DERIVED,
    "pydicom/odd/MR_truncated.dcm": Reason.DERIVED,
    "pydicom/odd/no_meta.dcm": Reason.NOT_DICOM,
    "pydicom/odd/meta_missing_tsyntax.dcm": Reason.NOT_DICOM,
    "pydicom/odd/badVR.dcm": Reason.NOT_MR,
    "pydicom/odd/CT_small.dcm": Reason.NOT_MR,
    "pydicom/odd/image_dfl.dcm": Reason.SCREEN_SAVE,
    "pydicom/odd/SC_rgb_small_odd.dcm": Reason.SCREEN_SAVE,
    "pydicom/odd/test-SR.dcm": Reason.NOT_MR,
    "pydicom/charset/": Reason.NOT_MR,
    "pydicom/mono1/": Reason.NOT_MR,
    "pydicom-data/emri/": {Reason.NO_GEOMETRY: 10},
    "dicom2nifti/": USED,
    "dicom2nifti/hdr/hyperfine_enh.dcm": {USED: 8},
}

CORONAL_SETS = (
    "hazen/nist_T2_site4_philips_plate5",
    "hazen/nist_T2_site4_philips_plate4",
    "hazen/nist_T2_site3_ge_plate4",
    "hazen/nist_T1_site3_ge_plate4",
)


def paths() -> list[str]:
    return [row["path"] for row in manifest()]


def is_mr_image(row: dict[str, str]) -> bool:
    return row["decode"] == "ok" and "MR Image" in row["sop_class"]


def expected_of(path: str) -> str | dict[str, int]:
    best = max((key for key in EXPECTED if path.startswith(key)), key=len)
    return EXPECTED[best]


def outcomes(path: Path, rules: SliceRules) -> dict[str, int]:
    try:
        slices = read_header(path)
        broken = check_pixels(path, slices)
    except UnusableError as error:
        return {str(error.reason.code): 1}
    found: dict[str, int] = defaultdict(int)
    for slice_ in slices:
        reason = why_not_usable(slice_, rules)
        if reason is None and slice_.frame in broken:
            reason = broken[slice_.frame].reason
        found[str(reason.code) if reason else USED] += 1
    return dict(found)


@pytest.mark.parametrize("path", paths())
def test_a_real_file_is_used_or_set_aside_for_its_own_reason(path):
    expected = expected_of(path)
    wanted = expected if isinstance(expected, dict) else {str(expected): 1}
    assert outcomes(DICOM / path, ANY_ORIENTATION) == {str(k): n for k, n in wanted.items()}


def test_where_coronal_slices_are_wanted_only_those_pass():
    for row in manifest():
        if expected_of(row["path"]) != USED:
            continue
        (slice_,) = read_header(DICOM / row["path"])
        reason = why_not_usable(slice_, SliceRules(coronal_tolerance_deg=10.0))
        assert (reason is None) == (row["orientation"] == "coronal"), row["path"]
        assert reason is None or reason.code == Reason.WRONG_ORIENTATION


@pytest.mark.parametrize("folder", [f for f in CORONAL_SETS if (DICOM / f).is_dir()])
def test_the_coronal_phantom_is_used_whole(folder):
    for path in sorted((DICOM / folder).iterdir()):
        assert outcomes(path, SliceRules()) == {USED: 1}


def test_one_image_in_many_encodings_gives_the_same_pixels():
    by_hash: dict[str, set[str]] = defaultdict(set)
    encodings: dict[str, set[str]] = defaultdict(set)
    for row in manifest():
        if not is_mr_image(row):
            continue
        pixels = magnitude_pixels(DICOM / row["path"], 0)
        by_hash[row["pixel_hash"]].add(hashlib.sha256(pixels.tobytes()).hexdigest())
        encodings[row["pixel_hash"]].add(row["transfer_syntax"])
    assert all(len(hashes) == 1 for hashes in by_hash.values())
    assert sum(len(names) > 3 for names in encodings.values()) >= (3 if IS_LARGE_SET else 1)


def test_every_decodable_file_gives_finite_pixels_of_the_size_in_its_header():
    for row in manifest():
        if not is_mr_image(row):
            continue
        pixels = magnitude_pixels(DICOM / row["path"], 0)
        assert pixels.dtype == np.float64
        assert pixels.shape == (int(row["rows"]), int(row["cols"]))
        assert np.isfinite(pixels).all()


def test_spacing_and_non_square_shape_are_those_of_the_header():
    slice_ = read_header(DICOM / "dicom2nifti/hdr/anisotropic.dcm")[0]
    row = next(row for row in manifest() if row["path"].endswith("anisotropic.dcm"))
    assert slice_.geometry is not None
    assert slice_.geometry.shape == (int(row["rows"]), int(row["cols"])) == (28, 64)
    between_rows, between_cols = map(float, row["spacing"].split("\\"))
    assert slice_.geometry.spacing_mm == pytest.approx((between_rows, between_cols))


def test_the_philips_scale_makes_echoes_with_different_slopes_comparable():
    echoes = sorted((DICOM / "hazen/nist_T1_site4_philips_plate5").iterdir())
    slopes = set()
    for path in echoes:
        data_set = pydicom.dcmread(path)
        stored = data_set.pixel_array.astype(float)
        rescale_slope, scale_slope = data_set.RescaleSlope, data_set[0x2005, 0x100E].value
        slopes.add(rescale_slope)
        physical = (stored * rescale_slope + data_set.RescaleIntercept) / rescale_slope
        np.testing.assert_allclose(magnitude_pixels(path), physical / scale_slope, rtol=1e-12)
    assert len(slopes) > 3


@needs_large_set
def test_frames_of_one_enhanced_object_are_told_apart():
    slices = read_header(DICOM / "dcm_qa_enh/philips_fmap/IM_0027_fMAP.dcm")
    assert len(slices) == 64
    assert sum(slice_.kind is Kind.MAGNITUDE for slice_ in slices) == 32
    positions = {slice_.geometry.position_mm for slice_ in slices if slice_.geometry}
    assert len(positions) == 32


@needs_large_set
def test_read_frames_gives_header_and_pixels_or_one_line_that_names_the_file():
    frames = read_frames(DICOM / "dcm_qa_agfa/siemens/011-0001.img")
    assert len(frames) == 25
    assert all(pixels.shape == slice_.shape for slice_, pixels in frames)
    for name in ("odd/test-SR.dcm", "odd/no_meta.dcm", "odd/MR_truncated.dcm"):
        with pytest.raises(UnusableError) as caught:
            read_frames(DICOM / "pydicom" / name)
        assert name.split("/")[1] in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_folder_is_its_files_in_the_order_of_their_names():
    folder = DICOM / "hazen/nist_T2_site3_ge_plate4"
    assert dicom_files([folder]) == sorted(folder.iterdir())
    with pytest.raises(UnusableError, match="no such file"):
        dicom_files([DICOM / "nowhere.dcm"])
