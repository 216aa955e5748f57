"""The engineer's commands, `autospine robot ...`: to a running bridge or straight at the motors.

With `--link` (or bridge.service_link in the file) they speak to a running bridge; with `--direct`
they run the same bridge inside this process, over the same journal, limits and lock, so a running
daemon on the same state folder is refused. Every motion is armed for and disarmed after.

Exit codes: 0 done, 2 bad input or configuration, 3 refused or could not.
"""

import argparse
import contextlib
import getpass
import json
import logging
import math
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from robot_bridge import step_calibration
from robot_bridge.__main__ import (
    EXIT_BAD_INPUT,
    EXIT_COULD_NOT,
    EXIT_DONE,
    make_guardian,
    make_motors,
)
from robot_bridge.client import BridgeClient, BridgeError, BridgeStatus, MoveOutcome, RefusedError
from robot_bridge.config import BridgeConfig, ConfigError, load_bridge_config
from robot_bridge.daemon import Daemon
from robot_bridge.journal import Journal, JournalError
from robot_bridge.motors import MotorError
from robot_bridge.phases import WorkPhase
from robot_bridge.transport import DescriptorTransport

STATUS_FILE_FRESH_S = 3.0
STOP_WAIT_S = 5.0
JOG_MAX_MM = 5.0


class UsageError(Exception):
    """The command cannot be carried out as it was given; one line."""


class CouldNotError(Exception):
    """It was tried and did not work; one line."""


# --- the two ways to a bridge -----------------------------------------------------------------


@contextlib.contextmanager
def connected(args: argparse.Namespace, config: BridgeConfig) -> Iterator[BridgeClient]:
    """A client with an open session, to a running bridge or to one inside this process."""
    opened = _bridge_inside(config) if args.direct else _bridge_on_the_line(args, config)
    with opened as client:
        try:
            client.open(args.timeout)
            yield client
        finally:
            client.close()


@contextlib.contextmanager
def _bridge_on_the_line(args: argparse.Namespace, config: BridgeConfig) -> Iterator[BridgeClient]:
    yield _client_on_the_line(args, config)


def _client_on_the_line(args: argparse.Namespace, config: BridgeConfig) -> BridgeClient:
    url = args.link or config.service_link
    if url is None:
        raise UsageError(
            f"{args.config}: bridge.service_link: is missing; name the line with --link, "
            "or talk to the motors with --direct"
        )
    return BridgeClient(
        url,
        name="engineer",
        baud=config.link_baud,
        heartbeat_s=config.heartbeat_s,
        deadman_s=config.deadman_s,
    )


@contextlib.contextmanager
def _bridge_inside(config: BridgeConfig) -> Iterator[BridgeClient]:
    guardian = make_guardian(config) if config.guardian else None
    near, far = socket.socketpair()
    journal = Journal(config.state_dir)
    motors = make_motors(config)
    try:
        motors.open()
        daemon = Daemon(
            config,
            motors,
            journal,
            guardian=guardian,
            open_transport=lambda: DescriptorTransport(far),
        )
    except BaseException:
        with contextlib.suppress(MotorError):
            motors.stop()
        motors.close()
        journal.close()
        if guardian is not None:
            guardian.dismiss()
        raise
    thread = threading.Thread(target=daemon.run, name="bridge")
    thread.start()
    try:
        yield BridgeClient(
            "--direct",
            name="engineer",
            heartbeat_s=config.heartbeat_s,
            deadman_s=config.deadman_s,
            open_transport=lambda: DescriptorTransport(near),
        )
    finally:
        daemon.leave("engineer's command done")
        thread.join()
        near.close()


# --- commands ---------------------------------------------------------------------------------


def show_status(args: argparse.Namespace, config: BridgeConfig) -> None:
    """The daemon's own report if it runs on this computer, else by a session."""
    if not (args.direct or args.link):
        health = _fresh_health(config.status_file)
        if health is not None:
            _print(args, health)
            return
    with connected(args, config) as client:
        _print(args, _status_fields(client.status))


def _fresh_health(path: Path) -> dict[str, object] | None:
    try:
        health = json.loads(path.read_text(encoding="utf-8"))
        fresh = time.time() - float(health["t"]) < STATUS_FILE_FRESH_S
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return health if fresh and health.get("exit_reason") is None else None


def _status_fields(status: BridgeStatus) -> dict[str, object]:
    return {
        "phase": status.phase.value,
        "armed": status.armed,
        "stopped": status.stopped,
        "stop_reason": status.stop_reason,
        "stop_count": status.stop_count,
        "insertion_locked": status.insertion_locked,
        "moving": status.moving,
        "parked": status.parked,
        "positions_um": dict(status.positions_um),
        "position_certain": status.position_certain,
        "fault": status.fault,
        "last_command": status.command_id,
        "last_command_state": status.command_state.value if status.command_state else None,
    }


def _print(args: argparse.Namespace, fields: dict[str, object]) -> None:
    if args.json:
        print(json.dumps(fields))
        return
    for name, value in fields.items():
        print(f"{name:20} {value}")


def jog(args: argparse.Namespace, config: BridgeConfig) -> None:
    axes = {axis.name: axis for axis in config.axes}
    if args.axis not in axes:
        raise UsageError(f"axis {args.axis!r} is not one of {', '.join(axes)}")
    if not 0 < abs(args.mm) <= JOG_MAX_MM:  # NaN fails this too
        raise UsageError(f"a jog is more than 0 and at most {JOG_MAX_MM} mm, not {args.mm}")
    with connected(args, config) as client:
        setpoints_um = dict(client.status.positions_um)
        setpoints_um[args.axis] += round(args.mm * 1000)
        _confirm(args, f"move {args.axis} by {args.mm:+g} mm to {setpoints_um[args.axis]} um")
        outcome = _while_armed(
            args, client, lambda: client.move(_command_id("jog"), setpoints_um, None)
        )
    _report(args, outcome)


def home(args: argparse.Namespace, config: BridgeConfig) -> None:
    with connected(args, config) as client:
        _confirm(args, "drive every axis against its reference stop")
        outcome = _while_armed(args, client, lambda: client.home(_command_id("home"), args.by))
    _report(args, outcome)


def _command_id(what: str) -> str:
    return f"engineer-{what}-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(4)}"


def _while_armed(
    args: argparse.Namespace, client: BridgeClient, do: Callable[[], MoveOutcome]
) -> MoveOutcome:
    client.set_phase(WorkPhase.MANUAL, args.by)
    client.arm(args.by)
    try:
        return do()
    except KeyboardInterrupt:
        client.request_stop()
        _await_acknowledgement(client)
        raise
    finally:
        with contextlib.suppress(BridgeError):
            client.disarm(args.by)


def _confirm(args: argparse.Namespace, what: str) -> None:
    if args.yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"about to {what}: confirm with --yes")
    if input(f"About to {what}. Needle out, hands clear? [y/N] ").strip().lower() != "y":
        raise CouldNotError("not confirmed; nothing moved")


def _report(args: argparse.Namespace, outcome: MoveOutcome) -> None:
    fields: dict[str, object] = {
        "state": outcome.state.value,
        "code": outcome.code,
        "text": outcome.text,
        "readback_um": dict(outcome.readback_um),
    }
    _print(args, fields)
    if not outcome.done:
        raise CouldNotError(f"{outcome.state.value} ({outcome.code}): {outcome.text}")


def stop(args: argparse.Namespace, config: BridgeConfig) -> None:
    if args.direct:
        _stop_directly(config)
        return
    client = _client_on_the_line(args, config)
    client.request_stop(emergency=args.emergency)  # before anything else, session or not
    try:
        client.open(args.timeout)
        _await_acknowledgement(client)
        _print(args, _status_fields(client.status))
    finally:
        client.close()


def _stop_directly(config: BridgeConfig) -> None:
    """The bytes that stop every motor, whoever else holds the ports."""
    motors = make_motors(config)
    try:
        motors.stop()
    finally:
        motors.close()


def _await_acknowledgement(client: BridgeClient) -> None:
    until_s = time.monotonic() + STOP_WAIT_S
    while not client.stop_acknowledged:
        if time.monotonic() > until_s:
            raise CouldNotError(f"STOP was not acknowledged within {STOP_WAIT_S:g} s")
        client.pump(0.02)
    client.pump(0.1)


def rearm(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Clear the latched stop. Nothing stays armed: the session ends with the command."""
    with connected(args, config) as client:
        reason = client.status.stop_reason
        if client.status.stopped:
            _confirm(args, f"clear stop {client.status.stop_count} ({reason})")
        client.rearm(args.by)
        client.disarm(args.by)
        _print(args, _status_fields(client.status))


def declare(args: argparse.Namespace, config: BridgeConfig) -> None:
    with connected(args, config) as client:
        positions_um = dict(client.status.positions_um)
        for text in args.positions:
            axis, _, mm = text.partition("=")
            if axis not in positions_um:
                raise UsageError(f"{text!r}: {axis!r} is not one of {', '.join(positions_um)}")
            positions_um[axis] = _um_from_text(text, mm)
        client.declare_position(positions_um, args.by)
        _print(args, _status_fields(client.status))


def _um_from_text(text: str, mm: str) -> int:
    try:
        value = float(mm)
    except ValueError:
        value = math.nan
    if not abs(value) <= 1000.0:
        raise UsageError(f"{text!r}: say AXIS=MM")
    return round(value * 1000)


def calibrate_steps(args: argparse.Namespace, config: BridgeConfig) -> None:
    if not args.direct:
        raise UsageError("calibrate-steps runs the motor in open loop: it needs --direct")
    wanted = [axis for axis in config.axes if axis.name == args.axis]
    if not wanted:
        names = ", ".join(axis.name for axis in config.axes)
        raise UsageError(f"axis {args.axis!r} is not one of {names}")
    _confirm(args, f"run {args.axis} {args.runs} times {args.steps} steps forward and back")
    guardian = make_guardian(config) if config.guardian else None
    try:
        measured = step_calibration.calibrate_steps(
            config, wanted[0], steps=args.steps, runs=args.runs, measure_mm=_ask_for_mm
        )
    finally:
        if guardian is not None:
            guardian.dismiss()
    _print(args, measured.as_fields())


def _ask_for_mm(what: str) -> float:
    if not sys.stdin.isatty():
        raise UsageError("an open-loop axis is measured by you: run it on a terminal")
    while True:
        try:
            return float(input(f"{what}: gauge reading in mm: "))
        except ValueError:
            print("a number, please")


def capture(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Write every byte of the controllers' lines to a file while polling them."""
    if not args.direct:
        raise UsageError(
            "capture listens at the controllers: it needs --direct (a running bridge writes its "
            "own capture to bridge.capture_file)"
        )
    motors = step_calibration.motors_with_capture(config, args.file)
    journal = Journal(config.state_dir)  # nobody else may be talking to them
    try:
        motors.open()
        until_s = time.monotonic() + args.seconds
        while time.monotonic() < until_s:
            motors.poll()
            time.sleep(0.02)
    finally:
        motors.close()
        journal.close()
    print(f"captured {args.seconds:g} s to {args.file}")


# --- arguments --------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="autospine robot", description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, required=True, help="the room's TOML file")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--link", help="the service's end of the line to a running bridge")
    where.add_argument("--direct", action="store_true", help="straight at the controllers")
    parser.add_argument("--by", default=_user(), help="who does this (default: the user)")
    parser.add_argument("--yes", action="store_true", help="move without asking")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--timeout", type=float, default=8.0, help="seconds to find the bridge")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("status", help="how the bridge stands").set_defaults(do=show_status)
    add = commands.add_parser("jog", help=f"move one axis by at most {JOG_MAX_MM:g} mm")
    add.add_argument("axis")
    add.add_argument("mm", type=float)
    add.set_defaults(do=jog)
    add = commands.add_parser("stop", help="stop all motors")
    add.add_argument("--emergency", action="store_true", help="also park the drives")
    add.set_defaults(do=stop)
    commands.add_parser("rearm", help="clear a latched stop").set_defaults(do=rearm)
    commands.add_parser("home", help="find the reference of every axis").set_defaults(do=home)
    add = commands.add_parser("declare", help="say where the robot stands")
    add.add_argument("positions", nargs="+", metavar="AXIS=MM")
    add.set_defaults(do=declare)
    add = commands.add_parser("calibrate-steps", help="measure the step length of one axis")
    add.add_argument("axis")
    add.add_argument("--steps", type=int, default=200)
    add.add_argument("--runs", type=int, default=3)
    add.set_defaults(do=calibrate_steps)
    add = commands.add_parser("capture", help="write the controllers' bytes to a file")
    add.add_argument("file", type=Path)
    add.add_argument("--seconds", type=float, default=10.0)
    add.set_defaults(do=capture)
    return parser


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "engineer"


def main(argv: Sequence[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    logging.getLogger("robot_bridge").setLevel(logging.ERROR)
    try:
        config = load_bridge_config(args.config)
        args.do(args, config)
    except (ConfigError, UsageError) as error:
        return _fail(error, EXIT_BAD_INPUT)
    except RefusedError as error:
        return _fail(f"refused, {error}", EXIT_COULD_NOT)
    except (BridgeError, CouldNotError, JournalError, MotorError, OSError) as error:
        return _fail(error, EXIT_COULD_NOT)
    except KeyboardInterrupt:
        return _fail("interrupted; STOP was sent", EXIT_COULD_NOT)
    return EXIT_DONE


def _fail(error: object, code: int) -> int:
    print(f"autospine robot: {error}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
