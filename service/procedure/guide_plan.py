"""From the room's configuration and the case's points to what four-axis procedures are told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from room_config.load import Config
from room_config.service import GuideConfig
from service.procedure.calibration import Calibration
from service.procedure.fiducial_plan import TARGET_SHARE, gate_of
from service.procedure.guide_approach import GuideApproachArguments
from service.procedure.guide_calibration import GuideCalibrationArguments
from service.procedure.guide_geometry import GuideGeometry
from service.procedure.guide_recording import GuideRecordingArguments
from service.procedure.identity import ProofArguments
from service.procedure.plan import Travel, check_travel
from service.procedure.targets import Target, TargetError, common_part_mm, needle_line, oil_shift_mm


def geometry_of(guide: GuideConfig) -> GuideGeometry:
    """The guide as it is configured."""
    return GuideGeometry(
        guide.upper_fiducial_mm,
        guide.lower_fiducial_mm,
        abs(guide.upper_plane_mm - guide.lower_plane_mm),
        (guide.upper_slice_mm, guide.lower_slice_mm),
    )


def guide_calibration_of(
    config: Config, guide: GuideConfig, travel: Mapping[str, Travel]
) -> GuideCalibrationArguments:
    """Every axis from the middle of its travel; raises PlanRefusedError where that cannot be."""
    origin_um = {axis: (t.min_um + t.max_um) // 2 for axis, t in travel.items()}
    move_um = round(guide.calibration_move_mm * 1000)
    check_travel({axis: origin_um.get(axis, 0) + move_um for axis in guide.axes}, travel)
    xt, yt, xb, yb = guide.axes
    return GuideCalibrationArguments(
        axes=(xt, yt, xb, yb),
        origin_um=origin_um,
        move_um=move_um,
        geometry=geometry_of(guide),
        gate=gate_of(config),
        localization=config.imaging.localization,
    )


def guide_recording_of(
    config: Config, guide: GuideConfig, proof: ProofArguments
) -> GuideRecordingArguments:
    """Where the guide points now, the tip judged where a target usually lies."""
    return GuideRecordingArguments(
        geometry=geometry_of(guide),
        lower_plane_mm=guide.lower_plane_mm,
        sigma_mm=guide.tolerance_mm / TARGET_SHARE,
        gate=gate_of(config),
        proof=proof,
    )


def guide_approach_of(
    config: Config,
    guide: GuideConfig,
    travel: Mapping[str, Travel],
    start: Calibration,
    entry_mm: tuple[float, float, float],
    target: Target,
    header: Mapping[str, Any],
    *,
    proven: bool = False,
) -> GuideApproachArguments:
    """To the line from entry to target, the tip judged at the target. Raises TargetError."""
    line = needle_line(
        entry_mm, target.patient_mm, start.plane, guide.lower_plane_mm, guide.upper_plane_mm
    )
    if not line.depth_mm <= guide.needle_reach_mm:
        raise TargetError(
            f"it lies {line.depth_mm:.1f} mm below the lower ball joint; the needle reaches "
            f"{guide.needle_reach_mm:g} mm"
        )
    geometry = replace(geometry_of(guide), tip_beyond_mm=line.depth_mm)
    oil_shift: NDArray[np.float64] | None = None
    if target.in_water:
        polarity = config.imaging.readout_polarity
        oil_shift = oil_shift_mm(header, start.plane.spacing_mm, polarity)
    upper_row, upper_col, row, col = line.state(geometry, start.plane, oil_shift).tolist()
    service = config.service
    return GuideApproachArguments(
        geometry=geometry,
        lower_plane_mm=guide.lower_plane_mm,
        target_mm=(upper_row, upper_col, row, col),
        travel_um={axis: (t.min_um, t.max_um) for axis, t in travel.items()},
        tolerance_mm=guide.tolerance_mm,
        confidence=service.confidence,
        max_iterations=service.max_iterations,
        confirm_moves=service.confirm_moves,
        gate=gate_of(config),
        proven=proven,
        most_frames=service.most_slices,
        systematic_mm=common_part_mm(target, start),
    )
