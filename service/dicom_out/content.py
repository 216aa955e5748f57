"""What a measurement, a READY or a puncture found, gathered from the record for DICOM outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Event, Measurement, Procedure, SliceRow
from dicom_slice.geometry import SliceGeometry
from service.procedure.estimate import axis_sigma, probability_within
from service.procedure.plane import ImagePlane
from service.procedure.registry import APPROACHES, GUIDE_APPROACH
from service.procedure.targets import ENTRY_SET, TARGET_SET, TARGET_WITHDRAWN
from service.room.history import targets_over_time
from service.room.validity import READY
from sr_engine.request import geometry_of


@dataclass(frozen=True)
class Distance:
    """How far from the target, mm, standard deviation of one axis, P(below the tolerance).

    of: `fiducial`, or `tip` of the needle where two fiducials are steered. tolerance_mm and
    probability are None where no approach said what is asked for.
    """

    of: str
    error_mm: float
    sigma_mm: float
    tolerance_mm: float | None = None
    probability: float | None = None


@dataclass(frozen=True, eq=False)
class ReportContent:
    """files: of the slices that were measured, in their order; the shown one is `shown`.

    must_be_plane_mm: (2,) row and column in the image plane, where the fiducial is to appear;
    None while there is no target. arrival: the approach that came to READY here, if it is about
    that; puncture: the event, if it is about that.
    """

    case_dir: Path
    case_uid: str
    measurement: Measurement
    result: Mapping[str, Any]
    slices: tuple[SliceRow, ...]
    files: tuple[Path, ...]
    must_be_plane_mm: NDArray[np.float64] | None
    distance: Distance | None
    case_created_s: float = 0.0
    arrival: Procedure | None = None
    puncture: Event | None = None

    @property
    def geometry(self) -> SliceGeometry:
        """Of the slices: all of one measurement share it."""
        return geometry_of(self.slices[-1].header)

    @property
    def shown(self) -> int:
        """Index of the slice in which `centre_px` of the result lies."""
        ids = [row.slice_id for row in self.slices]
        return ids.index(self.result["slice_id"])

    @property
    def shifts_px(self) -> NDArray[np.float64]:
        """(N, 2): displacement (row, col) of the fiducial in each slice from the reference pose."""
        holds = self.measurement.request["holds"]
        shift_mm = {hold["hold_id"]: hold["shift_mm"] for hold in holds}
        shifts = np.array([shift_mm[row.hold_id] for row in self.slices], dtype=float)
        return shifts / np.array(self.geometry.spacing_mm)

    @property
    def radius_mm(self) -> float:
        return float(self.result["radius_px"]) * float(np.mean(self.geometry.spacing_mm))

    @property
    def displacement_mm(self) -> NDArray[np.float64] | None:
        """From the fiducial to where it is to be, (row, col) mm; None without a target."""
        if self.must_be_plane_mm is None:
            return None
        return self.must_be_plane_mm - np.array(self.result["plane_mm"])


def finding_of_measurement(record: CaseRecord, measurement_id: int) -> ReportContent:
    """Raises CaseRecordError if there is no such measurement, or it found nothing."""
    row = record.measurement(measurement_id)
    case = record.case()
    if row.state != "done" or not row.result or case is None:
        raise CaseRecordError(f"{record.case_dir}: measurement {measurement_id} has no result")
    slices = tuple(record.slice(number) for number in row.result["slice_ids"])
    during = _approach_during(record, row)
    must_be = _must_be(record, row, during)
    return ReportContent(
        case_dir=record.case_dir,
        case_uid=case.case_uid,
        case_created_s=case.created_s,
        measurement=row,
        result=row.result,
        slices=slices,
        files=tuple(record.case_dir / one.path for one in slices),
        must_be_plane_mm=must_be,
        distance=None if must_be is None else _distance(row, must_be, during),
    )


def finding_of_arrival(record: CaseRecord, procedure_id: int) -> ReportContent:
    """READY at the end of an approach. Raises CaseRecordError if that was never said of it."""
    if procedure_id not in arrivals_said_ready(record):
        raise CaseRecordError(f"{record.case_dir}: procedure {procedure_id} did not reach READY")
    arrival = record.procedure(procedure_id)
    result = arrival.result or {}
    found = finding_of_measurement(record, int(result["measurement_id"]))
    distance = Distance(
        of="tip" if arrival.name == GUIDE_APPROACH else "fiducial",
        error_mm=float(result["error_mm"]),
        sigma_mm=float(result["sigma_mm"]),
        tolerance_mm=float(arrival.arguments["arguments"]["tolerance_mm"]),
        probability=float(result["probability"]),
    )
    must_be = _wanted_by(found.measurement, arrival)
    changes = {"distance": distance, "must_be_plane_mm": must_be, "arrival": arrival}
    return ReportContent(**{**vars(found), **changes})


def arrivals_said_ready(record: CaseRecord) -> list[int]:
    """The approaches of which READY was said: not all that came to their end were."""
    return [int(event.body["procedure_id"]) for event in record.events_of_kind(READY)]


def finding_of_puncture(record: CaseRecord, event_id: int) -> ReportContent:
    """A recorded puncture. Raises CaseRecordError if that event is none."""
    known = (event for event in record.events_of_kind("puncture") if event.event_id == event_id)
    puncture = next(known, None)
    if puncture is None:
        raise CaseRecordError(f"{record.case_dir}: event {event_id} is not a puncture")
    found = finding_of_arrival(record, int(puncture.body["procedure_id"]))
    return ReportContent(**{**vars(found), "puncture": puncture})


def plan_events(record: CaseRecord) -> list[Event]:
    """By which the plan, target and entry point, changed; none before slices say whose it is."""
    if record.last_slice("assigned") is None:
        return []
    changes = [e for kind in (TARGET_SET, ENTRY_SET) for e in record.events_of_kind(kind)]
    first = min((e.event_id for e in changes if e.kind == TARGET_SET), default=math.inf)
    withdrawn = [e for e in record.events_of_kind(TARGET_WITHDRAWN) if e.event_id > first]
    return sorted([*changes, *withdrawn], key=lambda event: event.event_id)


def _approach_during(record: CaseRecord, row: Measurement) -> Procedure | None:
    """The approach that asked for the measurement."""
    for procedure in reversed(record.procedures()):
        if procedure.begun_seq < row.requested_seq:
            until = procedure.ended_seq
            mine = not until or row.requested_seq < until
            return procedure if mine and procedure.name in APPROACHES else None
    return None


def _must_be(
    record: CaseRecord, row: Measurement, during: Procedure | None
) -> NDArray[np.float64] | None:
    if during is not None:
        return _wanted_by(row, during)
    if row.request.get("slice_position_mm") is not None or not row.result:
        return None  # one of two fiducials: the target is the needle's
    target_mm = targets_over_time(record).at(row.requested_seq)
    if target_mm is None:
        return None
    return ImagePlane.from_json(row.result["plane"]).from_patient(target_mm)


def _wanted_by(row: Measurement, approach: Procedure) -> NDArray[np.float64]:
    """Where the approach wants this measurement's fiducial, (2,) plane mm."""
    arguments = approach.arguments["arguments"]
    wanted = np.array(arguments["target_mm"], dtype=float)
    if approach.name != GUIDE_APPROACH:
        return wanted
    upper_mm, lower_mm = arguments["geometry"]["slice_positions_mm"]
    at_mm = float(row.request["slice_position_mm"])
    return wanted[:2] if abs(at_mm - upper_mm) < abs(at_mm - lower_mm) else wanted[2:]


def _distance(
    row: Measurement, must_be_mm: NDArray[np.float64], during: Procedure | None
) -> Distance:
    """By this measurement alone."""
    result = row.result or {}
    offset = must_be_mm - np.array(result["plane_mm"])
    covariance = np.array(result["covariance_mm2"])
    error_mm = float(np.linalg.norm(offset))
    sigma_mm = axis_sigma(covariance)
    if during is None or during.name == GUIDE_APPROACH:
        return Distance("fiducial", error_mm, sigma_mm)
    tolerance_mm = float(during.arguments["arguments"]["tolerance_mm"])
    probability = float(probability_within(offset, covariance, tolerance_mm))
    return Distance("fiducial", error_mm, sigma_mm, tolerance_mm, probability)
