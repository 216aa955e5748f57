"""Which clock is which: sources, intervals, zones, midnight, and how far two clocks are apart."""

import io
import warnings
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st
from listener_room import a_slice, mr_data_set
from pydicom import dcmread
from pydicom.config import disable_value_validation
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

from dicom_listener.clock import ClockRules, Drift, ScannerClock, Sync, observe
from dicom_listener.scanner_clocks import ScannerClocks
from dicom_slice.elements import Elements, frame_elements
from dicom_slice.header import slices_of
from dicom_slice.times import (
    AcquisitionInterval,
    ImplausibleTimeError,
    TimeFrame,
    acquisition_interval,
)

BERLIN = ZoneInfo("Europe/Berlin")


def at(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def header(**elements) -> Dataset:
    data_set = Dataset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nonsense is wanted here
        for name, value in elements.items():
            setattr(data_set, name, value)
    return data_set


def frame_times(**elements) -> Dataset:
    """An enhanced header whose only frame has these in its FrameContentSequence."""
    frame = header(FrameContentSequence=Sequence([header(**elements)]))
    return header(PerFrameFunctionalGroupsSequence=Sequence([frame]))


def interval_of(data_set: Dataset, received: str | None = None, zone=BERLIN):
    top = Elements(data_set)
    received_s = None if received is None else at(received)
    return acquisition_interval(frame_elements(top, 0), TimeFrame(zone, received_s))


def test_the_sources_come_in_their_order():
    data_set = frame_times(
        FrameReferenceDateTime="20240110120010",
        FrameAcquisitionDateTime="20240110120008",
        FrameAcquisitionDuration=4000.0,
    )
    data_set.AcquisitionDateTime = "20240110115900"
    data_set.AcquisitionDate, data_set.AcquisitionTime = "20240110", "115800"
    data_set.ContentDate, data_set.ContentTime = "20240110", "120030"
    item = data_set.PerFrameFunctionalGroupsSequence[0].FrameContentSequence[0]

    found = interval_of(data_set)
    assert found.source == "FrameReferenceDateTime"
    assert found.start_s == at("2024-01-10T12:00:08+01:00")
    assert found.end_s == at("2024-01-10T12:00:12+01:00")
    del item.FrameReferenceDateTime
    assert interval_of(data_set).source == "FrameAcquisitionDateTime"
    del item.FrameAcquisitionDateTime
    assert interval_of(data_set).source == "AcquisitionDateTime"
    assert interval_of(data_set).end_s - interval_of(data_set).start_s == 4.0
    del data_set.AcquisitionDateTime
    found = interval_of(data_set)
    assert found.source == "AcquisitionDate+AcquisitionTime"
    assert found.start_s == at("2024-01-10T11:58:00+01:00")
    del data_set.AcquisitionTime
    assert interval_of(data_set) is None  # content time is never a source


def test_a_reference_instant_alone_lies_anywhere_in_its_acquisition():
    found = interval_of(
        frame_times(FrameReferenceDateTime="20240110120010", FrameAcquisitionDuration=4000.0)
    )
    middle_s = at("2024-01-10T12:00:10+01:00")
    assert (found.start_s, found.end_s) == (middle_s - 4, middle_s + 4)


def test_a_reference_far_from_its_acquisition_makes_the_interval_cover_both():
    found = interval_of(
        frame_times(
            FrameReferenceDateTime="20240110120010",
            FrameAcquisitionDateTime="20240110130000",
            FrameAcquisitionDuration=1000.0,
        )
    )
    assert found.start_s == at("2024-01-10T12:00:10+01:00")
    assert found.end_s == at("2024-01-10T13:00:01+01:00")


def test_a_duration_is_taken_from_the_header_or_estimated_and_marked_so():
    base = {"AcquisitionDateTime": "20240110120000"}
    assert not interval_of(header(**base, AcquisitionDuration=2.5)).estimated
    timing = {"RepetitionTime": "500", "NumberOfPhaseEncodingSteps": "128", "NumberOfAverages": "2"}
    found = interval_of(header(**base, **timing))
    assert found.estimated
    assert found.end_s - found.start_s == pytest.approx(0.5 * 128 * 2)
    matrix = header(**base, RepetitionTime="500", AcquisitionMatrix=[0, 256, 192, 0])
    found = interval_of(matrix)
    assert found.end_s - found.start_s == pytest.approx(0.5 * 192)
    assert interval_of(header(**base)).end_s is None
    assert interval_of(header(**base, **timing, MRAcquisitionType="3D")).end_s is None


def test_ge_writes_the_duration_in_an_element_of_its_own():
    data_set = header(AcquisitionDateTime="20240110120000")
    data_set.add_new((0x0019, 0x0010), "LO", "GEMS_ACQU_01")
    data_set.add_new((0x0019, 0x105A), "FL", 2.5e6)
    found = interval_of(data_set)
    assert (found.end_s - found.start_s, found.estimated) == (2.5, False)


def test_an_acquisition_over_midnight_ends_on_the_next_day():
    found = interval_of(
        header(AcquisitionDate="20240110", AcquisitionTime="235959.5", AcquisitionDuration=2.0)
    )
    assert found.end_s == at("2024-01-11T00:00:01.500+01:00")


@pytest.mark.parametrize(
    ("time", "received", "meant"),
    [
        ("235950", "2024-01-11T00:00:05+01:00", "2024-01-10T23:59:50+01:00"),
        ("120000", "2024-01-10T12:00:09+01:00", "2024-01-10T12:00:00+01:00"),
        ("000003", "2024-01-10T23:59:59+01:00", "2024-01-11T00:00:03+01:00"),
    ],
)
def test_a_time_without_a_date_is_of_the_day_of_its_receipt(time, received, meant):
    assert interval_of(header(AcquisitionTime=time), received).start_s == at(meant)


def test_a_time_without_date_and_receipt_cannot_be_read():
    with pytest.raises(ImplausibleTimeError, match="without AcquisitionDate"):
        interval_of(header(AcquisitionTime="120000"))


def test_the_hour_that_occurs_twice_in_autumn_is_told_by_the_receipt():
    data_set = header(AcquisitionDateTime="20241027023000")
    first = interval_of(data_set, "2024-10-27T02:30:20+02:00")
    second = interval_of(data_set, "2024-10-27T02:30:20+01:00")
    assert first.start_s == at("2024-10-27T02:30:00+02:00")
    assert second.start_s == at("2024-10-27T02:30:00+01:00")
    with pytest.raises(ImplausibleTimeError, match="occurs twice"):
        interval_of(data_set)


def test_a_local_time_that_does_not_exist_is_refused():
    with pytest.raises(ImplausibleTimeError, match="does not exist"):
        interval_of(header(AcquisitionDateTime="20240331023000"), "2024-03-31T03:30:00+02:00")


def test_an_offset_in_the_header_wins_over_the_zone_of_the_room():
    meant_s = at("2024-10-27T02:30:00-04:00")
    with_suffix = header(AcquisitionDateTime="20241027023000.000000-0400")
    assert interval_of(with_suffix).start_s == meant_s
    with_element = header(
        AcquisitionDate="20241027", AcquisitionTime="023000", TimezoneOffsetFromUTC="-0400"
    )
    assert interval_of(with_element).start_s == meant_s


@pytest.mark.parametrize(
    "data_set",
    [
        header(AcquisitionDateTime="00010101010101.000000+0000"),
        header(AcquisitionDate="00010101", AcquisitionTime="000000.00"),
        header(AcquisitionDateTime="2024"),
        header(AcquisitionDate="20240110", AcquisitionTime="253000"),
    ],
)
def test_a_nonsense_time_is_no_time(data_set):
    with pytest.raises(ImplausibleTimeError):
        interval_of(data_set)


@given(st.datetimes(datetime(1995, 1, 1), datetime(2060, 1, 1), timezones=st.just(UTC)))
def test_what_is_written_in_utc_is_read_back_to_the_microsecond(moment):
    data_set = header(AcquisitionDateTime=moment.strftime("%Y%m%d%H%M%S.%f+0000"))
    assert interval_of(data_set).start_s == pytest.approx(moment.timestamp(), abs=2e-6)


def test_odd_values_are_read_with_a_warning_that_stays_with_the_slice():
    file = io.BytesIO()
    with disable_value_validation():
        data_set = mr_data_set()
        data_set.add(DataElement("SliceThickness", "DS", "3.00000000000000001"))
        data_set.add(DataElement("InstanceNumber", "LO", "7.0"))
        data_set["InstanceNumber"].VR = "IS"
        data_set.add(DataElement("SeriesInstanceUID", "UI", "1.2.826.0.01.3"))
        data_set.add(DataElement("EchoTime", "LO", "ten"))
        data_set["EchoTime"].VR = "DS"
        data_set.save_as(file)
    file.seek(0)
    (slice_,) = slices_of(dcmread(file))
    assert slice_.slice_thickness_mm == 3.0
    assert slice_.instance_number == 7
    assert slice_.series_instance_uid == "1.2.826.0.01.3"
    assert slice_.echo_time_ms is None
    assert any("EchoTime" in text for text in slice_.warnings)
    assert any("UI" in text for text in slice_.warnings)


# Clocks

RULES = ClockRules(prompt_delay_s=3.0, late_limit_s=120.0, jump_tolerance_s=0.5)


def acquired(start_s: float, length_s: float | None = 2.0, estimated: bool = False):
    end_s = None if length_s is None else start_s + length_s
    return AcquisitionInterval(start_s, end_s, "AcquisitionDateTime", estimated)


def after(clock: ScannerClock, *received: tuple[AcquisitionInterval, float]) -> ScannerClock:
    for interval, received_s in received:
        clock = observe(clock, interval, received_s, RULES).clock
    return clock


@given(
    offset_s=st.floats(-500, 500),
    delays_s=st.lists(st.floats(0, 60), min_size=1, max_size=20),
    prompt_at=st.integers(0, 19),
)
def test_the_bounds_hold_the_true_offset_once_one_slice_was_prompt(offset_s, delays_s, prompt_at):
    delays_s[prompt_at % len(delays_s)] = 1.0
    clock = ScannerClock()
    for number, delay_s in enumerate(delays_s):
        interval = acquired(1e6 + 10 * number)
        clock = after(clock, (interval, interval.end_s + offset_s + delay_s))
    bounds = clock.bounds_for(interval, interval.end_s + offset_s + delays_s[-1], RULES)
    assert bounds.low_s - 1e-6 <= offset_s <= bounds.high_s + 1e-6
    assert bounds.high_s - bounds.low_s <= RULES.prompt_delay_s + 1e-6


def test_a_clock_set_forward_is_an_alarm_and_everything_known_is_dropped():
    clock = after(ScannerClock(), (acquired(1000.0), 1003.0))
    seen = observe(clock, acquired(1100.0 + 60.0), 1103.0, RULES)
    assert "ahead" in seen.jump
    bounds = seen.clock.bounds_for(acquired(1160.0), 1103.0, RULES)
    assert bounds.high_s == pytest.approx(-59.0)


def test_a_clock_set_back_is_an_alarm_once_it_seems_too_late():
    clock = after(ScannerClock(), (acquired(1000.0), 1003.0))
    assert not observe(clock, acquired(1000.0), 1100.0, RULES).late
    assert "set back" in observe(clock, acquired(1000.0), 1200.0, RULES).late


def test_a_clock_that_is_off_by_more_than_any_clock_is_not_believed():
    old_slice = acquired(1000.0)
    clock = after(ScannerClock(), (old_slice, 90_000.0))
    assert clock.bounds_for(old_slice, 90_000.0, RULES) is None


def test_a_sync_bounds_the_offset_before_any_slice_and_widens_with_age():
    clock = ScannerClock(sync=Sync(40.0, 0.1, 0.0))
    interval = acquired(960.0, 2.0)
    bounds = clock.bounds_for(interval, 1002.5, RULES)
    assert bounds.high_s == pytest.approx(40.1 + 1002.5 * 50e-6)
    assert bounds.low_s <= 39.9


def test_a_slice_without_a_duration_bounds_the_offset_by_the_longest_acquisition():
    interval = acquired(1000.0, None)
    clock = after(ScannerClock(), (interval, 1005.0))
    bounds = clock.bounds_for(interval, 1005.0, RULES)
    assert bounds.high_s == pytest.approx(5.0)
    assert bounds.low_s == pytest.approx(5.0 - RULES.longest_acquisition_s - RULES.prompt_delay_s)


def kinds_of_a_session(drift_per_slice_s: float, n_slices: int = 60) -> list[str]:
    """Alarms over a session of a slice every 10 s whose clock creeps; delays vary by 0.4 s."""
    clocks, kinds = ScannerClocks(ClockRules(), None), []
    for number in range(n_slices):
        end_s = 1000.0 + 10.0 * number
        by_scanner_s = end_s - drift_per_slice_s * number
        interval = AcquisitionInterval(by_scanner_s - 2.0, by_scanner_s, "AcquisitionDateTime")
        received_s = end_s + 0.5 + 0.1 * (number % 5)
        alarms = clocks.observe(a_slice(interval=interval), received_s)
        kinds += [kind for kind, _ in alarms]
    return kinds


@pytest.mark.parametrize("drift_per_slice_s", [0.04, -0.04])
def test_a_clock_that_creeps_is_one_alarm(drift_per_slice_s):
    assert kinds_of_a_session(drift_per_slice_s) == ["clock_drift"]


@pytest.mark.parametrize("drift_per_slice_s", [0.0, 0.0005, -0.0005])  # 50 ppm is what clocks do
def test_a_clock_as_good_as_clocks_are_is_no_alarm(drift_per_slice_s):
    assert kinds_of_a_session(drift_per_slice_s) == []


def test_only_certain_ends_count_for_a_drift():
    drift = Drift()
    for number in range(20):
        drift = drift.with_slice(acquired(1000.0 + number), 1003.0 + 2 * number)
    assert drift.moved_s == pytest.approx(10.0)
    assert drift.with_slice(acquired(1000.0, None), 2000.0) == drift  # an end that is not certain
