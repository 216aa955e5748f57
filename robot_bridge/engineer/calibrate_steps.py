"""How long one waveform step really is, in each direction: from readings, or measured.

A reading is a run of so many steps and the distance that the stage moved, by whatever instrument
(encoder, dial gauge, slices of the fiducial). Forward and reverse are the controller's directions.
Run lengths and frequency should be those of later use: the step depends on both, and on the load.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.daemon.motors import MotorError
from robot_bridge.pmd.driver import PmdMotors

MIN_READINGS = 2
STEP_BOUNDS_UM = (0.1, 20.0)


class CalibrationError(ValueError):
    """The readings do not make a step length; the text says which and why."""


@dataclass(frozen=True)
class StepReading:
    """steps: signed, forward positive. moved_um: signed along the axis's positive direction."""

    steps: float
    moved_um: float


@dataclass(frozen=True)
class StepLength:
    """Of one direction. scatter: standard deviation from run to run, as a fraction."""

    step_um: float
    sigma_um: float
    scatter: float
    readings: int


@dataclass(frozen=True)
class StepCalibration:
    axis: str
    forward: StepLength
    reverse: StepLength

    @property
    def asymmetry(self) -> float:
        """(forward - reverse) / mean."""
        forward_um, reverse_um = self.forward.step_um, self.reverse.step_um
        return 2 * (forward_um - reverse_um) / (forward_um + reverse_um)

    def as_fields(self) -> dict[str, object]:
        """`for_the_file`: the two step lengths as lines of the axis's table in the room's file."""
        lengths = {
            "step_um_forward": round(self.forward.step_um, 4),
            "step_um_reverse": round(self.reverse.step_um, 4),
        }
        return {
            "axis": self.axis,
            **lengths,
            "for_the_file": [f"{name} = {um}" for name, um in lengths.items()],
            "step_um_forward_sigma": round(self.forward.sigma_um, 4),
            "step_um_reverse_sigma": round(self.reverse.sigma_um, 4),
            "scatter_forward": round(self.forward.scatter, 5),
            "scatter_reverse": round(self.reverse.scatter, 5),
            "asymmetry": round(self.asymmetry, 5),
        }


def step_lengths(axis: str, sign: int, readings: Sequence[StepReading]) -> StepCalibration:
    """Weighted by run length: step = sum of distances / sum of steps, for each direction.

    Raises CalibrationError if a direction has fewer than two readings, if a reading is not finite,
    or if the stage moved against the direction that `sign` (of the configuration) says.
    """
    for number, reading in enumerate(readings, 1):
        _check_reading(axis, number, sign, reading)
    return StepCalibration(
        axis,
        _one_direction(axis, "forward", [r for r in readings if r.steps > 0]),
        _one_direction(axis, "reverse", [r for r in readings if r.steps < 0]),
    )


def _check_reading(axis: str, number: int, sign: int, reading: StepReading) -> None:
    where = f"axis {axis}, reading {number}"
    if not (math.isfinite(reading.steps) and math.isfinite(reading.moved_um)) or not reading.steps:
        raise CalibrationError(f"{where}: {reading.steps} steps, {reading.moved_um} um")
    step_um = sign * reading.moved_um / reading.steps
    if step_um < 0:
        raise CalibrationError(
            f"{where}: {reading.steps:+g} steps moved the axis {reading.moved_um:+g} um, which "
            f"contradicts its sign {sign:+d}"
        )
    low_um, high_um = STEP_BOUNDS_UM
    if not low_um <= step_um <= high_um:
        raise CalibrationError(
            f"{where}: a step of {step_um:.3g} um is outside {low_um}..{high_um} um"
        )


def _one_direction(axis: str, direction: str, readings: Sequence[StepReading]) -> StepLength:
    if len(readings) < MIN_READINGS:
        raise CalibrationError(
            f"axis {axis}: at least {MIN_READINGS} readings {direction} needed, got {len(readings)}"
        )
    step_um = sum(abs(r.moved_um) for r in readings) / sum(abs(r.steps) for r in readings)
    singles_um = [abs(r.moved_um / r.steps) for r in readings]
    variance = sum((s - step_um) ** 2 for s in singles_um) / (len(readings) - 1)
    deviation_um = math.sqrt(variance)
    sigma_um = deviation_um / math.sqrt(len(readings))
    return StepLength(step_um, sigma_um, deviation_um / step_um, len(readings))


def calibrate_steps(
    motors: PmdMotors,
    axis: AxisConfig,
    *,
    steps: int,
    runs: int,
    read_um: Callable[[str], float] | None = None,
    deadline_s: float = 60.0,
) -> StepCalibration:
    """Run `steps` forward and back, `runs` times, and measure every run.

    read_um: position along the axis from an instrument, told what for ("before +500 steps");
    without it the axis's own encoder is read. The motors must be open.
    Raises MotorError (nothing further moves) and CalibrationError.
    """
    if read_um is None and axis.drive != "closed_loop":
        raise CalibrationError(f"axis {axis.name} has no encoder: supply readings")
    where_um = read_um or (lambda what: motors.measure_um(axis.name))
    readings = []
    for run in range(2 * runs):
        signed = steps if run % 2 == 0 else -steps
        before_um = where_um(f"before {signed:+d} steps")
        _run_to_end(motors, axis.name, signed, deadline_s)
        readings.append(StepReading(signed, where_um(f"after {signed:+d} steps") - before_um))
    return step_lengths(axis.name, axis.sign, readings)


def _run_to_end(motors: PmdMotors, axis: str, steps: int, deadline_s: float) -> None:
    motors.run_steps(axis, steps)
    until_s = time.monotonic() + deadline_s
    while (status := motors.poll()).moving:
        if time.monotonic() > until_s:
            motors.stop()
            raise MotorError(
                "motion_timeout", f"axis {axis}: not finished within {deadline_s:.0f} s"
            )
        time.sleep(0.005)
    if status.fault:
        raise MotorError(status.fault, status.fault_text)
