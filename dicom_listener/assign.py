"""To which hold does a slice belong? Pure: everything comes in as arguments.

A slice is assigned to a hold only if all of this holds; one missing proof sets it aside.

1. Time. Its acquisition, by the scanner's clock and the worst case of the offset between the
   clocks, began after the hold had settled, and had ended before the hold did. Where the offset is
   not known, or would not be if the scanner's clock had been set unseen, it waits.
2. Receipt. It was received before the hold ended. An acquisition ends before it is received, by
   our own clock: so its end is proved whatever the scanner's clock says, and a clock that was set
   back can never carry a slice into an earlier hold.
3. Order. No acquisition numbered after it was received before the hold began.
4. Nothing is outstanding. Where an earlier hold ended without all its slices, as many acquisitions
   as it lacks are set aside before one is believed: they may be the missing ones.
5. Geometry. It shows the same slice positions as the other holds of its set, on the same grid.
6. Count. The hold still lacks slices.
7. Identity. It is of the patient, study and frame of reference to which the case is bound.

In arrival mode (a site without usable acquisition times) the operator's confirmation that the
acquisition was made at this hold takes the place of 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dicom_listener.belonging import Binding, why_not_of
from dicom_listener.clock_offset import Offset, OffsetUnknown
from dicom_slice.geometry import SliceGeometry
from dicom_slice.header import Slice
from dicom_slice.reasons import Reason

ARRIVAL = "arrival"
_MAY_BE_MISSING = (Reason.AFTER_INCOMPLETE_HOLD, Reason.RECEIVED_AFTER_HOLD)


@dataclass(frozen=True)
class AssignRules:
    guard_s: float = 0.05
    late_limit_s: float = 300.0
    arrival_mode: bool = False
    position_tolerance_mm: float = 0.5
    direction_tolerance: float = 0.01
    spacing_tolerance: float = 0.01


@dataclass(frozen=True)
class HoldWindow:
    """A hold as assignment sees it; instants by our wall clock; ended_at_s None: still standing."""

    hold_id: int
    set_id: int
    settled_at_s: float
    ended_at_s: float | None
    expected_slices: int
    confirmed: bool = False

    def was_open_at(self, instant_s: float) -> bool:
        return self.settled_at_s <= instant_s and (
            self.ended_at_s is None or instant_s <= self.ended_at_s
        )


@dataclass(frozen=True)
class Known:
    """A usable slice that came before this one; hold_id None: set aside, for the reason `code`."""

    slice: Slice
    received_s: float
    hold_id: int | None
    code: str = ""

    @property
    def may_still_count(self) -> bool:
        """It fills a hold, or may be one that a hold lacks."""
        return self.hold_id is not None or self.code in _MAY_BE_MISSING


@dataclass(frozen=True)
class Assigned:
    hold_id: int
    time_source: str
    acquired_from_s: float
    acquired_to_s: float


@dataclass(frozen=True)
class Pending:
    """Not yet: to be asked again when the hold changes."""

    code: Reason
    text: str


@dataclass(frozen=True)
class Quarantined:
    code: Reason
    text: str


Decision = Assigned | Pending | Quarantined


def assign(
    slice_: Slice,
    received_s: float,
    holds: Sequence[HoldWindow],
    known: Sequence[Known],
    offset: Offset,
    rules: AssignRules,
    binding: Binding | None = None,
) -> Decision:
    """Decide for one usable slice (`why_not_usable` said None).

    holds: all of the case, in their order; known: usable slices received before, oldest first.
    binding: of the case; None: as the first used one of the known slices binds it.
    """
    other = why_not_of(binding or _bound_by(known), slice_.identity)
    if other is not None:
        return Quarantined(other.code, other.text)
    if not any(hold.was_open_at(received_s) for hold in holds) and not holds:
        return Quarantined(Reason.NO_HOLD, "no hold was open: the robot had not settled yet")
    placed = _by_arrival if rules.arrival_mode else _by_time
    found = placed(slice_, received_s, holds, offset, rules)
    if isinstance(found, (Pending, Quarantined)):
        return found
    hold, assigned = found
    doubt = (
        _out_of_order(slice_, hold, known)
        or _after_incomplete_hold(slice_, hold, holds, known)
        or _differs_from_set(slice_, hold, holds, known, rules)
        or _twin(slice_, hold, known)
        or _other_correction(slice_, known)
    )
    if doubt is not None:
        return doubt
    return _surplus(hold, known) or _if_set(slice_, hold, offset, rules) or assigned


def _bound_by(known: Sequence[Known]) -> Binding | None:
    first = next((one for one in known if one.hold_id is not None), None)
    return None if first is None else Binding.to(first.slice.identity)


# 1 and 2: time and receipt

Placed = tuple[HoldWindow, Assigned] | Pending | Quarantined


def _by_time(
    slice_: Slice,
    received_s: float,
    holds: Sequence[HoldWindow],
    offset: Offset,
    rules: AssignRules,
) -> Placed:
    interval = slice_.interval
    if interval is None:
        if slice_.time_problem:
            return Quarantined(Reason.IMPLAUSIBLE_TIME, slice_.time_problem)
        return Quarantined(Reason.NO_TIME, "the header has no acquisition time")
    if isinstance(offset, OffsetUnknown):
        if any(hold.was_open_at(received_s) for hold in holds):
            return Pending(Reason.CLOCK_UNKNOWN, offset.text)
        return Quarantined(Reason.NO_HOLD, "no hold was open when it was received")
    earliest_s, latest_start_s = interval.start_s + offset.low_s, interval.start_s + offset.high_s
    if not earliest_s <= received_s:
        ahead_s = earliest_s - received_s
        return Quarantined(Reason.FUTURE, f"acquired {ahead_s:.1f} s after it was received")
    if interval.end_s is not None:
        delay_s = received_s - (interval.end_s + offset.high_s)
        if not delay_s <= rules.late_limit_s:
            return Quarantined(Reason.LATE, f"received {delay_s:.1f} s after its acquisition")
    is_end_certain = interval.end_s is not None and not interval.estimated
    end_s = interval.end_s if is_end_certain else None
    latest_s = received_s if end_s is None else min(end_s + offset.high_s, received_s)
    for hold in holds:
        inside = earliest_s >= hold.settled_at_s + rules.guard_s and (
            hold.ended_at_s is None or latest_s <= hold.ended_at_s - rules.guard_s
        )
        if not inside:
            continue
        if hold.ended_at_s is not None and received_s > hold.ended_at_s:
            after_s = received_s - hold.ended_at_s
            return Quarantined(
                Reason.RECEIVED_AFTER_HOLD,
                f"received {after_s:.1f} s after hold {hold.hold_id} had ended",
            )
        return hold, Assigned(hold.hold_id, interval.source, earliest_s, latest_s)
    return _outside(holds, earliest_s, latest_start_s, latest_s, rules.guard_s)


def _if_set(slice_: Slice, hold: HoldWindow, offset: Offset, rules: AssignRules) -> Pending | None:
    """It is of this hold only if nobody has set the scanner's clock since it was compared."""
    if isinstance(offset, OffsetUnknown) or offset.low_if_set_s is None or rules.arrival_mode:
        return None
    assert slice_.interval is not None
    if slice_.interval.start_s + offset.low_if_set_s >= hold.settled_at_s + rules.guard_s:
        return None
    return Pending(
        Reason.CLOCK_UNKNOWN,
        f"the clocks have not been compared since hold {hold.hold_id} settled, and the scanner's "
        "clock may have been set: compare the clocks, or confirm the hold at which this "
        "acquisition was made",
    )


def _outside(
    holds: Sequence[HoldWindow],
    earliest_s: float,
    latest_start_s: float,
    latest_s: float,
    guard_s: float,
) -> Quarantined:
    before = [hold for hold in holds if hold.settled_at_s <= latest_s]
    if not before:
        early_s = holds[0].settled_at_s - earliest_s
        text = f"acquired {early_s:.2f} s before the first hold had settled"
        return Quarantined(Reason.NO_HOLD, text)
    hold = before[-1]
    after_s = earliest_s - hold.settled_at_s
    settled = f"hold {hold.hold_id} had settled"
    if hold.ended_at_s is not None and earliest_s >= hold.ended_at_s:
        return Quarantined(Reason.NO_HOLD, f"acquired after hold {hold.hold_id} had ended")
    if after_s < 0:
        sure = "began" if latest_start_s < hold.settled_at_s else "may have begun"
        text = f"the acquisition {sure} {-after_s:.2f} s before {settled}"
        return Quarantined(Reason.OUTSIDE_HOLD, text)
    if after_s < guard_s:
        text = f"the acquisition may have begun only {after_s:.2f} s after {settled}"
        return Quarantined(Reason.OUTSIDE_HOLD, text)
    return Quarantined(
        Reason.OUTSIDE_HOLD, f"the acquisition may have lasted beyond hold {hold.hold_id}"
    )


def _by_arrival(
    slice_: Slice,
    received_s: float,
    holds: Sequence[HoldWindow],
    offset: Offset,
    rules: AssignRules,
) -> Placed:
    hold = next((hold for hold in holds if hold.was_open_at(received_s)), None)
    if hold is None:
        return Quarantined(Reason.NO_HOLD, "no hold was open when it was received")
    if hold.confirmed:
        return hold, Assigned(hold.hold_id, ARRIVAL, hold.settled_at_s, received_s)
    text = f"the acquisition at hold {hold.hold_id} is not confirmed"
    if hold.ended_at_s is None:
        return Pending(Reason.NOT_CONFIRMED, text)
    return Quarantined(Reason.NOT_CONFIRMED, text)


# 3: order


def _out_of_order(slice_: Slice, hold: HoldWindow, known: Sequence[Known]) -> Quarantined | None:
    for other in known:
        if other.received_s >= hold.settled_at_s or not _same_study(other.slice, slice_):
            continue
        if other.slice.acquisition_key > slice_.acquisition_key:
            return Quarantined(
                Reason.OUT_OF_ORDER,
                f"series and acquisition {_numbers(slice_)} after {_numbers(other.slice)}, which "
                f"was received before hold {hold.hold_id} began",
            )
    return None


def _same_study(a: Slice, b: Slice) -> bool:
    return a.study_instance_uid == b.study_instance_uid and a.scanner == b.scanner


def _numbers(slice_: Slice) -> str:
    return "/".join(str(number) for number in slice_.acquisition_key)


# 4: nothing outstanding


def _after_incomplete_hold(
    slice_: Slice, hold: HoldWindow, holds: Sequence[HoldWindow], known: Sequence[Known]
) -> Quarantined | None:
    """Set aside as many acquisitions as earlier holds lack slices, counted since the first lack.

    Only those set aside here, or recognised as of an ended hold, count as found: any other may have
    been made between the holds.
    """
    incomplete = [
        (earlier, missing)
        for earlier in holds
        if earlier.ended_at_s is not None
        and earlier.ended_at_s <= hold.settled_at_s
        and (missing := earlier.expected_slices - _count(earlier.hold_id, known)) > 0
    ]
    if not incomplete:
        return None
    since_s = incomplete[0][0].ended_at_s or 0.0
    doubtful = {
        _acquisition(other.slice)
        for other in known
        if other.code in _MAY_BE_MISSING and other.received_s >= since_s
    }
    if _acquisition(slice_) not in doubtful:
        if len(doubtful) >= sum(missing for _, missing in incomplete):
            return None
        if any(
            _acquisition(other.slice) == _acquisition(slice_)
            for other in known
            if other.hold_id == hold.hold_id
        ):
            return None
    earlier = incomplete[-1][0]
    return Quarantined(
        Reason.AFTER_INCOMPLETE_HOLD,
        f"hold {earlier.hold_id} ended without all its slices; this may be one of them: scan again",
    )


def _acquisition(slice_: Slice) -> tuple[str, tuple[int, int], float | None]:
    start_s = None if slice_.interval is None else slice_.interval.start_s
    return slice_.study_instance_uid, slice_.acquisition_key, start_s


def _count(hold_id: int, known: Sequence[Known]) -> int:
    return sum(other.hold_id == hold_id for other in known)


# 5: geometry


def _differs_from_set(
    slice_: Slice,
    hold: HoldWindow,
    holds: Sequence[HoldWindow],
    known: Sequence[Known],
    rules: AssignRules,
) -> Quarantined | None:
    """Compare with the first complete other hold of the set: it shows what the set looks like."""
    if slice_.geometry is None:
        return None
    for other in holds:
        if other.set_id != hold.set_id or other.hold_id == hold.hold_id:
            continue
        there = [k.slice for k in known if k.hold_id == other.hold_id and k.slice.geometry]
        if not there or len(there) < other.expected_slices:
            continue
        matches = [s for s in there if _same_geometry(s.geometry, slice_.geometry, rules)]
        if not matches:
            return Quarantined(
                Reason.GEOMETRY_DIFFERS,
                f"position, orientation or grid differs from hold {other.hold_id} of its set",
            )
        if all(m.distortion_corrected != slice_.distortion_corrected for m in matches):
            return Quarantined(
                Reason.DISTORTION_TWIN,
                f"distortion correction differs from hold {other.hold_id} of its set",
            )
        return None
    return None


def _same_geometry(a: SliceGeometry | None, b: SliceGeometry, rules: AssignRules) -> bool:
    if a is None or a.shape != b.shape:
        return False
    shift_mm = np.abs(np.subtract(a.position_mm, b.position_mm)).max()
    turn = max(
        np.abs(np.subtract(a.row_direction, b.row_direction)).max(),
        np.abs(np.subtract(a.col_direction, b.col_direction)).max(),
    )
    stretch = np.abs(np.divide(a.spacing_mm, b.spacing_mm) - 1).max()
    return bool(
        shift_mm <= rules.position_tolerance_mm
        and turn <= rules.direction_tolerance
        and stretch <= rules.spacing_tolerance
    )


def _twin(slice_: Slice, hold: HoldWindow, known: Sequence[Known]) -> Quarantined | None:
    """The same acquisition with and without distortion correction: one of the two is enough."""
    for other in known:
        if other.hold_id != hold.hold_id or other.slice.geometry is None:
            continue
        is_twin = (
            other.slice.distortion_corrected != slice_.distortion_corrected
            and other.slice.interval == slice_.interval
            and slice_.geometry is not None
            and np.allclose(other.slice.geometry.position_mm, slice_.geometry.position_mm, atol=0.1)
        )
        if is_twin:
            return Quarantined(
                Reason.DISTORTION_TWIN,
                "the same acquisition is already present with the other distortion correction",
            )
    return None


def _other_correction(slice_: Slice, known: Sequence[Known]) -> Quarantined | None:
    """All slices of a case are distortion-corrected, or none is: the first one used decides."""
    first = next((k for k in known if k.hold_id is not None), None)
    if first is None or first.slice.distortion_corrected == slice_.distortion_corrected:
        return None
    word = "with" if slice_.distortion_corrected else "without"
    return Quarantined(
        Reason.DISTORTION_TWIN,
        f"{word} distortion correction, unlike the slices used so far in this case",
    )


# 6: count


def _surplus(hold: HoldWindow, known: Sequence[Known]) -> Pending | Quarantined | None:
    there = _count(hold.hold_id, known)
    if there < hold.expected_slices:
        return None
    text = f"hold {hold.hold_id} already has all its slices, {there} of {hold.expected_slices}"
    if hold.ended_at_s is None:
        return Pending(Reason.NOT_EXPECTED, text)
    return Quarantined(Reason.NOT_EXPECTED, text)
