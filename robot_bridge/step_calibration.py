"""Measure how long a step is, per direction: the numbers step_um_forward and step_um_reverse.

Runs one axis in open loop, a number of steps forward and the same back, several times. With an
encoder the controller's count tells the distance; without one a gauge and a person do.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from robot_bridge.config import AxisConfig, BridgeConfig
from robot_bridge.journal import Journal
from robot_bridge.motors import MotorError
from robot_bridge.pmd401 import PmdMotors, open_serial_port
from robot_bridge.pmd_axis import PmdAxis
from robot_bridge.pmd_line import PmdLine, Procedure
from robot_bridge.pmd_protocol import MICROSTEPS_PER_STEP, PmdError, emergency_stop_bytes, read
from robot_bridge.pmd_units import um_from_count

LONGEST_STEP_UM = 8.0  # the manual's 5 +- 3 um
DEADLINE_S = 60.0
MAX_STEPS = 5000


@dataclass(frozen=True)
class StepLengths:
    """um a wfm-step, mean and standard deviation over the runs (0 for a single run)."""

    axis: str
    steps: int
    forward_um: tuple[float, ...]
    reverse_um: tuple[float, ...]

    def as_fields(self) -> dict[str, object]:
        return {
            "axis": self.axis,
            "steps": self.steps,
            "step_um_forward": round(statistics.mean(self.forward_um), 4),
            "step_um_forward_sd": round(_sd(self.forward_um), 4),
            "step_um_reverse": round(statistics.mean(self.reverse_um), 4),
            "step_um_reverse_sd": round(_sd(self.reverse_um), 4),
        }


def _sd(values: tuple[float, ...]) -> float:
    return statistics.stdev(values) if len(values) > 1 else 0.0


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
) -> StepLengths:
    """Raises MotorError (also for what would leave the travel) and JournalError (bridge runs)."""
    if not 1 <= steps <= MAX_STEPS or not 1 <= runs <= 50:
        raise MotorError("bad_request", f"{runs} runs of {steps} steps: 1..50 runs, 1..5000 steps")
    journal = Journal(config.state_dir)
    try:
        if journal.insertion_locked:
            raise MotorError("insertion_locked", "the insertion lock is set: the needle may be in")
        if journal.stop.latched:
            raise MotorError("stop_latched", f"stop {journal.stop.number} is latched; re-arm first")
        return _measure(config, axis, steps, runs, measure_mm)
    finally:
        journal.close()


def _measure(
    config: BridgeConfig,
    axis: AxisConfig,
    steps: int,
    runs: int,
    measure_mm: Callable[[str], float],
) -> StepLengths:
    try:
        port = open_serial_port(axis.controller, config.controller_baud)
    except (OSError, ValueError) as error:
        raise MotorError("no_port", f"controller port {axis.controller}: {error}") from error
    bench = _Bench(PmdLine(port, config.controller_timeout_s), PmdAxis(axis), measure_mm)
    try:
        bench.prepare(steps)
        forward, reverse = [], []
        for _ in range(runs):
            forward.append(bench.run_um(steps) / steps)
            reverse.append(-bench.run_um(-steps) / steps)
        return StepLengths(axis.name, steps, tuple(forward), tuple(reverse))
    except PmdError as error:
        raise MotorError("calibration", str(error)) from error
    finally:
        port.write(emergency_stop_bytes([axis.address]))
        port.close()


class _Bench:
    """One axis on its line, and how far it went."""

    def __init__(self, line: PmdLine, axis: PmdAxis, measure_mm: Callable[[str], float]) -> None:
        self._line, self._axis, self._measure_mm = line, axis, measure_mm

    def prepare(self, steps: int) -> None:
        config = self._axis.config
        self._do(self._axis.initialise(), "initialisation")
        self._do(self._axis.unpark(), "unparking")
        if not self._axis.closed_loop:
            return  # the person at the gauge sees the room there is
        reach_um = steps * LONGEST_STEP_UM
        here_um = self._axis.position_um
        if not (config.travel_min_um + reach_um <= here_um <= config.travel_max_um - reach_um):
            raise MotorError(
                "beyond_travel",
                f"axis {config.name}: at {here_um:.0f} um, {steps} steps of up to "
                f"{LONGEST_STEP_UM:g} um could leave {config.travel_min_um}.."
                f"{config.travel_max_um} um",
            )

    def _do(self, procedure: Procedure, what: str) -> None:
        self._line.run(procedure, what, time.monotonic() + DEADLINE_S)

    def run_um(self, steps: int) -> float:
        """How far `steps` moved the motor; both are positive in the controller's forward."""
        before_um = self._where_um(f"before {steps:+d} steps")
        self._do(self._axis.run_open_loop(steps * MICROSTEPS_PER_STEP), "run")
        return (self._where_um(f"after {steps:+d} steps") - before_um) * self._axis.config.sign

    def _where_um(self, what: str) -> float:
        if not self._axis.closed_loop:
            return self._measure_mm(what) * 1000.0
        counts: list[int] = []
        self._do(_read_count(self._axis.address, counts), "reading the encoder")
        return um_from_count(self._axis.config, counts[0])


def _read_count(address: int, counts: list[int]) -> Procedure:
    reply = yield read(address, "E")
    assert reply is not None  # the line answers every command
    counts.append(reply.integer())
