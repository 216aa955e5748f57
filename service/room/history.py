"""Looking back: errors to the targets of their time, and the cases beside this one."""

from __future__ import annotations

import sqlite3
from bisect import bisect_right
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from case_record.cases import Cases
from case_record.record import FILE_NAME, CaseRecord, CaseRecordError
from case_record.rows import Measurement
from service.procedure.estimate import axis_sigma
from service.procedure.plane import ImagePlane
from service.procedure.registry import APPROACHES, CALIBRATIONS
from service.procedure.targets import TARGET_SET, TARGET_WITHDRAWN, current_target, target_of
from service.room.summaries import CaseSummary, KnownTarget, MeasurementBody


@dataclass(frozen=True)
class Targets:
    """Since when which target (patient mm) was set, oldest first; None: it was withdrawn.

    by_hand: the used slices that a person assigned.
    """

    since_seq: tuple[int, ...]
    patient_mm: tuple[tuple[float, float, float] | None, ...]
    by_hand: frozenset[int] = frozenset()

    def at(self, seq: int) -> tuple[float, float, float] | None:
        """The target that was set at this place in the order of the record."""
        place = bisect_right(self.since_seq, seq)
        return self.patient_mm[place - 1] if place else None

    def body_of(self, row: Measurement) -> MeasurementBody:
        """Return what the API says about a measurement."""
        found = row.result or {}
        return MeasurementBody(
            measurement_id=row.measurement_id,
            state=row.state,
            method=row.method,
            requested_s=row.requested_s,
            finished_s=row.finished_s,
            reason_code=row.reason_code,
            reason=row.reason,
            hold_ids=list(row.hold_ids),
            n_frames=found.get("n_frames", 0),
            patient_mm=found.get("patient_mm"),
            sigma_mm=_sigma_mm(found["covariance_mm2"]) if found else None,
            error_mm=self._error_mm(row),
            snr=found.get("snr"),
            has_reconstruction=bool(found.get("reconstruction")),
            by_hand=rests_on_slices(row, self.by_hand),
        )

    def _error_mm(self, row: Measurement) -> float | None:
        if row.request.get("slice_position_mm") is not None:
            return None  # one of two fiducials: the target is the needle's, not this one's
        target = self.at(row.requested_seq)
        if target is None or not row.result:
            return None
        plane = ImagePlane.from_json(row.result["plane"])
        return float(np.linalg.norm(plane.from_patient(target) - np.array(row.result["plane_mm"])))


def _sigma_mm(covariance_mm2: list[list[float]]) -> float:
    return axis_sigma(covariance_mm2)


def known_targets(record: CaseRecord) -> list[KnownTarget]:
    """Every target with the procedures that approached it, in the order in which they were set."""
    approaches: dict[int, list[int]] = {}
    for row in record.procedures():
        number = row.arguments.get("target") if row.name in APPROACHES else None
        if number is not None:
            approaches.setdefault(number, []).append(row.procedure_id)
    current = current_target(record)
    return [
        KnownTarget(
            **vars(target_of(event)),
            current=current is not None and current.number == event.event_id,
            set_s=event.wall_s,
            who=event.who,
            approaches=approaches.get(event.event_id, []),
        )
        for event in record.events_of_kind(TARGET_SET)
    ]


def targets_over_time(record: CaseRecord) -> Targets:
    events = [*record.events_of_kind(TARGET_SET), *record.events_of_kind(TARGET_WITHDRAWN)]
    events.sort(key=lambda event: event.event_id)
    return Targets(
        tuple(event.seq for event in events),
        tuple(target_of(e).patient_mm if e.kind == TARGET_SET else None for e in events),
        record.slices_by_hand(),
    )


def rests_on_slices(measurement: Measurement, slice_ids: frozenset[int]) -> bool:
    """Whether any of these slices was measured."""
    return not slice_ids.isdisjoint((measurement.result or {}).get("slice_ids", ()))


def arrival_by_hand(record: CaseRecord, procedure_id: int) -> bool:
    """Whether an approach's end rests on a slice that a person assigned: in the approach itself,
    in its calibration, or in anything measured between them.
    """
    by_hand = record.slices_by_hand()
    if not by_hand:
        return False
    arrival = record.procedure(procedure_id)
    calibrations = [
        row.begun_seq
        for row in record.procedures()
        if row.name in CALIBRATIONS and row.state == "done" and row.begun_seq < arrival.begun_seq
    ]
    since = max(calibrations, default=0)
    return any(
        since < row.requested_seq
        and (row.requested_seq < arrival.ended_seq or not arrival.ended_seq)
        for row in record.measurements("done")
        if rests_on_slices(row, by_hand)
    )


def past_cases(cases: Cases) -> list[CaseSummary]:
    """Every case of the room, newest first; nothing is written there."""
    summaries = []
    for folder in cases.folders():
        try:
            at = (folder / FILE_NAME).stat()
            read = _read_summary if folder == cases.open else _closed_summary
            summaries.append(read(folder, folder == cases.open, at.st_mtime_ns, at.st_size))
        except (CaseRecordError, sqlite3.Error, OSError):
            continue  # a record of a newer program, a damaged one, or none: not ours to show
    return sorted(summaries, key=lambda case: -case.created_s)


def _read_summary(folder: Path, current: bool, mtime_ns: int, size: int) -> CaseSummary:
    with CaseRecord(folder, read_only=True) as record:
        return _summary(record, folder, current)


# hundreds of old cases must not be opened for every look at the list; nobody changes them any more
_closed_summary = lru_cache(maxsize=10_000)(_read_summary)


def _summary(record: CaseRecord, folder: Path, current: bool) -> CaseSummary:
    case = record.case()
    described = record.last_event("case_described")
    return CaseSummary(
        folder=folder.name,
        case_uid=case.case_uid if case else "",
        label=described.body["label"] if described else "",
        created_s=case.created_s if case else 0.0,
        slices=sum(record.count_slices().values()),
        measurements=record.count_measurements(),
        punctures=len(record.events_of_kind("puncture")),
        current=current,
    )
