"""When a frame was acquired, as the scanner's own clock says it: an interval and its source.

Order of sources: FrameReferenceDateTime, FrameAcquisitionDateTime, AcquisitionDateTime,
AcquisitionDate with AcquisitionTime. Content, series, instance creation and trigger times are
never looked at. The interval is never made shorter than what the header can prove.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone, tzinfo

from dicom_slice.elements import Elements, FrameElements
from dicom_slice.quirks import ge_duration_s

_EARLIEST_YEAR = 1990  # de-identified headers say 0001 or 1900
_DAY = timedelta(days=1)


@dataclass(frozen=True)
class AcquisitionInterval:
    """Seconds since the epoch by the scanner's clock.

    end_s None: the header does not say how long it took; the receipt is then the only bound.
    estimated: end_s rests on RepetitionTime x phase-encoding steps x averages.
    """

    start_s: float
    end_s: float | None
    source: str
    estimated: bool = False


@dataclass(frozen=True)
class TimeFrame:
    """What is needed to read the scanner's local time: its zone, and when the slice came to us.

    received_s chooses the day where only a time is given, and the side of the hour that occurs
    twice in autumn: an acquisition ends before its slice is received. None: unknown, and then a
    time without a date, or within that hour, cannot be read.
    """

    zone: tzinfo | None = None  # None: the zone of this computer
    received_s: float | None = None


class ImplausibleTimeError(ValueError):
    """The header gives a time that cannot be the time of the acquisition."""


def acquisition_interval(frame: FrameElements, times: TimeFrame) -> AcquisitionInterval | None:
    """Return the interval of one frame, or None where the header has no acquisition time at all.

    Raises ImplausibleTimeError (year 0001, 25 o'clock, a local time that does not exist...).
    """
    duration_s, estimated = _duration_s(frame)
    reference, acquisition = _frame_instants(frame, times)
    if reference is not None:
        return _around(reference, acquisition, duration_s, estimated)
    if acquisition is not None:
        return _from(acquisition, duration_s, "FrameAcquisitionDateTime", estimated)
    text = frame.top.text("AcquisitionDateTime")
    if text:
        start_s = _instant(text, frame.top, times)
        return _from(start_s, duration_s, "AcquisitionDateTime", estimated)
    time_text = frame.top.text("AcquisitionTime")
    if not time_text:
        return None
    start_s = _date_and_time(frame.top.text("AcquisitionDate"), time_text, frame.top, times)
    return _from(start_s, duration_s, "AcquisitionDate+AcquisitionTime", estimated)


def _frame_instants(frame: FrameElements, times: TimeFrame) -> tuple[float | None, float | None]:
    def instant(keyword: str) -> float | None:
        text = frame.find("FrameContentSequence", lambda item: item.text(keyword))
        return _instant(text, frame.top, times) if text else None

    return instant("FrameReferenceDateTime"), instant("FrameAcquisitionDateTime")


def _from(
    start_s: float, duration_s: float | None, source: str, estimated: bool
) -> AcquisitionInterval:
    end_s = None if duration_s is None else start_s + duration_s
    return AcquisitionInterval(start_s, end_s, source, estimated)


def _around(
    reference_s: float, acquisition_s: float | None, duration_s: float | None, estimated: bool
) -> AcquisitionInterval:
    """The reference instant lies somewhere in the acquisition: cover all that it may mean."""
    source = "FrameReferenceDateTime"
    if acquisition_s is None:
        if duration_s is None:
            return AcquisitionInterval(reference_s, None, source, estimated)
        return AcquisitionInterval(
            reference_s - duration_s, reference_s + duration_s, source, estimated
        )
    end_s = None if duration_s is None else max(reference_s, acquisition_s + duration_s)
    return AcquisitionInterval(min(reference_s, acquisition_s), end_s, source, estimated)


def _duration_s(frame: FrameElements) -> tuple[float | None, bool]:
    """(duration, estimated). The longer of what the frame and the whole acquisition say."""
    frame_ms = frame.find(
        "FrameContentSequence", lambda item: item.number("FrameAcquisitionDuration")
    )
    whole_s = frame.top.number("AcquisitionDuration")
    if frame_ms is not None and frame_ms > 0:
        return frame_ms / 1000, False
    if whole_s is not None and whole_s > 0:
        return whole_s, False
    ge_s = ge_duration_s(frame.top)
    if ge_s is not None:
        return ge_s, False
    return _estimated_duration_s(frame), True


def _estimated_duration_s(frame: FrameElements) -> float | None:
    """RepetitionTime x phase-encoding steps x averages, which is rather too long than too short.

    None where any of these is missing, and for 3-D acquisitions, which take a multiple of that.
    """
    top = frame.top
    repetition_ms = frame.find(
        "MRTimingAndRelatedParametersSequence", lambda item: item.number("RepetitionTime")
    )
    if top.text("MRAcquisitionType").upper() == "3D" or not repetition_ms:
        return None
    steps = top.number("NumberOfPhaseEncodingSteps") or max(
        top.numbers("AcquisitionMatrix")[2:], default=0.0
    )
    averages = frame.find("MRAveragesSequence", lambda item: item.number("NumberOfAverages"))
    return repetition_ms / 1000 * steps * max(averages or 1.0, 1.0) if steps else None


def _instant(text: str, top: Elements, times: TimeFrame) -> float:
    """A DICOM DT value: YYYYMMDDHHMMSS.FFFFFF&ZZXX."""
    body, sign, offset = text, "", ""
    for mark in "+-":
        if mark in text:
            body, _, offset = text.partition(mark)
            sign = mark
    body = body.strip()
    if len(body.partition(".")[0]) < 14:
        raise ImplausibleTimeError(f"{text!r} does not give date and time to the second")
    zone = _offset_zone(sign + offset, text) if sign else _header_zone(top)
    return _epoch_s(_local(body[:8], body[8:]), zone, times)


def _date_and_time(date: str, time: str, top: Elements, times: TimeFrame) -> float:
    zone = _header_zone(top)
    if date:
        return _epoch_s(_local(date.replace(".", ""), time), zone, times)
    if times.received_s is None:
        raise ImplausibleTimeError("AcquisitionTime without AcquisitionDate")
    received = datetime.fromtimestamp(times.received_s, zone or times.zone)
    candidates = [
        _epoch_s(_local(f"{received + shift * _DAY:%Y%m%d}", time), zone, times)
        for shift in (-1, 0, 1)
    ]
    # The scanner's clock may run ahead of ours by a little, hardly by half a day.
    return min(candidates, key=lambda s: abs(s - times.received_s))  # type: ignore[operator]


def _local(date: str, time: str) -> datetime:
    """Naive local time from DA and TM; TM may end after the hours, and may have colons (ACR)."""
    digits, _, fraction = time.replace(":", "").partition(".")
    digits = digits.ljust(6, "0")
    if digits[4:6] == "60":  # a leap second
        digits = digits[:4] + "59"
    try:
        moment = datetime.strptime(date + digits[:6], "%Y%m%d%H%M%S")
        micros = int((fraction or "0")[:6].ljust(6, "0"))
    except ValueError:
        raise ImplausibleTimeError(f"{date!r} {time!r} is not a date and time") from None
    if moment.year < _EARLIEST_YEAR:
        raise ImplausibleTimeError(f"the year is {moment.year:04d}")
    return moment.replace(microsecond=micros)


def _header_zone(top: Elements) -> tzinfo | None:
    text = top.text("TimezoneOffsetFromUTC")
    return _offset_zone(text, text) if text else None


def _offset_zone(text: str, shown: str) -> tzinfo:
    try:
        minutes = int(text[1:3]) * 60 + int(text[3:5])
        return timezone(timedelta(minutes=-minutes if text[0] == "-" else minutes))
    except (ValueError, IndexError):
        raise ImplausibleTimeError(f"{shown!r} has no readable offset from UTC") from None


def _epoch_s(local: datetime, zone: tzinfo | None, times: TimeFrame) -> float:
    if zone is not None:
        return local.replace(tzinfo=zone).timestamp()
    instants = sorted(set(_instants_of_local(local, times.zone)))
    if not instants:
        raise ImplausibleTimeError(f"{local} does not exist in the scanner's time zone")
    if len(instants) == 1:
        return instants[0]
    if times.received_s is None:
        raise ImplausibleTimeError(f"{local} occurs twice in the scanner's time zone")
    return min(instants, key=lambda s: abs(s - times.received_s))  # type: ignore[operator]


def _instants_of_local(local: datetime, zone: tzinfo | None) -> Iterator[float]:
    """When a clock in the zone shows `local`: once; twice in autumn, never in spring."""
    for fold in (0, 1):
        aware = local.replace(fold=fold, tzinfo=zone) if zone else local.replace(fold=fold)
        instant_s = aware.timestamp()
        shown = datetime.fromtimestamp(instant_s, zone).replace(tzinfo=None, fold=0)
        if abs(shown - local) < timedelta(milliseconds=1):
            yield instant_s
