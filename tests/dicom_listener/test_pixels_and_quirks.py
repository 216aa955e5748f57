"""Stored values to magnitudes, and what the vendors write in their own ways."""

from pathlib import Path

import numpy as np
import pytest
from made_slices import a_slice, mr_data_set
from pydicom import dcmread
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian
from real_slices import DICOM

from dicom_slice.eligibility import BY_HAND, SliceRules, why_not_usable
from dicom_slice.header import read_header, slices_of
from dicom_slice.pixels import check_pixels, magnitude_pixels
from dicom_slice.quirks import Kind
from dicom_slice.reasons import Reason, UnusableError

ROWS, COLS = np.indices((48, 40))
STORED = (ROWS * 40 + COLS).astype(np.uint16)


def written(folder: Path, **changes) -> Path:
    data_set = mr_data_set()
    for name, value in changes.items():
        setattr(data_set, name, value)
    path = folder / "slice.dcm"
    data_set.save_as(path)
    return path


def test_stored_values_are_rescaled(tmp_path):
    path = written(tmp_path, RescaleSlope="2.5", RescaleIntercept="-7")
    np.testing.assert_allclose(magnitude_pixels(path), STORED * 2.5 - 7)


def test_monochrome1_comes_out_as_bright_as_its_monochrome2_twin(tmp_path):
    inverted = ((2**12 - 1) - STORED).astype("<u2").tobytes()
    path = written(
        tmp_path, PhotometricInterpretation="MONOCHROME1", PixelData=inverted, RescaleSlope="2"
    )
    np.testing.assert_allclose(magnitude_pixels(path), STORED * 2.0)


def test_signed_pixels_keep_their_sign_and_monochrome1_mirrors_them(tmp_path):
    signed = (STORED.astype(np.int16) - 900).astype("<i2")
    path = written(tmp_path, PixelRepresentation=1, PixelData=signed.tobytes())
    np.testing.assert_allclose(magnitude_pixels(path), signed)
    mirrored = (-1 - signed).astype("<i2").tobytes()
    path = written(
        tmp_path,
        PixelRepresentation=1,
        PixelData=mirrored,
        PhotometricInterpretation="MONOCHROME1",
    )
    np.testing.assert_allclose(magnitude_pixels(path), signed)


def test_padding_becomes_zero_and_never_a_value(tmp_path):
    padded = STORED.copy()
    padded[:5] = 4000
    path = written(
        tmp_path, PixelData=padded.astype("<u2").tobytes(), PixelPaddingValue=4000, RescaleSlope="3"
    )
    pixels = magnitude_pixels(path)
    assert (pixels[:5] == 0).all()
    np.testing.assert_allclose(pixels[5:], STORED[5:] * 3.0)


def test_a_real_slice_deflated_or_inverted_gives_the_same_pixels(tmp_path):
    source = DICOM / "hazen/nist_T2_site3_ge_plate4/Z815"
    wanted = magnitude_pixels(source)
    data_set = dcmread(source)
    data_set.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    data_set.save_as(tmp_path / "deflated.dcm")
    np.testing.assert_array_equal(magnitude_pixels(tmp_path / "deflated.dcm"), wanted)
    data_set.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data_set.PhotometricInterpretation = "MONOCHROME1"
    data_set.PixelData = (-1 - data_set.pixel_array).astype("<i2").tobytes()
    data_set.save_as(tmp_path / "inverted.dcm")
    np.testing.assert_array_equal(magnitude_pixels(tmp_path / "inverted.dcm"), wanted)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"PixelData": STORED.tobytes()[:-2]}, Reason.UNDECODABLE),
        ({"PixelData": b""}, Reason.UNDECODABLE),
        ({"SamplesPerPixel": 3}, Reason.COLOUR),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, Reason.COLOUR),
        ({"Rows": 50_000, "Columns": 50_000}, Reason.TOO_LARGE),
        ({"PixelData": bytes(48 * 40 * 2)}, Reason.BLANK),
        ({"RescaleSlope": "1e300", "RescaleIntercept": "1e300"}, None),
    ],
)
def test_pixels_that_are_not_what_the_header_says_have_a_reason(tmp_path, changes, code):
    path = written(tmp_path, **changes)
    try:
        slices = read_header(path)
        problems = check_pixels(path, slices)
        found = problems[0].reason.code if problems else None
    except UnusableError as error:
        found = error.reason.code
    assert found == code


def test_a_slope_that_makes_pixels_infinite_is_refused(tmp_path):
    path = written(tmp_path, RescaleSlope="1e308", RescaleIntercept="1e308")
    with pytest.raises(UnusableError, match="finite"):
        magnitude_pixels(path)


def test_a_frame_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UnusableError, match="no frame 1; the file has 1"):
        magnitude_pixels(written(tmp_path), 1)


@pytest.mark.parametrize(
    ("content", "text"),
    [(b"", "empty file"), (b"\x1f\x8b\x08" + bytes(200), "gzip"), (b"hello" * 100, "not DICOM")],
)
def test_what_is_not_dicom_is_called_so_in_one_line(tmp_path, content, text):
    path = tmp_path / "thing"
    path.write_bytes(content)
    with pytest.raises(UnusableError, match=text) as caught:
        read_header(path)
    assert caught.value.reason.code == Reason.NOT_DICOM
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"kind": Kind.PHASE}, Reason.PHASE),
        ({"kind": Kind.REAL}, Reason.REAL),
        ({"kind": Kind.IMAGINARY}, Reason.IMAGINARY),
        ({"kind": Kind.OTHER}, Reason.NOT_MAGNITUDE),
        ({"is_mosaic": True}, Reason.MOSAIC),
        ({"is_localizer": True}, Reason.LOCALIZER),
        ({"image_type": ("DERIVED", "SECONDARY")}, Reason.DERIVED),
        ({"image_type": ("ORIGINAL", "PRIMARY", "SCREEN SAVE")}, Reason.SCREEN_SAVE),
        ({"geometry": None, "geometry_problem": "no PixelSpacing"}, Reason.NO_GEOMETRY),
        ({"geometry": None, "geometry_problem": "off by 0.3"}, Reason.BAD_GEOMETRY),
        ({"samples_per_pixel": 3}, Reason.COLOUR),
        ({"photometric": "PALETTE COLOR"}, Reason.COLOUR),
        ({"has_pixels": False}, Reason.NO_PIXELS),
    ],
)
def test_each_kind_that_is_not_wanted_has_its_name(changes, code):
    assert why_not_usable(a_slice(**changes), SliceRules()).code == code


def test_files_named_by_hand_may_be_real_derived_or_without_geometry():
    allowed = a_slice(kind=Kind.REAL, image_type=("DERIVED",), geometry=None)
    assert why_not_usable(allowed, BY_HAND) is None
    assert why_not_usable(a_slice(kind=Kind.PHASE), BY_HAND).code == Reason.PHASE


@pytest.mark.parametrize(
    ("image_type", "kind"),
    [
        ("ORIGINAL\\PRIMARY\\M_FFE\\M\\FFE", Kind.MAGNITUDE),
        ("ORIGINAL\\PRIMARY\\P\\ND", Kind.PHASE),
        ("ORIGINAL\\PRIMARY\\PHASE MAP\\P\\FFE", Kind.PHASE),
        ("ORIGINAL\\PRIMARY\\R_SE\\R\\SE", Kind.REAL),
        ("ORIGINAL\\PRIMARY\\I_FFE\\I\\FFE", Kind.IMAGINARY),
        ("ORIGINAL\\PRIMARY\\B0 MAP\\B0\\UNSPECIFIED", Kind.OTHER),
        ("ORIGINAL\\PRIMARY\\M\\NORM\\DIS2D", Kind.MAGNITUDE),
    ],
)
def test_the_image_type_tells_what_the_pixels_are(image_type, kind):
    data_set = mr_data_set()
    data_set.ImageType = image_type.split("\\")
    assert slices_of(data_set)[0].kind is kind


@pytest.mark.parametrize(("value", "kind"), [(0, "magnitude"), (1, "phase"), (2, "real")])
def test_ge_tells_the_kind_in_an_element_of_its_own(value, kind):
    data_set = mr_data_set()
    data_set.Manufacturer = "GE MEDICAL SYSTEMS"
    data_set.ImageType = ["ORIGINAL", "PRIMARY", "OTHER"]
    data_set.add_new((0x0043, 0x0010), "LO", "GEMS_PARM_01")
    data_set.add_new((0x0043, 0x102F), "SS", value)
    assert slices_of(data_set)[0].kind == kind


def test_a_siemens_mosaic_is_known_by_its_private_count_too():
    data_set = mr_data_set()
    data_set.add_new((0x0019, 0x0010), "LO", "SIEMENS MR HEADER")
    data_set.add_new((0x0019, 0x100A), "US", 36)
    assert slices_of(data_set)[0].is_mosaic


def test_no_patient_reaches_the_slice():
    assert "Doe" not in repr(slices_of(mr_data_set())[0])
    assert "4711" not in repr(slices_of(mr_data_set())[0])
