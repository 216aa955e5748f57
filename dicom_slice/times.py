"""When a frame was acquired, as the scanner's own clock says it: an interval and its source.

Order of sources: FrameReferenceDateTime, FrameAcquisitionDateTime, AcquisitionDateTime,
AcquisitionDate with AcquisitionTime. Content, series, instance creation and trigger times are
never looked at. FrameReferenceDateTime is no start, but an instant within the acquisition: where
the duration is not certain, the start is taken from the others, or there is none. The interval is
never made shorter than what the header can prove.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone, tzinfo

from dicom_slice.elements import Elements, FrameElements
from dicom_slice.quirks import ge_duration_s, whole_duration_s

_EARLIEST_YEAR = 1990  # de-identified headers say 0001 or 1900
_DAY = timedelta(days=1)
_MOST_HOURS = 14
_ROUNDED_S = 0.01
_REFERENCE, _OF_FRAME = "FrameReferenceDateTime", "FrameAcquisitionDateTime"
_OF_ALL = "AcquisitionDateTime"


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

    An instant that cannot be read does not hide one that can; it is named in the warnings. Where
    none can, raises ImplausibleTimeError (year 0001, 25 o'clock, a local time that does not exist).
    """
    duration_s, estimated = _duration_s(frame)
    found = _Instants(frame, times)
    reference_s = found.of_frame(_REFERENCE)
    if reference_s is None:
        begun = next(found.starts(), None)
        if begun is not None:
            start_s, source = begun
            end_s = None if duration_s is None else start_s + duration_s
            return found.told(AcquisitionInterval(start_s, end_s, source, estimated))
    elif duration_s is not None and not estimated:
        return found.told(_around(reference_s, found.of_frame(_OF_FRAME), duration_s))
    else:
        for start_s, source in found.starts():
            if start_s <= reference_s + _ROUNDED_S:
                start_s = min(start_s, reference_s)
                end_s = None if duration_s is None else max(reference_s, start_s + duration_s)
                source = _REFERENCE if source == _OF_FRAME else source
                return found.told(AcquisitionInterval(start_s, end_s, source, estimated))
        found.problems.append(
            f"{_REFERENCE}: it lies within an acquisition of unknown duration, and the header "
            "gives no start before it"
        )
    if found.problems:
        raise ImplausibleTimeError("; ".join(found.problems))
    return None


class _Instants:
    """The instants of one header, each read for itself; what is wrong with one is kept in words."""

    def __init__(self, frame: FrameElements, times: TimeFrame) -> None:
        self._frame, self._times = frame, times
        self.problems: list[str] = []

    def read(self, name: str, text: str) -> float | None:
        if not text:
            return None
        return self._tried(name, lambda: _instant(text, self._frame.top, self._times))

    def of_frame(self, name: str) -> float | None:
        text = self._frame.find("FrameContentSequence", lambda item: item.text(name))
        return self.read(name, text or "")

    def starts(self) -> Iterator[tuple[float, str]]:
        """(start, source), the most particular one first."""
        readers: tuple[tuple[str, Callable[[], float | None]], ...] = (
            (_OF_FRAME, lambda: self.of_frame(_OF_FRAME)),
            (_OF_ALL, lambda: self.read(_OF_ALL, self._frame.top.text(_OF_ALL))),
            ("AcquisitionDate+AcquisitionTime", self.date_and_time),
        )
        for source, read in readers:
            start_s = read()
            if start_s is not None:
                yield start_s, source

    def date_and_time(self) -> float | None:
        top = self._frame.top
        date, time = top.text("AcquisitionDate"), top.text("AcquisitionTime")
        if not time:
            return None
        return self._tried(
            "AcquisitionDate, AcquisitionTime", lambda: _date_and_time(date, time, top, self._times)
        )

    def told(self, interval: AcquisitionInterval) -> AcquisitionInterval:
        """The interval, after a warning of everything that was not used for it."""
        self._frame.top.warnings.extend(f"not used: {problem}" for problem in self.problems)
        return interval

    def _tried(self, name: str, read: Callable[[], float]) -> float | None:
        try:
            return read()
        except ImplausibleTimeError as error:
            self.problems.append(f"{name}: {error}")
            return None


def _around(reference_s: float, started_s: float | None, duration_s: float) -> AcquisitionInterval:
    """The reference instant lies somewhere in the acquisition: cover all that it may mean.

    A start after it cannot be of the same acquisition.
    """
    if started_s is not None and started_s <= reference_s + _ROUNDED_S:
        start_s = min(reference_s, started_s)
        return AcquisitionInterval(start_s, max(reference_s, started_s + duration_s), _REFERENCE)
    end_s = max(reference_s, started_s or reference_s) + duration_s
    return AcquisitionInterval(reference_s - duration_s, end_s, _REFERENCE)


def _duration_s(frame: FrameElements) -> tuple[float | None, bool]:
    """(duration, estimated). The longer of what the frame and the whole acquisition say."""
    frame_ms = frame.find(
        "FrameContentSequence", lambda item: item.number("FrameAcquisitionDuration")
    )
    if frame_ms is not None and frame_ms > 0:
        return frame_ms / 1000, False
    estimated_s = _estimated_duration_s(frame)
    whole_s = whole_duration_s(frame.top, estimated_s)
    if whole_s is not None:
        return whole_s, False
    ge_s = ge_duration_s(frame.top)
    if ge_s is not None:
        return ge_s, False
    return estimated_s, True


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


_ISO = re.compile(r"(\d{4})-(\d{2})-(\d{2})[T ](\d{2}):(\d{2}):(\d{2}(?:[.,]\d+)?)(.*)")
_ZONE = re.compile(r"([+-]?)(\d{2}):?(\d{2})")


def _instant(text: str, top: Elements, times: TimeFrame) -> float:
    """A DICOM DT value, YYYYMMDDHHMMSS.FFFFFF&ZZXX; also as ISO 8601 writes it."""
    iso = _ISO.fullmatch(text)
    plain = "".join(iso.groups()).replace("Z", "+0000") if iso else text
    body, sign, offset = plain, "", ""
    for mark in "+-":
        if mark in plain:
            body, _, offset = plain.partition(mark)
            sign = mark
    body = body.strip()
    if len(re.split("[.,]", body)[0]) < 14:
        raise ImplausibleTimeError(f"{text!r} does not give the date and time to the second")
    local = _local(body[:8], body[8:])
    zone = _offset_zone(sign + offset, local, times) if sign else _header_zone(top, local, times)
    return _epoch_s(local, zone, times)


def _date_and_time(date: str, time: str, top: Elements, times: TimeFrame) -> float:
    if date:
        local = _local(date.replace(".", "").replace("-", ""), time)
        return _epoch_s(local, _header_zone(top, local, times), times)
    if times.received_s is None:
        raise ImplausibleTimeError("AcquisitionTime without AcquisitionDate")
    received = datetime.fromtimestamp(times.received_s, times.zone)
    candidates, problem = [], None
    for shift in (-1, 0, 1):
        try:
            local = _local(f"{received + shift * _DAY:%Y%m%d}", time)
            candidates.append(_epoch_s(local, _header_zone(top, local, times), times))
        except ImplausibleTimeError as error:  # a clock skips an hour in spring, on one day of them
            problem = error
    if not candidates:
        raise problem or ImplausibleTimeError(f"{time!r} is not a time")
    # The scanner's clock may run ahead of ours by a little, hardly by half a day.
    return min(candidates, key=lambda s: abs(s - times.received_s))  # type: ignore[operator]


def _local(date: str, time: str) -> datetime:
    """Naive local time from DA and TM; TM may end after the hours, and may have colons (ACR)."""
    digits, _, fraction = time.replace(":", "").replace(",", ".").partition(".")
    shown = f"{date!r} {time!r} is not a date and time"
    if not (digits.isdecimal() and (not fraction or fraction.isdecimal())):
        raise ImplausibleTimeError(shown)
    digits = digits.ljust(6, "0")
    if digits[4:6] == "60":  # a leap second
        digits = digits[:4] + "59"
    try:
        moment = datetime.strptime(date + digits[:6], "%Y%m%d%H%M%S")
    except ValueError:
        raise ImplausibleTimeError(shown) from None
    if moment.year < _EARLIEST_YEAR:
        raise ImplausibleTimeError(f"the year is {moment.year:04d}")
    return moment.replace(microsecond=int((fraction or "0")[:6].ljust(6, "0")))


def _header_zone(top: Elements, local: datetime, times: TimeFrame) -> tzinfo | None:
    text = top.text("TimezoneOffsetFromUTC")
    if not text:
        return None
    try:
        return _offset_zone(text, local, times)
    except ImplausibleTimeError as error:
        raise ImplausibleTimeError(f"TimezoneOffsetFromUTC (0008,0201): {error}") from None


def _offset_zone(text: str, local: datetime, times: TimeFrame) -> tzinfo:
    """The zone of an offset; one without a sign is read if the scanner's own zone has it."""
    found = _ZONE.fullmatch(text.strip())
    if not found or not int(found[2]) <= _MOST_HOURS or not int(found[3]) < 60:
        raise ImplausibleTimeError(f"{text!r} is not an offset from UTC")
    offset = timedelta(hours=int(found[2]), minutes=int(found[3]))
    if found[1] or not offset:
        return timezone(-offset if found[1] == "-" else offset)
    there = local.replace(tzinfo=times.zone) if times.zone else local.astimezone()
    for signed in (offset, -offset):
        if there.utcoffset() == signed:
            return timezone(signed)
    raise ImplausibleTimeError(
        f"{text!r} has no sign and is not the offset of the room's time zone"
    )


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
