"""A Piezo LEGS motor with its stage: wrong in the ways that a real one is wrong.

One waveform step is some 4.5 um, but not always: it depends on direction, load, drive frequency
and stroke, differs from move to move, and parking shifts the stage a little. Figures: a
manufacturer's manual gives the size of a step, public measurements its fall with frequency
(13 % from 1 to 900 Hz); asymmetry, scatter and parking shift are assumptions, all adjustable. The
repeatability (14 um) is the published accuracy of the robot.
"""

import math
import random
from dataclasses import dataclass

from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP

SLIP_LOAD = 1.1  # of the stall load: the friction holds a little more than the motor can push


@dataclass(frozen=True)
class StageParameters:
    """One axis. Fractions are of one; load is in units of the stall load, positive against growth.

    step_um: at `reference_hz`, without load, mean of the two directions.
    asymmetry: (step forward - step reverse) / step, of the motor's own directions.
    load_per_mm: how much the load grows with the position (a rising stage, a spring).
    scatter: standard deviation of the step length from run to run.
    repeatability_um: standard deviation of where a run ends, beside the scatter; the encoder, if
        there is one, sees it, because it is motion.
    mounting: +1 if the axis grows when the motor runs forward, -1 if it shrinks.
    """

    step_um: float = 4.5
    asymmetry: float = 0.03
    load: float = 0.05
    load_per_mm: float = 0.0
    load_slope: float = 0.5
    frequency_slope: float = 0.045
    reference_hz: float = 1000.0
    scatter: float = 0.01
    repeatability_um: float = 14.0
    park_shift_um: float = 0.5
    travel_um: tuple[float, float] = (-30_000.0, 30_000.0)
    mounting: int = 1
    has_encoder: bool = False
    encoder_noise_um: float = 0.02

    def __post_init__(self) -> None:
        if self.mounting not in (1, -1):
            raise ValueError(f"mounting {self.mounting} is not 1 or -1")
        for name, low, high in _BOUNDS:
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} {value} is outside {low}..{high}")
        if not self.travel_um[0] < self.travel_um[1]:
            raise ValueError(f"travel_um {self.travel_um} is empty")


_BOUNDS = (
    ("step_um", 0.1, 20.0),
    ("asymmetry", -0.5, 0.5),
    ("load", -2.0, 2.0),
    ("load_per_mm", -1.0, 1.0),
    ("load_slope", 0.0, 1.0),
    ("frequency_slope", 0.0, 0.2),
    ("reference_hz", 1.0, 10_000.0),
    ("scatter", 0.0, 0.2),
    ("repeatability_um", 0.0, 1000.0),
    ("park_shift_um", 0.0, 1000.0),
    ("encoder_noise_um", 0.0, 100.0),
)

# The additive error of a run has come in full after this distance.
REPEATABILITY_DISTANCE_UM = 100.0


class PiezoLegsStage:
    """A `robot_bridge.emulator.physics.StagePhysics`; `position_um` is the axis's true position."""

    def __init__(self, parameters: StageParameters, position_um: float, rng: random.Random) -> None:
        self.parameters = parameters
        self._rng = rng
        self._position_um = position_um
        self._run_factor = 1.0
        self._run_error_um = 0.0
        self._run_travelled_um = 0.0
        self._load = parameters.load
        self._powered = False

    @property
    def position_um(self) -> float:
        return self._position_um

    def begin_run(self) -> None:
        self._run_factor = max(0.5, 1.0 + self._rng.gauss(0.0, self.parameters.scatter))
        self._run_error_um = self._rng.gauss(0.0, self.parameters.repeatability_um)
        self._run_travelled_um = 0.0

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        if microsteps == 0:
            return
        forward = 1 if microsteps > 0 else -1
        step_um = self._step_um(forward, frequency_hz) * self._run_factor
        distance_um = abs(microsteps) / MICROSTEPS_PER_STEP * step_um
        extra_um = self._share_of_error_um(distance_um)
        self._place(self._position_um + self.parameters.mounting * forward * distance_um + extra_um)

    def _share_of_error_um(self, distance_um: float) -> float:
        """Of this run's additive error, the part that comes within `distance_um`."""
        left_um = max(0.0, REPEATABILITY_DISTANCE_UM - self._run_travelled_um)
        self._run_travelled_um += distance_um
        return self._run_error_um * min(distance_um, left_um) / REPEATABILITY_DISTANCE_UM

    def _step_um(self, forward: int, frequency_hz: float) -> float:
        """Length of one waveform step; 0 beyond stall load."""
        p = self.parameters
        against = self._opposing_load(forward * p.mounting)
        if against >= 1.0:
            return 0.0
        decades = math.log10(max(frequency_hz, 0.1) / p.reference_hz)
        factor = (1.0 - p.load_slope * against) * (1.0 - p.frequency_slope * decades)
        return p.step_um * factor * (1.0 + forward * p.asymmetry / 2)

    def _opposing_load(self, axis_direction: int) -> float:
        load = self._load + self.parameters.load_per_mm * self._position_um / 1000.0
        return axis_direction * load

    def _place(self, position_um: float) -> None:
        low_um, high_um = self.parameters.travel_um
        self._position_um = min(max(position_um, low_um), high_um)

    def park(self) -> None:
        self._powered = False
        self._shift()

    def unpark(self) -> None:
        self._powered = True
        self._shift()

    def _shift(self) -> None:
        self._place(self._position_um + self._rng.gauss(0.0, self.parameters.park_shift_um))

    def displace(self, distance_um: float) -> None:
        self._place(self._position_um + distance_um)

    def apply_load(self, load: float, slip_um: float = 200.0) -> None:
        """Change the load (units of stall load); an unpowered stage slips above 1.1."""
        self._load = load
        if abs(load) > SLIP_LOAD and not self._powered:
            self.displace(-math.copysign(slip_um, load))

    def read_encoder_um(self) -> float | None:
        """In the motor's own direction, as an encoder that grows with forward motion."""
        if not self.parameters.has_encoder:
            return None
        noise_um = self._rng.gauss(0.0, self.parameters.encoder_noise_um)
        return self.parameters.mounting * self._position_um + noise_um
