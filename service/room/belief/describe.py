"""What the system believes and why, for a screen: calibration, goal, hold, σ and its parts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from case_record.record import CaseRecord
from case_record.rows import Measurement, Procedure
from room_config.load import Config
from room_config.service import STRATEGIES
from service.procedure.aim import frames_that_decide
from service.procedure.estimate import FiducialEstimate, probability_within
from service.procedure.registry import (
    APPROACH,
    CALIBRATION,
    GUIDE_CALIBRATION,
    latest_calibration,
)
from service.room.belief.goal import bounds_of, effective, goal_tolerance_mm
from service.room.belief.state import (
    AxisBelief,
    BeliefState,
    CalibrationBelief,
    FiducialBelief,
    GoalBelief,
    HoldBelief,
    SettingsBounds,
)
from sr_engine.reconstruction.shiftset import named

_SAME_SLICE_MM = 0.5
_LOOKED_BACK = 24


def describe_belief(room: Config, record: CaseRecord) -> BeliefState:
    """From the record; worth asking anew only when the record has changed."""
    config = effective(room, record)
    service, bounds = config.service, bounds_of(room)
    newest = record.last_measurement(state="done")
    return BeliefState(
        calibration=_calibration(config, record),
        goal=GoalBelief(
            strategy="adaptive" if service.guide else service.strategy,
            tolerance_mm=goal_tolerance_mm(config),
            confidence=service.confidence,
            most_slices=service.most_slices,
        ),
        hold=_hold(config, record),
        fiducials=_fiducials(config, record, newest),
        made_of="" if newest is None else _made_of(newest),
        why=_why_another_slice(record, newest),
        settings=SettingsBounds(
            strategies=["adaptive"] if service.guide else list(STRATEGIES), **vars(bounds)
        ),
    )


def _calibration(config: Config, record: CaseRecord) -> CalibrationBelief | None:
    guide = config.service.guide is not None
    row = record.last_procedure(GUIDE_CALIBRATION if guide else CALIBRATION, "done")
    known = latest_calibration(record, guide=guide)
    if row is None or known is None:
        return None
    jacobian = known.jacobian
    n = len(jacobian.axes)
    sigma = np.sqrt(np.diag(jacobian.covariance)).reshape(n, 2 * n)
    per_axis = {}
    for k, axis in enumerate(jacobian.axes):
        # the fiducial that the axis moves most; of one fiducial there is no other
        columns = jacobian.mean_columns[:, k]
        pair = max(range(0, n, 2), key=lambda at: float(np.hypot(*columns[at : at + 2])))
        down, across = (float(v) for v in columns[pair : pair + 2])
        per_axis[axis] = AxisBelief(
            scale=math.hypot(down, across),
            scale_sigma=float(np.hypot(*sigma[pair : pair + 2, 2 * k])),
            angle_deg=math.degrees(math.atan2(down, across)),
            column_mm=(down, across),
        )
    return CalibrationBelief(at_s=row.ended_s or row.started_s, per_axis=per_axis)


def _hold(config: Config, record: CaseRecord) -> HoldBelief | None:
    """Where in its shift set the hold stands that stands now."""
    hold = record.open_hold()
    if hold is None:
        return None
    of = 1
    if hold.place or any(hold.shift_px):
        name = config.service.shift_set
        of = 4 if name == "paper" else len(named(name).shifts_px)
    return HoldBelief(hold_id=hold.hold_id, place=min(hold.place + 1, of), of=of)


def _fiducials(
    config: Config, record: CaseRecord, newest: Measurement | None
) -> list[FiducialBelief]:
    """The newest measurement's; with two fiducials the other one's newest too, upper one first."""
    if newest is None:
        return []
    guide = config.service.guide
    if guide is None or newest.request.get("slice_position_mm") is None:
        return [_fiducial("", newest)]
    rows = [newest]
    rows += record.page_of_measurements(
        after_id=newest.measurement_id, limit=_LOOKED_BACK, newest=True
    )
    found = []
    for name, at_mm in (("upper", guide.upper_slice_mm), ("lower", guide.lower_slice_mm)):
        row = next((r for r in rows if r.result and _is_at(r, at_mm)), None)
        if row is not None:
            found.append(_fiducial(name, row))
    return found


def _is_at(row: Measurement, at_mm: float) -> bool:
    position_mm = row.request.get("slice_position_mm")
    return position_mm is not None and abs(position_mm - at_mm) <= _SAME_SLICE_MM


def _fiducial(name: str, row: Measurement) -> FiducialBelief:
    found: Mapping[str, Any] = row.result or {}
    sigma_row, sigma_col = np.sqrt(np.diag(np.array(found["covariance_mm2"]))).tolist()
    return FiducialBelief(
        name=name,
        measurement_id=row.measurement_id,
        patient_mm=found["patient_mm"],
        sigma_row_mm=sigma_row,
        sigma_col_mm=sigma_col,
    )


def _made_of(row: Measurement) -> str:
    """What the uncertainty of a measurement rests on, in words."""
    found = row.result or {}
    frames = found.get("n_frames", 0)
    parts = [f"{frames} slice{'s' * (frames != 1)}"]
    if found.get("snr"):
        parts.append(f"signal to noise {found['snr']:.0f}")
    shift_sigma_mm = row.request.get("shift_sigma_mm")
    if shift_sigma_mm and len(row.request.get("holds", ())) > 1:
        parts.append(f"shifts known to {1000 * shift_sigma_mm:.0f} µm")
    if found.get("chi2_per_dof") is not None:
        parts.append(f"χ² {found['chi2_per_dof']:.2f} per degree of freedom")
    return ", ".join(parts)


def _why_another_slice(record: CaseRecord, newest: Measurement | None) -> str:
    """What one more slice at this hold would do for the approach that runs (one fiducial)."""
    running, hold = record.running_procedure(), record.open_hold()
    if running is None or running.name != APPROACH or newest is None or hold is None:
        return ""
    found = newest.result or {}
    if tuple(newest.hold_ids) != (hold.hold_id,) or not found:
        return ""
    return why_another_slice(running, found)


def why_another_slice(running: Procedure, found: Mapping[str, Any]) -> str:
    """By the newest slices alone; the approach itself also knows the moves before."""
    arguments = running.arguments["arguments"]
    covariance = np.array(found["covariance_mm2"])
    offset = np.array(arguments["target_mm"]) - np.array(found["plane_mm"])
    tolerance_mm, confidence = arguments["tolerance_mm"], arguments["confidence"]

    def chance(estimate: FiducialEstimate) -> float:
        return probability_within(offset, estimate.covariance_mm2, tolerance_mm)

    now = FiducialEstimate({}, np.array(found["plane_mm"]), covariance)
    frames = int(found["n_frames"])
    most = int(arguments.get("most_frames", 6))
    wanted = frames_that_decide(frames, now, lambda e: chance(e) >= confidence, most)
    sigma_mm = float(np.sqrt(np.trace(covariance) / 2))
    text = f"σ {sigma_mm:.3f} mm: {100 * chance(now):.0f} % sure, {100 * confidence:.0f} % wanted"
    if wanted == frames:
        return f"{text}; more slices here would not help; a move will."
    more = wanted - frames
    slices = "one more slice" if more == 1 else f"{more} more slices"
    return f"{text}; {slices} should be enough."
