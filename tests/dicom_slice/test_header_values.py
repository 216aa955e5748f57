"""Values of real headers: read where they can only mean one thing, else named with their tag."""

import warnings
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydicom.config import disable_value_validation
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset

from dicom_slice.elements import Elements, frame_elements, plain_numbers
from dicom_slice.header import Slice, slices_of
from dicom_slice.times import ImplausibleTimeError, TimeFrame, acquisition_interval

BERLIN = ZoneInfo("Europe/Berlin")


def header(**values) -> Dataset:
    """A coronal MR image without pixels; a value (VR, text) is put there as it is."""
    data_set = Dataset()
    plain = {
        "SOPClassUID": "1.2.840.10008.5.1.4.1.1.4",
        "Modality": "MR",
        "ImageType": ["ORIGINAL", "PRIMARY", "M"],
        "Rows": 64,
        "Columns": 48,
        "BitsAllocated": 16,
        "ImagePositionPatient": [-20, 10, 30],
        "ImageOrientationPatient": [1, 0, 0, 0, 0, -1],
        "PixelSpacing": [1.5, 1.5],
        **values,
    }
    with disable_value_validation():
        for name, value in plain.items():
            if isinstance(value, tuple):
                vr, text = value
                data_set.add(
                    DataElement(name, "LO" if vr in ("DS", "DT", "TM", "SH") else vr, text)
                )
                data_set[name].VR = vr
            elif value is not None:
                setattr(data_set, name, value)
    return data_set


def read(times: TimeFrame | None = None, **values) -> Slice:
    with warnings.catch_warnings(), disable_value_validation():
        warnings.simplefilter("ignore")
        return slices_of(header(**values), times or TimeFrame())[0]


@pytest.mark.parametrize(
    "spacing",
    [("UT", "1.5000\\1.5000"), ("LO", ["1.5000", "1.5000"]), ("DS", ["1,500", "1,500"]),
     ("DS", "1.500,1.500"), ("DS", ["1.5 ", " 15e-1"])],
)  # fmt: skip
def test_pixel_spacing_is_read_where_it_can_only_mean_one_thing(spacing):
    geometry = read(PixelSpacing=spacing).geometry
    assert geometry is not None
    assert geometry.spacing_mm == (1.5, 1.5)


@pytest.mark.parametrize(
    ("spacing", "problem"),
    [
        (("DS", "1.500"), "PixelSpacing (0028,0030) should be 2 numbers, is '1.500'"),
        (("DS", "1,500"), "PixelSpacing (0028,0030) should be 2 numbers, is '1,500'"),
        (("LO", "about 1"), "PixelSpacing (0028,0030) should be 2 numbers, is 'about 1'"),
        (None, "no PixelSpacing"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_tag_and_value(spacing, problem):
    assert read(PixelSpacing=spacing).geometry_problem == problem


@given(st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=6), st.booleans())
def test_numbers_are_the_same_however_they_are_written(numbers, comma):
    texts = [f"{number:.4f}" for number in numbers]
    shown = [text.replace(".", ",") if comma else text for text in texts]
    assert plain_numbers("\\".join(shown)) == plain_numbers(shown) == tuple(map(float, texts))


def test_a_rescale_slope_with_a_decimal_comma_is_not_taken_for_one():
    assert read(RescaleSlope=("DS", "2,5")).rescale.slope == 2.5


def test_rounded_direction_cosines_are_made_orthonormal_and_said_to_be_rounded():
    slice_ = read(ImageOrientationPatient=[0.99, 0.12, 0, 0, 0, -1])
    assert slice_.geometry is not None
    assert slice_.geometry.col_direction == pytest.approx((0.9927, 0.1203, 0.0), abs=1e-3)
    assert any("ImageOrientationPatient is rounded: 0.99" in text for text in slice_.warnings)
    assert read(ImageOrientationPatient=[1, 0, 0, 0, 0, -1]).warnings == ()


def test_directions_that_no_rounding_explains_are_refused_with_what_they_are():
    problem = read(ImageOrientationPatient=[0.990000, 0.300000, 0, 0, 0, -1]).geometry_problem
    assert "must be orthonormal" in problem
    assert "ImageOrientationPatient 0.99" in problem


# Durations

BEGAN = {"AcquisitionDateTime": "20261127120000.000000+0000"}
BEGAN_S = datetime(2026, 11, 27, 12, tzinfo=UTC).timestamp()


def duration_s(**values) -> float:
    interval = read(**BEGAN, **values).interval
    assert interval is not None
    assert interval.end_s is not None
    return interval.end_s - interval.start_s


SEQUENCE = {"RepetitionTime": 20, "NumberOfPhaseEncodingSteps": 100}  # 2 s


@pytest.mark.parametrize(
    ("values", "wanted_s"),
    [
        ({"AcquisitionDuration": 2.0}, 2.0),
        ({"AcquisitionDuration": 2000.0, "Manufacturer": "UIH"}, 2.0),
        ({"AcquisitionDuration": 2000.0, "Manufacturer": "UIH", **SEQUENCE}, 2.0),
        ({"AcquisitionDuration": 2.1, "Manufacturer": "UIH", **SEQUENCE}, 2.1),
        ({"AcquisitionDuration": 2100.0, "Manufacturer": "SIEMENS", **SEQUENCE}, 2.1),
        ({"AcquisitionDuration": 40.0, "Manufacturer": "SIEMENS", **SEQUENCE}, 40.0),
    ],
)
def test_a_duration_is_in_the_vendors_unit_and_checked_against_the_sequence(values, wanted_s):
    assert duration_s(**values) == pytest.approx(wanted_s)


# Instants


@pytest.mark.parametrize(
    "broken",
    [("DT", "***"), "00010101000000.000000", "20261127", "202611271300", ("DT", "2026-13-40T1:1")],
)
def test_a_bad_datetime_does_not_hide_a_good_date_and_time_and_is_named(broken):
    good = {"AcquisitionDate": "20261127", "AcquisitionTime": "130000.5"}
    slice_ = read(TimeFrame(BERLIN), AcquisitionDateTime=broken, **good)
    assert slice_.interval is not None
    assert slice_.interval.start_s == BEGAN_S + 0.5
    assert slice_.interval.source == "AcquisitionDate+AcquisitionTime"
    assert any(text.startswith("not used: AcquisitionDateTime: ") for text in slice_.warnings)


def test_where_no_instant_can_be_read_each_is_named():
    slice_ = read(AcquisitionDateTime=("DT", "***"), AcquisitionTime=("TM", "120000.-5"))
    assert slice_.interval is None
    assert "AcquisitionDateTime: '***'" in slice_.time_problem
    assert "AcquisitionDate, AcquisitionTime: " in slice_.time_problem


@pytest.mark.parametrize(
    "text",
    ["2026-11-27T13:00:00.25", "2026-11-27T12:00:00.25Z", "2026-11-27 14:00:00,25+02:00",
     "20261127130000,25", "20261127130000.250000"],
)  # fmt: skip
def test_a_datetime_is_read_in_every_plain_way_of_writing_it(text):
    interval = read(TimeFrame(BERLIN), AcquisitionDateTime=("DT", text)).interval
    assert interval is not None
    assert interval.start_s == BEGAN_S + 0.25


def instant_s(received_s: float, **values) -> float:
    with warnings.catch_warnings(), disable_value_validation():
        warnings.simplefilter("ignore")
        frame = frame_elements(Elements(header(**values)), 0)
        interval = acquisition_interval(frame, TimeFrame(BERLIN, received_s))
    assert interval is not None
    return interval.start_s


def test_an_offset_without_a_sign_is_read_only_if_the_scanners_zone_has_it():
    at = {"AcquisitionDate": "20261127", "AcquisitionTime": "130000"}
    assert instant_s(BEGAN_S, **at, TimezoneOffsetFromUTC=("SH", "0100")) == BEGAN_S
    with pytest.raises(ImplausibleTimeError, match=r"\(0008,0201\): '0500' has no sign"):
        instant_s(BEGAN_S, **at, TimezoneOffsetFromUTC=("SH", "0500"))
    with pytest.raises(ImplausibleTimeError, match="is not an offset from UTC"):
        instant_s(BEGAN_S, **at, TimezoneOffsetFromUTC=("SH", "CET"))


@pytest.mark.parametrize("day", [28, 30])
def test_a_day_on_which_the_time_does_not_exist_takes_nothing_from_those_beside_it(day):
    """Clocks go from 02:00 to 03:00 on 29 March 2026; 02:30 exists the day before and after."""
    received_s = datetime(2026, 3, day, 2, 35, tzinfo=BERLIN).timestamp()
    assert instant_s(received_s, AcquisitionTime="023000") == received_s - 300
