"""Which clock is which: sources, intervals, zones, midnight, and how far two clocks are apart."""

import io
import warnings
from dataclasses import replace
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_slices import a_slice, mr_data_set
from pydicom import dcmread
from pydicom.config import disable_value_validation
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

from dicom_listener.clock_offset import (
    ClockRules,
    Comparison,
    OffsetBounds,
    OffsetUnknown,
    Received,
    ScannerClock,
    observe,
)
from dicom_listener.promptness import Promptness, TooFewDelaysError, promptness_of
from dicom_listener.scanner_clocks import Drift, ScannerClocks
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
    assert found.start_s == at("2024-01-10T12:00:09+01:00")
    assert found.end_s == at("2024-01-10T13:00:01+01:00")


@pytest.mark.parametrize(
    "timing", [{}, {"RepetitionTime": "50", "NumberOfPhaseEncodingSteps": "64"}]
)
def test_a_reference_in_an_acquisition_of_uncertain_duration_is_no_start(timing):
    data_set = frame_times(FrameReferenceDateTime="20240110120010")
    for name, value in timing.items():
        setattr(data_set, name, value)
    with pytest.raises(ImplausibleTimeError, match="acquisition of unknown duration"):
        interval_of(data_set)
    data_set.AcquisitionDateTime = "20240110120020"  # no start of it, for it comes after
    with pytest.raises(ImplausibleTimeError, match="no start before it"):
        interval_of(data_set)
    data_set.AcquisitionDate, data_set.AcquisitionTime = "20240110", "120001"
    found = interval_of(data_set)
    assert found.source == "AcquisitionDate+AcquisitionTime"
    assert found.start_s == at("2024-01-10T12:00:01+01:00")
    data_set.AcquisitionDateTime = "20240110120000"
    found = interval_of(data_set)
    assert found.source == "AcquisitionDateTime"
    assert found.start_s == at("2024-01-10T12:00:00+01:00")
    assert found.end_s is None or found.end_s >= at("2024-01-10T12:00:10+01:00")


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

RULES = ClockRules(late_limit_s=120.0, jump_tolerance_s=0.5)
MEASURED = replace(RULES, promptness=Promptness(0.2, 3.0))


def acquired(start_s: float, length_s: float | None = 2.0, estimated: bool = False):
    end_s = None if length_s is None else start_s + length_s
    return AcquisitionInterval(start_s, end_s, "AcquisitionDateTime", estimated)


def after(clock: ScannerClock, *received: Received, rules: ClockRules = RULES) -> ScannerClock:
    for slice_ in received:
        clock = observe(clock, slice_, rules).clock
    return clock


def compared(offset_s: float, uncertainty_s: float = 0.1, at_s: float = 1000.0) -> ScannerClock:
    return ScannerClock().compared(Comparison(offset_s, uncertainty_s, at_s), RULES)


def test_slices_alone_never_say_how_far_the_clocks_are_apart():
    clock = after(ScannerClock(), *(Received(acquired(1000.0 + k), 1003.0 + k) for k in range(50)))
    unknown = clock.bounds_for(Received(acquired(1100.0), 1103.0), RULES)
    assert isinstance(unknown, OffsetUnknown)
    assert unknown.text.startswith("the clocks have not been compared: compare the clocks, or conf")


@given(
    offset_s=st.floats(-500, 500),
    error_s=st.floats(-0.1, 0.1),
    delays_s=st.lists(st.floats(0, 100), min_size=1, max_size=20),
)
def test_after_a_comparison_no_delay_of_any_slice_takes_the_offset_out_of_its_bounds(
    offset_s, error_s, delays_s
):
    clock = compared(offset_s + error_s)
    for number, delay_s in enumerate(delays_s):
        interval = acquired(1000.0 + 10 * number - offset_s)
        slice_ = Received(interval, interval.end_s + offset_s + delay_s)
        clock = after(clock, slice_)
        if clock.suspicion:
            return  # one that came much sooner than all the others: nothing is assigned
        bounds = clock.bounds_for(slice_, RULES)
        assert bounds.low_s - 1e-6 <= offset_s <= bounds.high_s + 1e-6


@given(
    offset_s=st.floats(-500, 500),
    delays_s=st.lists(st.floats(0.2, 3.0), min_size=5, max_size=20),
)
def test_where_promptness_was_measured_slices_that_agree_bound_the_offset(offset_s, delays_s):
    clock = ScannerClock()
    for number, delay_s in enumerate(delays_s):
        interval = acquired(1e6 + 10 * number)
        slice_ = Received(interval, interval.end_s + offset_s + delay_s)
        clock = after(clock, slice_, rules=MEASURED)
    bounds = clock.bounds_for(slice_, MEASURED)
    if isinstance(bounds, OffsetUnknown):  # only where one broke with a habit of the others
        assert clock.suspicion
    else:
        assert bounds.low_s - 1e-6 <= offset_s <= bounds.high_s + 1e-6
        assert bounds.high_s - bounds.low_s <= 3.0 + 1e-6


def test_slices_that_were_held_up_do_not_agree_and_are_not_believed():
    clock = ScannerClock()
    for number, delay_s in enumerate((60.0, 20.0, 90.0, 45.0, 33.0, 71.0)):
        slice_ = Received(acquired(1000.0 + 10 * number), 1002.0 + 10 * number + delay_s)
        clock = after(clock, slice_, rules=MEASURED)
    unknown = clock.bounds_for(slice_, MEASURED)
    assert isinstance(unknown, OffsetUnknown)
    assert "fewer than 5 separate acquisitions arrived as promptly as was measured" in unknown.text


def test_with_comparison_and_promptness_an_acquisition_must_be_good_by_both():
    clock = compared(0.0)
    at_once = Received(acquired(1010.0), 1012.0 + 0.5)
    bounds = after(clock, at_once, rules=MEASURED).bounds_for(at_once, MEASURED)
    assert bounds.low_s == pytest.approx(0.5 - 3.0)
    held_up = Received(acquired(1010.0), 1012.0 + 50.0)
    seen = observe(clock, held_up, MEASURED)
    assert "no slice arrived later than 3.0 s when this was measured" in seen.unlike
    # then it is the comparison alone that counts
    alone = seen.clock.bounds_for(held_up, MEASURED)
    assert alone.low_s == pytest.approx(-0.1, abs=0.1)
    assert alone.low_if_set_s is not None


def test_a_slice_that_was_held_up_while_the_clock_was_set_back_is_not_taken_for_a_prompt_one():
    """Those after it agree with each other, and not with the clock that it was acquired by."""
    held_up = Received(acquired(1000.0), 1080.0)
    prompt = [Received(acquired(1060.0 + 5 * k - 18.0), 1064.0 + 5 * k) for k in range(6)]
    clock = after(ScannerClock(), held_up, *prompt, rules=MEASURED)
    assert isinstance(clock.bounds_for(prompt[-1], MEASURED), OffsetBounds)
    unknown = clock.bounds_for(held_up, MEASURED)
    assert "no slice arrived later than 3.0 s when this was measured: scan again" in unknown.text


def test_pushes_that_are_all_equally_late_do_no_harm_beside_a_comparison():
    """Alone they look like prompt ones of a clock that is off: see the premises in the docs."""
    clock = compared(0.0)
    for began_s in range(1010, 1100, 10):
        late = Received(acquired(began_s), began_s + 22.0)
        clock = observe(clock, late, MEASURED).clock
    assert clock.bounds_for(late, MEASURED).low_s <= 0.0
    assert clock._by_promptness(late, MEASURED).low_s == pytest.approx(17.0)


def test_a_clock_set_forward_stops_everything_until_the_clocks_are_compared():
    clock = compared(0.0)
    ahead = Received(acquired(1160.0), 1103.0)
    seen = observe(clock, ahead, RULES)
    assert "ahead of the comparison" in seen.jump
    assert isinstance(
        seen.clock.bounds_for(Received(acquired(1100.0), 1103.0), RULES), OffsetUnknown
    )
    assert seen.clock.comparisons == clock.comparisons  # the stronger knowledge is not dropped
    again = seen.clock.compared(Comparison(-59.0, 0.1, 1110.0), RULES)
    # what was on its way when the clock was set cannot be told from what is new
    soon = again.bounds_for(Received(acquired(1172.0), 1115.0), RULES)
    assert isinstance(soon, OffsetUnknown)
    assert "before the scanner's clock was set" in soon.text
    later = again.bounds_for(Received(acquired(1300.0), 1243.0), RULES)
    assert later.low_s == pytest.approx(-59.1, abs=0.1)


def test_comparisons_that_do_not_agree_say_that_the_clock_was_set_in_between():
    clock = compared(0.0).compared(Comparison(60.0, 0.1, 1100.0), RULES)
    assert clock.set_at_s == 1100.0
    agreeing = compared(0.0).compared(Comparison(0.15, 0.1, 1100.0), RULES)
    assert agreeing.set_at_s is None


def test_a_slice_that_comes_much_sooner_than_all_before_it_is_suspicious():
    clock = compared(0.0)
    for number in range(6):
        clock = after(clock, Received(acquired(1000.0 + 30 * number), 1022.0 + 30 * number))
    sooner = Received(acquired(1300.0), 1317.0)
    seen = observe(clock, sooner, RULES)
    assert "5.0 s sooner after its acquisition than any of the 6 slices before it" in seen.jump
    assert isinstance(seen.clock.bounds_for(sooner, RULES), OffsetUnknown)
    agreed = seen.clock.compared(Comparison(0.0, 0.1, 1320.0), RULES)
    # the first comparison, which is older, counts as well
    assert agreed.bounds_for(sooner, RULES).low_s == pytest.approx(-0.1 - 317.0 * 500e-6)


def test_a_wrong_duration_is_called_one_and_takes_nothing_from_the_clock():
    """Two seconds that were written as 2000, by a vendor who writes milliseconds."""
    clock = compared(0.0)
    odd = Received(acquired(1010.0, 2000.0), 1012.5)
    seen = observe(clock, odd, RULES)
    assert seen.duration == "its duration of 2000.0 s is wrong: it arrived 2.6 s after its start"
    assert (seen.jump, seen.clock) == ("", clock)


def test_a_comparison_does_not_hold_for_a_slice_that_came_sooner_than_it_allows():
    """Held up, and then the clock was set back, and then somebody compared it."""
    clock = after(ScannerClock(), Received(acquired(1000.0), 1070.0))
    later = clock.compared(Comparison(676.0, 0.1, 1080.0), RULES)
    unknown = later.bounds_for(Received(acquired(1000.0), 1070.0), RULES)
    assert isinstance(unknown, OffsetUnknown)
    assert "sooner than the comparison allows" in unknown.text


def test_a_comparison_alone_does_not_say_that_the_clock_was_not_set_forward_since():
    """By less than the slice took to come; the acquisition may have begun before its own time."""
    clock, slice_ = compared(0.0, at_s=1000.0), Received(acquired(1100.0), 1103.0)
    assert clock.bounds_for(slice_, RULES).low_if_set_s == pytest.approx(-100.0)
    # it is not older than any slice may be
    later = Received(acquired(1500.0), 1503.0)
    assert clock.bounds_for(later, RULES).low_if_set_s == pytest.approx(1.0 - 120.0)
    again = clock.compared(Comparison(0.0, 0.1, 1101.0), RULES)
    assert again.bounds_for(slice_, RULES).low_if_set_s == pytest.approx(1.0)
    assert clock.bounds_for(slice_, replace(RULES, unseen_steps=False)).low_if_set_s is None
    assert clock.bounds_for(slice_, MEASURED).low_if_set_s is None


def test_a_clock_that_followed_a_reference_when_it_was_compared_is_not_set_unseen():
    slice_ = Received(acquired(1100.0), 1103.0, synchronized=True)
    assert after(compared(0.0), slice_).bounds_for(slice_, RULES).low_if_set_s is not None
    before = after(ScannerClock(), Received(acquired(990.0), 993.0, synchronized=True))
    followed = after(before.compared(Comparison(0.0, 0.1, 1000.0), RULES), slice_)
    assert followed.bounds_for(slice_, RULES).low_if_set_s is None
    lost = after(followed, Received(acquired(1110.0), 1113.0), slice_)
    assert lost.bounds_for(slice_, RULES).low_if_set_s is not None


def test_a_clock_set_back_is_an_alarm_once_it_seems_too_late():
    clock = after(compared(0.0), Received(acquired(1000.0), 1003.0))
    assert not observe(clock, Received(acquired(1000.0), 1100.0), RULES).late
    assert "set back" in observe(clock, Received(acquired(1000.0), 1200.0), RULES).late


def test_a_comparison_widens_with_age_and_ends():
    clock = compared(40.0, at_s=0.0)
    interval = acquired(960.0, 2.0)
    bounds = clock.bounds_for(Received(interval, 1002.5), RULES)
    assert bounds.low_s == pytest.approx(39.9 - 1002.5 * 500e-6)
    disciplined = clock.bounds_for(Received(interval, 1002.5, synchronized=True), RULES)
    assert disciplined.low_s == pytest.approx(39.9 - 1002.5 * 50e-6)
    tomorrow = acquired(86360.0)
    unknown = clock.bounds_for(Received(tomorrow, 86402.5), RULES)
    assert isinstance(unknown, OffsetUnknown)
    assert "compared 1440 min before" in unknown.text
    known = clock.bounds_for(Received(tomorrow, 86402.5, synchronized=True), RULES)
    assert known.low_s == pytest.approx(39.9 - 86402.5 * 50e-6)


def test_a_slice_without_a_duration_may_have_lasted_as_long_as_any():
    slice_ = Received(acquired(1000.0, None), 1005.0)
    clock = after(compared(0.0), slice_, rules=MEASURED)
    bounds = clock.bounds_for(slice_, MEASURED)
    assert bounds.low_s == pytest.approx(5.0 - RULES.longest_acquisition_s - 3.0)


def test_bounds_of_delays_come_from_enough_of_them():
    delays_s = [5.0 + 0.1 * (k % 5) for k in range(20)]
    measured = promptness_of(delays_s)
    assert measured.least_s == pytest.approx(4.7)
    assert measured.most_s == pytest.approx(5.7)
    with pytest.raises(TooFewDelaysError, match="at least 20 delays are needed, got 19"):
        promptness_of(delays_s[1:])


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
        drift = drift.with_slice(Received(acquired(1000.0 + number), 1003.0 + 2 * number))
    assert drift.moved_s == pytest.approx(10.0)
    assert drift.with_slice(Received(acquired(1000.0, None), 2000.0)) == drift
