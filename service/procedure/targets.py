"""Targets: where the fiducial, or the needle, is to be; set, replaced and withdrawn as events.

A target is either where the fiducial was seen (`in_water` false: the image shows oil, and oil is
what will be looked at again) or a place in tissue (`in_water` true): then the fiducial must appear
beside it by the oil-water shift of the slices, which follows from their header.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from case_record.record import CaseRecord
from case_record.rows import Event
from service.procedure.calibration import Calibration, FoundBy
from service.procedure.fiducials import GuideGeometry, state_on_line
from service.procedure.kinematics import KinematicsError, line_from_entry_and_target
from service.procedure.plane import ImagePlane
from service.procedure.scan_frame import ScanFrame, other_place_since, places_good_since

Array = NDArray[np.float64]
TARGET_SET, TARGET_WITHDRAWN = "target_set", "target_withdrawn"
ENTRY_SET = "entry_set"
OIL_WATER_PPM = 3.4


class TargetError(ValueError):
    """The target cannot be used; the text says why and what is missing."""


@dataclass(frozen=True)
class Target:
    """patient_mm: LPS; `number` is that of the event by which it was set.

    frame: of the slices on which it was set, as of `frame_seq` in the order of the record; None:
    before any slice, or in the record of an older program. found_by: how the fiducial was found
    there, where its own place is the target.
    """

    number: int
    patient_mm: tuple[float, float, float]
    label: str = ""
    in_water: bool = False
    frame: ScanFrame | None = None
    frame_seq: int = field(default=0, compare=False)
    found_by: FoundBy | None = None


def current_target(record: CaseRecord) -> Target | None:
    """The target that was set last, unless it was withdrawn or the table moved since."""
    last = record.last_event(TARGET_SET)
    withdrawn = record.last_event(TARGET_WITHDRAWN)
    if last is None or (withdrawn is not None and withdrawn.event_id > last.event_id):
        return None
    return target_of(last) if last.seq > places_good_since(record) else None


def current_entry(record: CaseRecord) -> tuple[float, float, float] | None:
    """The planned skin point that was set last, patient mm (LPS); None if the table moved since."""
    event = record.last_event(ENTRY_SET)
    if event is None or event.seq <= places_good_since(record):
        return None
    x, y, z = event.body["patient_mm"]
    return x, y, z


def current_entry_number(record: CaseRecord) -> int | None:
    """The number of the event by which the present entry point was set."""
    event = record.last_event(ENTRY_SET)
    if event is None or event.seq <= places_good_since(record):
        return None
    return event.event_id


def target_that_can_be_taken(record: CaseRecord, number: int) -> Target:
    """A target of the case by its number. TargetError where it is none, or none any more."""
    event = next((e for e in record.events_of_kind(TARGET_SET) if e.event_id == number), None)
    if event is None:
        raise TargetError(f"this case has no target {number}")
    if event.seq <= places_good_since(record):
        raise TargetError("it was set before the table moved; pick it again on new slices")
    return target_of(event)


def all_targets(record: CaseRecord) -> list[Target]:
    """Every target of the case in the order in which they were set."""
    return [target_of(event) for event in record.events_of_kind(TARGET_SET)]


def target_of(event: Event) -> Target:
    x, y, z = event.body["patient_mm"]
    frame = event.body.get("scan_frame")
    return Target(
        event.event_id,
        (x, y, z),
        event.body.get("label", ""),
        event.body.get("in_water", False),
        None if frame is None else ScanFrame(**frame),
        event.body.get("scan_frame_seq", event.seq),
        FoundBy.from_json(event.body["found_by"]) if "found_by" in event.body else None,
    )


def common_cancels(target: Target, start: Calibration) -> bool:
    """Whether a target is the fiducial's own place, or relative to it, found as it is found now."""
    then = target.found_by
    return not target.in_water and (then is None or then.templates == start.found_by.templates)


def common_part_mm(target: Target, start: Calibration) -> tuple[float, ...]:
    """Std, for each coordinate, of what all places found as now have in common and counts here.

    What the fiducial's middle is said to be cancels where the target is the same fiducial's own
    place, found the same way; by another template of it, what the noise in both does is left. For
    a place in tissue, or one that was found by other means than now, it counts in full.
    """
    then, now = target.found_by, start.found_by
    if target.in_water:
        return now.systematic_mm
    if then is None or common_cancels(target, start):
        return ()
    if not then.templates or not now.templates:
        return now.systematic_mm or then.systematic_mm
    return tuple(float(np.hypot(a, b)) for a, b in zip(now.own_mm, then.own_mm, strict=True))


def why_void_target(record: CaseRecord, target: Target) -> str:
    """Why a target is not where the anatomy is any more; empty if nothing says so."""
    if target.frame is None:
        return ""
    other = other_place_since(record, target.frame_seq, target.frame)
    if not other:
        return ""
    return (
        f"slices from {other} have arrived since the target was set and the table may have "
        "moved; pick it again on the new slices"
    )


def oil_shift_mm(
    header: Mapping[str, Any], spacing_mm: tuple[float, float], polarity: int
) -> Array:
    """How far oil appears from where it is, (row, col) mm in the image plane.

    header: of a slice as the record keeps it. polarity: +1 if oil appears displaced towards growing
    indices along the readout, -1 if towards shrinking ones; it is not in any header.
    Raises TargetError naming the attribute that is missing.
    """
    if polarity not in (1, -1):
        raise TargetError("the readout's polarity must be +1 or -1 (imaging.readout_polarity)")
    wanted = {
        "ImagingFrequency": header.get("imaging_frequency_mhz"),
        "PixelBandwidth": header.get("pixel_bandwidth_hz"),
    }
    for name, value in wanted.items():
        if not isinstance(value, int | float) or not 0 < value < np.inf:
            raise TargetError(f"the slice has no usable {name}: its oil-water shift is not known")
    encoding = header.get("phase_encoding_direction")
    if encoding not in ("ROW", "COL"):
        raise TargetError(
            "the slice has no InPlanePhaseEncodingDirection: its oil-water shift is not known"
        )
    shift_hz = OIL_WATER_PPM * float(wanted["ImagingFrequency"] or 0.0)
    shift_px = polarity * shift_hz / float(wanted["PixelBandwidth"] or np.nan)
    # the phase is encoded along one axis of the image, the readout runs along the other
    readout = 1 if encoding == "COL" else 0
    return np.eye(2)[readout] * shift_px * spacing_mm[readout]


def fiducial_must_appear_at(
    target: Target, plane: ImagePlane, header: Mapping[str, Any], polarity: int
) -> Array:
    """Where in the image plane, mm (2,), the fiducial is seen when it is at the target."""
    place = plane.from_patient(target.patient_mm)
    if target.in_water:
        return place + oil_shift_mm(header, plane.spacing_mm, polarity)
    if target.frame is None or not header:
        return place
    other = target.frame.other_protocol(ScanFrame.of_header(header))
    if not other:
        return place
    # it was set where oil appeared in other slices: in these the same place appears elsewhere
    try:
        now = oil_shift_mm(header, plane.spacing_mm, polarity)
        return place + now - oil_shift_mm(vars(target.frame), plane.spacing_mm, polarity)
    except TargetError as error:
        raise TargetError(
            f"it was set on other slices and the newest have {other}: {error}; set it again on "
            "these"
        ) from error


@dataclass(frozen=True, eq=False)
class NeedleLine:
    """Where the guide is to be: its line upwards from the lower ball joint, and how deep to go."""

    joint_mm: Array
    direction: Array
    depth_mm: float

    def state(
        self, geometry: GuideGeometry, plane: ImagePlane, oil_shift: Array | None = None
    ) -> Array:
        """How it is seen then: (4,), both fiducials in the image plane."""
        state = state_on_line(geometry, self.joint_mm, self.direction, plane)
        return state if oil_shift is None else state + np.tile(oil_shift, 2)


def needle_line(
    entry_mm: Sequence[float],
    target_mm: Sequence[float],
    plane: ImagePlane,
    lower_plane_mm: float,
    upper_plane_mm: float,
) -> NeedleLine:
    """The guide's line through entry and target (patient mm), for planes along the slice normal.

    Raises TargetError for points that do not define a line, a line that is too flat, or a target
    that does not lie below the lower ball joint.
    """
    try:
        line = line_from_entry_and_target(entry_mm, target_mm)
    except KinematicsError as error:
        raise TargetError(f"entry and target: {error}") from error
    along = float(plane.normal @ line.direction)
    if not abs(along) > 0.5:
        raise TargetError("the needle would be less than 30° from the slice plane")
    direction = line.direction * np.sign(along) * np.sign(upper_plane_mm - lower_plane_mm)
    depth_mm = (lower_plane_mm - float(plane.normal @ line.point_mm)) / float(
        plane.normal @ direction
    )
    if not depth_mm > 0:
        raise TargetError(
            f"the target lies {-depth_mm:.1f} mm above the lower plane: the needle cannot go there"
        )
    return NeedleLine(line.point_mm + depth_mm * direction, direction, depth_mm)
