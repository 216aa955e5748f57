"""The engineer's commands straight at the controllers: no bridge may be running."""

import argparse
import time

from robot_bridge.__main__ import make_motors
from robot_bridge.daemon.config import AxisConfig, BridgeConfig
from robot_bridge.engineer import sessions
from robot_bridge.engineer.calibrate_steps import calibrate_steps
from robot_bridge.engineer.terminal import (
    CouldNotError,
    UsageError,
    ask_for_um,
    axis_named,
    confirm,
    show,
)

STEPS_MAX = 5000
LONGEST_STEP_UM = 8.0  # the manual's 5 +- 3 um


def stop_motors(config: BridgeConfig) -> None:
    """The bytes that stop every motor, whoever else holds the ports."""
    motors = make_motors(config)
    try:
        motors.stop()
    finally:
        motors.close()


def measure_steps(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Run one axis in open loop there and back; print the lines for the room's file."""
    _require_direct(args, "runs the motor in open loop")
    axis = axis_named(config, args.axis)
    if not (1 <= args.steps <= STEPS_MAX and 2 <= args.runs <= 50):
        raise UsageError(f"--steps is 1 to {STEPS_MAX}, --runs 2 to 50")
    confirm(args, f"run {axis.name} {args.runs} times {args.steps} steps forward and back")
    with sessions.bench(config) as (motors, journal):
        if journal.insertion_locked:
            raise CouldNotError("refused, insertion_locked: the needle may be in")
        if journal.stop.latched:
            raise CouldNotError(f"refused, stop_latched: stop {journal.stop.number}; re-arm first")
        read_um = None if axis.drive == "closed_loop" else ask_for_um
        if read_um is None:
            _check_room_for(axis, motors.measure_um(axis.name), args.steps)
        measured = calibrate_steps(motors, axis, steps=args.steps, runs=args.runs, read_um=read_um)
    show(args, measured.as_fields())


def _check_room_for(axis: AxisConfig, here_um: float, steps: int) -> None:
    reach_um = steps * LONGEST_STEP_UM
    if not axis.travel_min_um + reach_um <= here_um <= axis.travel_max_um - reach_um:
        raise CouldNotError(
            f"refused, beyond_travel: axis {axis.name} is at {here_um:.0f} um; {steps} steps of up "
            f"to {LONGEST_STEP_UM:g} um could leave {axis.travel_min_um}..{axis.travel_max_um} um"
        )


def _require_direct(args: argparse.Namespace, why: str) -> None:
    if not args.direct:
        raise UsageError(f"{args.command} {why}: it needs --direct, and no bridge running")


def capture(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Write every byte of the controllers' lines to a file while polling them."""
    _require_direct(args, "listens at the controllers (a bridge writes to bridge.capture_file)")
    with sessions.bench(config, capture_file=args.file) as (motors, _journal):
        until_s = time.monotonic() + args.seconds
        while time.monotonic() < until_s:
            motors.poll()
            time.sleep(0.02)
    print(f"captured {args.seconds:g} s to {args.file}")
