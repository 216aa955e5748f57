"""The virtual room's motors as a process: emulated controllers, stages and a truth port.

`python -m simulator.motors --pty-path PATH --axes xt,yt --seed N --state FILE --truth-port 0`
prints one JSON line when ready. The bridge opens PATH like a serial port. True positions are
written to FILE at every change, so that a restart stands where it stood. The truth port (TCP on
the loopback) takes one request a line and answers one JSON line:

    where                    positions_mm, moving, moves, motion_log, t
    history T0 T1            whether and how the positions changed in that interval (epoch seconds)
    motions                  every motion begun: axis, cause, start, end, from, to
    fault AXIS NAME on|off   a fault of one controller or motor (see AxisFaults)
    line NAME NUMBER         a fault of the serial line (see LineFaults)
    switch NAME VALUE        an open question of the manual (see Switches)
    power-cycle              the controllers lose their supply
    slip AXIS MM             something pushes the stage
    load AXIS FRACTION       load in units of the stall load
    drives AXIS SHARE…       how far the stage goes for each mm that the motor of each axis drives,
                             in the order of --axes: 1 for its own and 0 for the others
    play AXIS MM             backlash between motor and stage
"""

import argparse
import contextlib
import json
import math
import os
import random
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.control import (
    RequestError,
    set_fault,
    set_line_fault,
    set_switch,
)
from robot_bridge.emulator.line_server import LineServer
from robot_bridge.emulator.server import EmulatorServer, PseudoTerminal
from robot_bridge.emulator.switches import Switches
from simulator.drive_train import DriveTrain
from simulator.motion_truth import COMMANDED, MotionTruth
from simulator.stage_physics import PiezoLegsStage, StageParameters

STANDSTILL_S = 0.05


class StateFileError(ValueError):
    """The file of true positions does not hold them."""


def read_state(path: Path, axes: Sequence[str]) -> dict[str, float]:
    """True positions by axis, mm; zeros if the file does not exist yet. Raises StateFileError."""
    if not path.exists():
        return dict.fromkeys(axes, 0.0)
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))["positions_mm"]
        positions_mm = {axis: float(stored[axis]) for axis in axes}
        if not all(map(math.isfinite, positions_mm.values())):
            raise ValueError(f"not finite: {positions_mm}")
        return positions_mm
    except (ValueError, KeyError, TypeError) as error:
        raise StateFileError(f"{path}: does not hold the positions of {axes}: {error}") from error


def write_state(path: Path, positions_mm: Mapping[str, float]) -> None:
    """Atomic: a reader sees the old or the new positions."""
    fresh = path.with_name(path.name + ".part")
    fresh.write_text(json.dumps({"positions_mm": dict(positions_mm)}), encoding="utf-8")
    os.replace(fresh, path)


@dataclass(frozen=True)
class Axis:
    name: str
    controller: EmulatedController
    stage: PiezoLegsStage


class VirtualMotors:
    """Controllers on one bus, the truth about their stages, and the requests for it."""

    def __init__(
        self,
        axes: Sequence[str],
        positions_mm: Mapping[str, float],
        parameters: Mapping[str, StageParameters],
        motor: Motor,
        seed: int,
        speed_factor: float,
        state_file: Path,
    ) -> None:
        self._state_file = state_file
        self.truth = MotionTruth(positions_mm, time.time())
        switches = Switches()
        self.axes = {
            name: self._axis(
                name, number, positions_mm[name], parameters[name], motor, switches, seed
            )
            for number, name in enumerate(axes, 1)
        }
        for axis in self.axes.values():
            axis.controller.speed_factor = speed_factor
        controllers = [axis.controller for axis in self.axes.values()]
        self.drive_train = DriveTrain(axes)
        self.bus = EmulatedBus(controllers, switches, random.Random(seed))
        write_state(state_file, positions_mm)

    def _axis(
        self,
        name: str,
        address: int,
        position_mm: float,
        parameters: StageParameters,
        motor: Motor,
        switches: Switches,
        seed: int,
    ) -> Axis:
        # The position is part of the seed, so that a restart does not repeat the same errors.
        rng = random.Random(f"{seed}/{name}/{position_mm!r}")
        stage = PiezoLegsStage(parameters, position_mm * 1000.0, rng)
        controller = EmulatedController(
            address,
            stage,
            _mounted(motor, parameters.mounting, address),
            switches,
            time.monotonic(),
            on_motion=lambda cause: self.truth.begin(name, cause, time.time()),
        )
        return Axis(name, controller, stage)

    def positions_mm(self) -> dict[str, float]:
        return {name: axis.stage.position_um / 1000.0 for name, axis in self.axes.items()}

    def observe(self) -> None:
        """After every step of the emulation: keep the truth and the file up to date."""
        now_s = time.time()
        for name, astray_mm in self.drive_train.astray_mm(self.positions_mm()).items():
            self.axes[name].stage.displace(1000.0 * astray_mm)
        positions_mm = self.positions_mm()
        self.drive_train.stands_at(positions_mm)
        if self.truth.observe(positions_mm, now_s):
            write_state(self._state_file, positions_mm)
        for name, axis in self.axes.items():
            if axis.controller.run is None:
                self.truth.end(name, now_s)

    def answer(self, request: str) -> dict[str, object]:
        """One request of the truth port. Raises RequestError."""
        word, *args = request.split()
        handlers: dict[str, Callable[..., dict[str, object]]] = {
            "where": self._where,
            "history": self._history,
            "motions": self._motions,
            "fault": self._fault,
            "line": self._line_fault,
            "switch": self._switch,
            "power-cycle": self._power_cycle,
            "slip": self._slip,
            "load": self._load,
            "drives": self._drives,
            "play": self._play,
        }
        if word not in handlers:
            raise RequestError(f"unknown request {word!r}; known: {', '.join(handlers)}")
        try:
            return handlers[word](*args)
        except TypeError:
            raise RequestError(f"{word}: wrong number of arguments ({len(args)})") from None
        except ValueError as error:
            raise RequestError(f"{word}: {error}") from error

    def _where(self) -> dict[str, object]:
        now_s = time.time()
        moving = any(axis.controller.moving for axis in self.axes.values())
        just_moved = len(self.truth.motions) > 0 and (
            now_s - self.truth.last_change_s < STANDSTILL_S
        )
        return {
            "t": now_s,
            "positions_mm": self.positions_mm(),
            "moving": moving or just_moved,
            "moves": sum(m.cause in COMMANDED for m in self.truth.motions),
            "motion_log": len(self.truth.motions),
            "parked": {name: axis.controller.parked for name, axis in self.axes.items()},
        }

    def _history(self, t0_s: str, t1_s: str) -> dict[str, object]:
        return self.truth.history(float(t0_s), float(t1_s))

    def _motions(self) -> dict[str, object]:
        return {"motions": [motion.as_dict() for motion in self.truth.motions]}

    def _named_axis(self, name: str) -> Axis:
        if name not in self.axes:
            raise RequestError(f"there is no axis {name!r}")
        return self.axes[name]

    def _fault(self, axis: str, name: str, on_off: str) -> dict[str, object]:
        set_fault(self._named_axis(axis).controller, name, on_off)
        return {"ok": True}

    def _line_fault(self, name: str, number: str) -> dict[str, object]:
        set_line_fault(self.bus, name, number)
        return {"ok": True}

    def _switch(self, name: str, text: str) -> dict[str, object]:
        set_switch(self.bus, name, text)
        return {"ok": True}

    def _power_cycle(self) -> dict[str, object]:
        for axis in self.axes.values():
            axis.controller.power_on(time.monotonic())
        return {"ok": True}

    def _slip(self, axis: str, distance_mm: str) -> dict[str, object]:
        self._named_axis(axis).stage.displace(float(distance_mm) * 1000.0)
        self.drive_train.stands_at(self.positions_mm())
        return {"ok": True}

    def _drives(self, axis: str, *shares: str) -> dict[str, object]:
        if len(shares) != len(self.axes):
            raise ValueError(f"there are {len(self.axes)} axes")
        self.drive_train.shares[self._named_axis(axis).name] = [float(share) for share in shares]
        return {"ok": True}

    def _play(self, axis: str, play_mm: str) -> dict[str, object]:
        self.drive_train.play_mm[self._named_axis(axis).name] = float(play_mm)
        return {"ok": True}

    def _load(self, axis: str, load: str) -> dict[str, object]:
        self._named_axis(axis).stage.apply_load(float(load))
        return {"ok": True}


def _mounted(motor: Motor, mounting: int, address: int) -> Motor:
    """Its own serial number, and the limit switches as its forward direction meets them."""
    switches_um = motor.switches_um
    if switches_um is not None and mounting < 0:
        switches_um = (-switches_um[1], -switches_um[0])
    return replace(
        motor,
        serial_number=motor.serial_number + address,
        switches_um=switches_um,
        mounting=mounting,
    )


class MotorsProcess:
    """One loop over the pseudo-terminal and the truth port."""

    def __init__(self, motors: VirtualMotors, pty_path: Path, truth_port: int) -> None:
        self._motors = motors
        self._truth = LineServer(truth_port, self._answer)
        self._serial = EmulatorServer(motors.bus, PseudoTerminal(pty_path))
        self.running = True

    def ready_line(self) -> str:
        ready = {"ready": True, "pty": self._serial.wire.url, "truth_port": self._truth.port}
        return json.dumps(ready)

    def _answer(self, request: str) -> str:
        try:
            return json.dumps(self._motors.answer(request))
        except RequestError as error:
            return json.dumps({"error": str(error)})

    def serve_once(self) -> None:
        wait_s = self._serial.wait_s(time.monotonic())
        watched = [*self._serial.wire.descriptors(), *self._truth.descriptors()]
        ready, _, _ = select.select(watched, [], [], wait_s)
        self._serial.serve(ready)
        self._motors.observe()
        self._truth.serve(ready)
        self._motors.observe()

    def close(self) -> None:
        self._truth.close()
        self._serial.close()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m simulator.motors", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--pty-path", type=Path, required=True)
    parser.add_argument("--axes", default="xt,yt", help="comma-separated; addresses 1, 2, ...")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--state", type=Path, required=True, help="file of the true positions")
    parser.add_argument("--truth-port", type=int, default=0, help="on 127.0.0.1; 0: any")
    parser.add_argument("--speed-factor", type=float, default=1.0)
    parser.add_argument("--exit-with-parent", action="store_true")
    parser.add_argument(
        "--reversed", default="", help="axes whose motor is mounted the other way round"
    )
    parser.add_argument("--encoder-um-per-count", type=float, help="fit encoders")
    parser.add_argument(
        "--switches-mm", help="LOW,HIGH: true positions at which limit switches are pressed"
    )
    parser.add_argument("--step-um", type=float, default=StageParameters.step_um)
    parser.add_argument("--asymmetry", type=float, default=StageParameters.asymmetry)
    parser.add_argument("--scatter", type=float, default=StageParameters.scatter)
    parser.add_argument("--load", type=float, default=StageParameters.load)
    parser.add_argument("--repeatability-um", type=float, default=StageParameters.repeatability_um)
    parser.add_argument("--model", choices=("PMD401", "PMD301"), default="PMD401")
    return parser


def _motors_from(args: argparse.Namespace) -> VirtualMotors:
    if not 0 < args.speed_factor <= 1000:
        raise ValueError(f"--speed-factor {args.speed_factor} is outside 0..1000")
    axes = args.axes.split(",")
    if len(set(axes)) != len(axes) or not all(axes):
        raise ValueError(f"--axes {args.axes!r}: names are empty or not unique")
    encoder_um = args.encoder_um_per_count
    if encoder_um is not None and not 1e-4 <= encoder_um <= 1000:
        raise ValueError(f"--encoder-um-per-count {encoder_um} is outside 0.0001..1000 um")
    parameters = StageParameters(
        step_um=args.step_um,
        asymmetry=args.asymmetry,
        scatter=args.scatter,
        load=args.load,
        repeatability_um=args.repeatability_um,
        has_encoder=encoder_um is not None,
    )
    reversed_axes = set(args.reversed.split(",")) - {""}
    if unknown := reversed_axes - set(axes):
        raise ValueError(f"--reversed: {', '.join(sorted(unknown))} is not among --axes")
    each = {axis: replace(parameters, mounting=-1 if axis in reversed_axes else 1) for axis in axes}
    firmware = "V13" if args.model == "PMD401" else "V20"
    motor = Motor(args.model, firmware=firmware, um_per_count=encoder_um or 0.1)
    if args.switches_mm:
        low_mm, high_mm = map(float, args.switches_mm.split(","))
        motor = replace(motor, switches_um=(low_mm * 1000, high_mm * 1000))
    positions_mm = read_state(args.state, axes)
    return VirtualMotors(axes, positions_mm, each, motor, args.seed, args.speed_factor, args.state)


def _serve(process: MotorsProcess, exit_with_parent: bool) -> None:
    parent = os.getppid()

    def stop(signal_number: int, frame: FrameType | None) -> None:
        process.running = False

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    print(process.ready_line(), flush=True)
    while process.running and not (exit_with_parent and os.getppid() != parent):
        process.serve_once()


def main(argv: Sequence[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    try:
        process = MotorsProcess(_motors_from(args), args.pty_path, args.truth_port)
    except (ValueError, OSError) as error:
        print(f"simulator.motors: {error}", file=sys.stderr)
        return 2
    with contextlib.closing(process):
        _serve(process, args.exit_with_parent)
    return 0


if __name__ == "__main__":
    sys.exit(main())
