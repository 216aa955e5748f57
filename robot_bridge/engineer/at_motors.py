"""The engineer's commands directly to the controllers: no bridge may be running."""

import argparse
import contextlib
import time

from robot_bridge.__main__ import make_motors
from robot_bridge.daemon.config import AxisConfig, BridgeConfig
from robot_bridge.daemon.journal import Journal, JournalError, LatchedStop
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
from robot_bridge.pmd.encoder_script import SCRIPT_STEPS
from robot_bridge.protocol.messages import Code

STEPS_MAX = 5000
POWER_WAIT_S = 5.0
LONGEST_STEP_UM = 8.0  # the manual's 5 +- 3 um


def stop_motors(args: argparse.Namespace, config: BridgeConfig) -> dict[str, object]:
    """Stop every motor, whoever else holds the ports; EMERGENCY parks and latches as well."""
    motors = make_motors(config, exclusive=False)
    try:
        if not args.emergency:
            motors.stop()
            return {"stopped": True}
        motors.park_now()
    finally:
        motors.close()
    return {"stopped": True, "parked": True, "latched": _latch_emergency(config, args.by)}


def _latch_emergency(config: BridgeConfig, by: str) -> bool:
    """Raises CouldNotError, with the motors parked, if a bridge has the journal."""
    try:
        journal = Journal(config.state_dir)
    except JournalError as error:
        raise CouldNotError(
            f"stopped and parked, but NOT latched ({error}): if a bridge is running, use `stop "
            "--emergency` without --direct"
        ) from error
    try:
        number = journal.stop.number + 1
        stop = LatchedStop(number, Code.EMERGENCY_STOP.value, True, True)
        journal.latch_stop(stop, f"by {by}, directly at the controllers", time.time())
    finally:
        journal.close()
    return True


def find_encoder(args: argparse.Namespace, config: BridgeConfig) -> None:
    """The controller's script: direction and gain of an encoder, as lines for the room's file."""
    _require_direct(args, "runs the controller's own script")
    axis = axis_named(config, args.axis)
    confirm(args, f"run {axis.name} by 16 steps (about 0.07 mm) back and forth")
    with sessions.bench(config) as (motors, journal):
        _refuse_if_held(journal)
        _check_room_for(axis, motors.measure_um(axis.name), SCRIPT_STEPS)
        _forget(journal, axis)
        found = motors.find_encoder(axis.name)
    step_um = (axis.step_um_forward + axis.step_um_reverse) / 2
    show(
        args,
        {
            "axis": axis.name,
            "encoder_direction": found.direction,
            "counts_per_step": round(found.counts_per_step, 3),
            "step_um_if_counts_are_right": round(
                found.counts_per_step * 1000 / axis.counts_per_mm, 3
            ),
            "counts_per_mm_if_steps_are_right": round(found.counts_per_step * 1000 / step_um, 1),
            "for_the_file": [f"encoder_direction = {found.direction}"],
        },
    )


def what_boards_say(config: BridgeConfig) -> dict[str, object]:
    """Who they are, their supply and temperature, and what they do not answer."""
    with sessions.bench(config) as (motors, _journal):
        until_s = time.monotonic() + POWER_WAIT_S
        while len((status := motors.poll()).supply) < len(config.axes):
            if time.monotonic() > until_s or status.fault:
                break
            time.sleep(0.02)
    return {
        "boards": dict(status.boards),
        "supply": {axis: dict(supply) for axis, supply in status.supply.items()},
        "warnings": list(status.warnings),
    }


def drives_directly(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Power of the motors off or on, with no bridge running."""
    with sessions.bench(config) as (motors, journal):
        if args.power == "on":
            _refuse_if_held(journal)
            motors.unpark()
        else:
            motors.park()
        until_s = time.monotonic() + POWER_WAIT_S
        while (status := motors.poll()).parked is (args.power == "on"):
            if time.monotonic() > until_s:
                raise CouldNotError(f"the drives are not {args.power} after {POWER_WAIT_S:g} s")
            time.sleep(0.02)
    show(args, {"parked": status.parked})


def accept_boards(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Boards were exchanged on purpose: these ones drive the axes from now on."""
    _require_direct(args, "asks the boards for their identity")
    confirm(args, "accept the boards that answer now as the axes' own, and forget the old ones")
    with contextlib.closing(Journal(config.state_dir)) as journal:
        motors = make_motors(config)
        try:
            boards = dict(motors.open().boards)
        finally:
            motors.close()
        journal.tie_boards(boards, time.time())
        journal.keep_stands({}, time.time(), ())  # another board, another count
    show(args, {"boards": boards})


def _refuse_if_held(journal: Journal) -> None:
    if journal.insertion_locked:
        raise CouldNotError("refused, insertion_locked: the needle may be in")
    if journal.stop.latched:
        raise CouldNotError(f"refused, stop_latched: stop {journal.stop.number}; re-arm first")


def _forget(journal: Journal, axis: AxisConfig) -> None:
    """It is moved by something that no bridge counts."""
    stands = {name: stand for name, stand in journal.stands.items() if name != axis.name}
    journal.keep_stands(stands, time.time(), journal.settled.keys() & stands.keys())


def measure_steps(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Run one axis in open loop there and back; print the lines for the room's file."""
    _require_direct(args, "runs the motor in open loop")
    axis = axis_named(config, args.axis)
    if not (1 <= args.steps <= STEPS_MAX and 2 <= args.runs <= 50):
        raise UsageError(f"--steps is 1 to {STEPS_MAX}, --runs 2 to 50")
    confirm(args, f"run {axis.name} {args.runs} times {args.steps} steps forward and back")
    with sessions.bench(config) as (motors, journal):
        _refuse_if_held(journal)
        read_um = None if axis.drive == "closed_loop" else ask_for_um
        if read_um is None:
            _check_room_for(axis, motors.measure_um(axis.name), args.steps)
        _forget(journal, axis)
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
        raise UsageError(f"{args.command} {why}: it needs --direct, with no bridge running")


def capture(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Write every byte of the controllers' lines to a file while polling them."""
    _require_direct(
        args, "listens directly to the controllers (a bridge writes to bridge.capture_file)"
    )
    with sessions.bench(config, capture_file=args.file) as (motors, _journal):
        until_s = time.monotonic() + args.seconds
        while time.monotonic() < until_s:
            motors.poll()
            time.sleep(0.02)
    print(f"captured {args.seconds:g} s to {args.file}")
