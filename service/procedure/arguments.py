"""From the room's configuration and the case's points to what its procedures are told.

guide: of a room with two fiducials and four axes; None: one fiducial and two axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from room_config.load import Config
from room_config.service import GuideConfig
from service.procedure.aim import ApproachArguments
from service.procedure.calibration import Calibration, CalibrationArguments
from service.procedure.fiducials import ONE_FIDUCIAL, Geometry, GuideGeometry
from service.procedure.identity import ProofArguments
from service.procedure.observe import ValidationGate
from service.procedure.plan import Travel, check_travel
from service.procedure.recording import RecordingArguments
from service.procedure.targets import (
    Target,
    TargetError,
    common_cancels,
    common_part_mm,
    fiducial_must_appear_at,
    needle_line,
    oil_shift_mm,
)
from sr_engine.reconstruction.shiftset import named, paper_random

Point = tuple[float, float, float]
# a recorded target is to be known this much better than it must be reached
TARGET_SHARE = 5


def gate_of(config: Config) -> ValidationGate:
    """Which measurements the room believes."""
    return ValidationGate(
        position_gate_mm=config.imaging.position_gate_mm,
        gate_sigma=config.service.prediction_gate_sigma,
        repeatability_mm=config.service.repeatability_um / 1000,
        scale_error=config.service.step_scale_error,
    )


def geometry_of(guide: GuideConfig) -> GuideGeometry:
    """The guide as it is configured."""
    return GuideGeometry(
        guide.upper_fiducial_mm,
        guide.lower_fiducial_mm,
        abs(guide.upper_plane_mm - guide.lower_plane_mm),
        (guide.upper_slice_mm, guide.lower_slice_mm),
    )


def calibration_of(
    config: Config, guide: GuideConfig | None, travel: Mapping[str, Travel], seed: int
) -> CalibrationArguments:
    """Every axis from its `calibration_origin_um`; raises PlanRefusedError where that cannot be."""
    driven = guide or config.service
    move_um = round(driven.calibration_move_mm * 1000)
    origin_um = {axis: calibration_origin_um(t, move_um) for axis, t in travel.items()}
    check_travel({axis: origin_um.get(axis, 0) + move_um for axis in driven.axes}, travel)
    return CalibrationArguments(
        axes=tuple(driven.axes),
        origin_um=origin_um,
        move_um=move_um,
        shifts_px=() if guide else _shifts_px(config.service.shift_set, seed),
        gate=gate_of(config),
        localization=config.imaging.localization,
        geometry=geometry_of(guide) if guide else ONE_FIDUCIAL,
    )


def calibration_origin_um(travel: Travel, move_um: int) -> int:
    """The middle of an axis's travel, or as near to it as leaves room for the move."""
    low_um, high_um = travel.min_um - min(move_um, 0), travel.max_um - max(move_um, 0)
    middle_um = (travel.min_um + travel.max_um) // 2
    return min(max(middle_um, low_um), high_um) if low_um <= high_um else middle_um


def approach_of(
    config: Config,
    guide: GuideConfig | None,
    travel: Mapping[str, Travel],
    start: Calibration,
    entry_mm: Point | None,
    target: Target,
    header: Mapping[str, Any],
    seed: int,
    *,
    proven: bool = False,
) -> ApproachArguments:
    """To where the fiducial must appear to be at the target, or to the line from entry to target.

    The needle's tip is judged at the target. proven: what `start` says was seen to move with the
    robot. Raises TargetError.
    """
    service = config.service
    geometry: Geometry = ONE_FIDUCIAL
    if guide is None:
        polarity = config.imaging.readout_polarity
        wanted = fiducial_must_appear_at(target, start.plane, header, polarity)
    else:
        geometry, wanted = _guide_on_line(config, guide, start, entry_mm, target, header)
    return ApproachArguments(
        target_mm=tuple(wanted.tolist()),
        travel_um={axis: (t.min_um, t.max_um) for axis, t in travel.items()},
        tolerance_mm=(guide or service).tolerance_mm,
        confidence=service.confidence,
        max_iterations=service.max_iterations,
        confirm_moves=service.confirm_moves,
        gate=gate_of(config),
        strategy="adaptive" if guide else service.strategy,
        seed=seed,
        proven=proven,
        most_frames=service.most_slices,
        systematic_mm=common_part_mm(target, start),
        common_cancels=common_cancels(target, start),
        geometry=geometry,
        lower_plane_mm=guide.lower_plane_mm if guide else 0.0,
    )


def _guide_on_line(
    config: Config,
    guide: GuideConfig,
    start: Calibration,
    entry_mm: Point | None,
    target: Target,
    header: Mapping[str, Any],
) -> tuple[GuideGeometry, NDArray[np.float64]]:
    """The guide with its tip at the target, and its state (4,) on the line from entry to target."""
    if entry_mm is None:
        raise TargetError("the needle's direction is not known: no entry point is set")
    line = needle_line(
        entry_mm, target.patient_mm, start.plane, guide.lower_plane_mm, guide.upper_plane_mm
    )
    if not line.depth_mm <= guide.needle_reach_mm:
        raise TargetError(
            f"it lies {line.depth_mm:.1f} mm below the lower ball joint; the needle reaches "
            f"{guide.needle_reach_mm:g} mm"
        )
    geometry = replace(geometry_of(guide), tip_beyond_mm=line.depth_mm)
    oil_shift = None
    if target.in_water:
        polarity = config.imaging.readout_polarity
        oil_shift = oil_shift_mm(header, start.plane.spacing_mm, polarity)
    return geometry, line.state(geometry, start.plane, oil_shift)


def recording_of(
    config: Config, guide: GuideConfig | None, seed: int, proof: ProofArguments
) -> RecordingArguments:
    """Where the fiducial is now, by the room's strategy; or where the guide points, the tip judged
    where a target usually lies.
    """
    service = config.service
    return RecordingArguments(
        strategy="adaptive" if guide else service.strategy,
        sigma_mm=(guide or service).tolerance_mm / TARGET_SHARE,
        gate=gate_of(config),
        seed=seed,
        proof=proof,
        geometry=geometry_of(guide) if guide else ONE_FIDUCIAL,
        lower_plane_mm=guide.lower_plane_mm if guide else 0.0,
    )


def _shifts_px(name: str, seed: int) -> tuple[tuple[float, float], ...]:
    if name != "paper":
        return named(name).shifts_px
    return paper_random(np.random.default_rng(seed)).shifts_px
