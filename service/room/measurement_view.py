"""What a screen shows of measurements: the newest one, its reconstruction, the error it says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from case_record.record import CaseRecord
from case_record.rows import Measurement, SliceRow
from dicom_slice.geometry import SliceGeometry
from room_config.load import Config
from service.procedure.estimate import axis_sigma, probability_within
from service.procedure.registry import latest_calibration
from service.procedure.targets import Target, common_part_mm, fiducial_must_appear_at
from service.room.state import ErrorState, FiducialState, MeasurementState, ReconstructionState

_LOOKED_BACK = 24
_SAME_SLICE_MM = 0.5


def describe_measurement(last: Measurement) -> MeasurementState:
    """What a measurement found, as far as it has."""
    found = last.result or {}
    return MeasurementState(
        measurement_id=last.measurement_id,
        method=last.method,
        state=last.state,
        finished_s=last.finished_s,
        reason=last.reason,
        slice_id=found.get("slice_id"),
        centre_px=found.get("centre_px"),
        sigma_px=found.get("sigma_px"),
        radius_px=found.get("radius_px"),
        radius_mm=_radius_mm(found) if found else None,
        covariance_mm2=found.get("covariance_mm2"),
        patient_mm=found.get("patient_mm"),
        n_frames=found.get("n_frames", 0),
        snr=found.get("snr"),
        chi2_per_dof=found.get("chi2_per_dof"),
        has_reconstruction=bool(found.get("reconstruction")),
    )


def describe_other_fiducial(record: CaseRecord, last: Measurement) -> FiducialState | None:
    """The newest one found at another slice position than the newest measurement's."""
    at_mm = last.request.get("slice_position_mm")
    if at_mm is None:
        return None
    before = record.page_of_measurements(
        after_id=last.measurement_id, limit=_LOOKED_BACK, newest=True
    )
    for row in before:
        other_mm = row.request.get("slice_position_mm")
        if row.result and other_mm is not None and abs(other_mm - at_mm) > _SAME_SLICE_MM:
            return FiducialState(
                measurement_id=row.measurement_id,
                patient_mm=row.result["patient_mm"],
                radius_mm=_radius_mm(row.result),
            )
    return None


def describe_reconstruction(
    record: CaseRecord, before: ReconstructionState | None, last: Measurement
) -> ReconstructionState | None:
    """The newest measurement's, if it has one; else the one that was shown, or at a new start of
    the service the newest of the last ones.
    """
    rows = [last]
    if before is None:
        rows += record.page_of_measurements(
            after_id=last.measurement_id, limit=_LOOKED_BACK, newest=True
        )
    newest = next(filter(_has_reconstruction, rows), None)
    return before if newest is None else reconstruction_state(record, newest)


def _has_reconstruction(measurement: Measurement) -> bool:
    return bool((measurement.result or {}).get("reconstruction"))


def reconstruction_state(record: CaseRecord, measurement: Measurement) -> ReconstructionState:
    """Geometry of a measurement's super-resolution image; it covers what its slices cover."""
    result = measurement.result or {}
    row = record.slice(result["slice_id"])
    shape = np.load(record.case_dir / result["reconstruction"], mmap_mode="r").shape
    geometry = _geometry(row)
    factor = int(shape[0]) // geometry.shape[0]
    fine = geometry.finer_grid(factor)
    return ReconstructionState(
        measurement_id=measurement.measurement_id,
        factor=factor,
        patient_mm=result["patient_mm"],
        radius_mm=_radius_mm(result),
        **vars(fine),
    )


def _radius_mm(result: Mapping[str, Any]) -> float:
    return float(result["radius_px"]) * float(np.mean(result["plane"]["spacing_mm"]))


def _geometry(row: SliceRow) -> SliceGeometry:
    return SliceGeometry(**{k: tuple(v) for k, v in row.header["geometry"].items()})


def describe_error(config: Config, record: CaseRecord, target: Target | None) -> ErrorState | None:
    """The error by the newest measurement alone (the procedure also knows the moves before).

    Raises TargetError where it is not known where the fiducial appears when it is at the target.
    """
    last = record.last_measurement(state="done")
    calibration = latest_calibration(record)
    if last is None or last.result is None or target is None or calibration is None:
        return None
    header = record.slice(int(last.result["slice_id"])).header
    must_be = fiducial_must_appear_at(
        target, calibration.plane, header, config.imaging.readout_polarity
    )
    offset = must_be - np.array(last.result["plane_mm"])
    covariance = np.array(last.result["covariance_mm2"])
    common_mm = common_part_mm(target, calibration)
    if len(common_mm) == len(covariance):
        covariance = covariance + np.diag(np.square(common_mm))
    spacing = np.array(calibration.plane.spacing_mm)
    target_px = np.array(last.result["centre_px"]) + offset / spacing
    return ErrorState(
        row_mm=float(offset[0]),
        col_mm=float(offset[1]),
        error_mm=float(np.linalg.norm(offset)),
        sigma_mm=axis_sigma(covariance),
        probability_within_tolerance=probability_within(
            offset, covariance, config.service.tolerance_mm
        ),
        target_px=(float(target_px[0]), float(target_px[1])),
    )
