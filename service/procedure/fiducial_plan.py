"""From the room's configuration to what procedures with one fiducial and two axes are told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from room_config.load import Config
from service.procedure.approach import ApproachArguments
from service.procedure.calibration import Calibration, CalibrationArguments
from service.procedure.identity import ProofArguments
from service.procedure.observe import ValidationGate
from service.procedure.plan import Travel, check_travel
from service.procedure.recording import RecordingArguments
from service.procedure.targets import Target, common_part_mm, fiducial_must_appear_at
from sr_engine.reconstruction.shiftset import named, paper_random

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


def calibration_of(config: Config, travel: Mapping[str, Travel], seed: int) -> CalibrationArguments:
    """From the middle of the travel; raises PlanRefusedError where that cannot be."""
    service = config.service
    origin_um = {axis: (t.min_um + t.max_um) // 2 for axis, t in travel.items()}
    move_um = round(service.calibration_move_mm * 1000)
    first, second = service.axes
    check_travel({axis: origin_um.get(axis, 0) + move_um for axis in (first, second)}, travel)
    return CalibrationArguments(
        axes=(first, second),
        origin_um=origin_um,
        move_um=move_um,
        shifts_px=_shifts_px(service.shift_set, seed),
        gate=gate_of(config),
        localization=config.imaging.localization,
    )


def approach_of(
    config: Config,
    travel_um: Mapping[str, tuple[int, int]],
    start: Calibration,
    target: Target,
    header: Mapping[str, Any],
    seed: int,
    *,
    proven: bool = False,
) -> ApproachArguments:
    """To where the fiducial must appear to be at the target. Raises TargetError.

    proven: what `start` says was seen to move with the robot.
    """
    polarity = config.imaging.readout_polarity
    row, col = fiducial_must_appear_at(target, start.plane, header, polarity).tolist()
    service = config.service
    return ApproachArguments(
        target_mm=(row, col),
        travel_um=travel_um,
        tolerance_mm=service.tolerance_mm,
        confidence=service.confidence,
        max_iterations=service.max_iterations,
        confirm_moves=service.confirm_moves,
        gate=gate_of(config),
        strategy=service.strategy,
        seed=seed,
        proven=proven,
        most_frames=service.most_slices,
        systematic_mm=common_part_mm(target, start),
    )


def recording_of(config: Config, seed: int, proof: ProofArguments) -> RecordingArguments:
    """Where the fiducial is now, by the room's strategy."""
    service = config.service
    return RecordingArguments(
        strategy=service.strategy,
        sigma_mm=service.tolerance_mm / TARGET_SHARE,
        gate=gate_of(config),
        seed=seed,
        proof=proof,
    )


def _shifts_px(name: str, seed: int) -> tuple[tuple[float, float], ...]:
    if name != "paper":
        return named(name).shifts_px
    return paper_random(np.random.default_rng(seed)).shifts_px
