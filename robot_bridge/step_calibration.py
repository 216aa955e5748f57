"""Straight at the controllers, for the engineer: step calibration and byte capture.

What a running bridge guards is guarded here too: the journal is held (so no bridge runs at the
same time), and neither the insertion lock nor a latched stop may be set.
"""

import contextlib
from collections.abc import Callable
from pathlib import Path

from robot_bridge.calibrate_steps import CalibrationError, StepCalibration
from robot_bridge.calibrate_steps import calibrate_steps as measure_steps
from robot_bridge.config import AxisConfig, BridgeConfig
from robot_bridge.journal import Journal
from robot_bridge.motors import MotorError
from robot_bridge.pmd401 import PmdMotors

MAX_STEPS, MIN_RUNS, MAX_RUNS = 5000, 2, 50


def motors_with_capture(config: BridgeConfig, file: Path) -> PmdMotors:
    return PmdMotors(
        config.axes,
        baud=config.controller_baud,
        timeout_s=config.controller_timeout_s,
        capture_file=file,
    )


def calibrate_steps(
    config: BridgeConfig,
    axis: AxisConfig,
    *,
    steps: int,
    runs: int,
    measure_mm: Callable[[str], float],
) -> StepCalibration:
    """Measure one axis: by its encoder if it has one, else by `measure_mm` (asked before and
    after every run, positive along the axis).

    Raises MotorError (also for what would leave the travel) and JournalError (a bridge runs).
    """
    if not 1 <= steps <= MAX_STEPS or not MIN_RUNS <= runs <= MAX_RUNS:
        raise MotorError(
            "bad_request",
            f"{runs} runs of {steps} steps: {MIN_RUNS}..{MAX_RUNS} runs, 1..{MAX_STEPS} steps",
        )
    journal = Journal(config.state_dir)
    try:
        _check_nothing_forbids(journal)
        return _measure(config, axis, steps, runs, measure_mm)
    finally:
        journal.close()


def _check_nothing_forbids(journal: Journal) -> None:
    if journal.insertion_locked:
        raise MotorError("insertion_locked", "the insertion lock is set: the needle may be in")
    if journal.stop.latched:
        raise MotorError("stop_latched", f"stop {journal.stop.number} is latched; re-arm first")


def _measure(
    config: BridgeConfig,
    axis: AxisConfig,
    steps: int,
    runs: int,
    measure_mm: Callable[[str], float],
) -> StepCalibration:
    motors = PmdMotors([axis], baud=config.controller_baud, timeout_s=config.controller_timeout_s)
    closed = axis.drive == "closed_loop"
    read_um = None if closed else (lambda what: measure_mm(what) * 1000.0)
    try:
        motors.open()
        return measure_steps(motors, axis, steps=steps, runs=runs, read_um=read_um)
    except CalibrationError as error:
        raise MotorError("calibration", str(error)) from error
    finally:
        with contextlib.suppress(MotorError):  # whatever ended it was told already
            motors.stop()
        motors.close()
