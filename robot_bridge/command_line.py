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
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from robot_bridge import sessions
from robot_bridge.__main__ import EXIT_BAD_INPUT, EXIT_COULD_NOT, EXIT_DONE, make_motors
from robot_bridge.calibrate_steps import CalibrationError, calibrate_steps
from robot_bridge.client import (
    BridgeClient,
    BridgeError,
    BridgeStatus,
    LinkLostError,
    MoveOutcome,
    RefusedError,
)
from robot_bridge.config import AxisConfig, BridgeConfig, ConfigError, load_bridge_config
from robot_bridge.framing import encode_stop
from robot_bridge.journal import JournalError
from robot_bridge.motors import MotorError
from robot_bridge.phases import WorkPhase
from robot_bridge.transport import SerialTransport, TransportError

COULD_NOT = (CalibrationError, JournalError, MotorError, OSError, TransportError)
STATUS_FILE_FRESH_S = 3.0
STOP_WAIT_S = 5.0
SHOUTS = 10
JOG_MAX_MM = 5.0
STEPS_MAX = 5000
LONGEST_STEP_UM = 8.0  # the manual's 5 +- 3 um


class UsageError(Exception):
    """The command cannot be carried out as it was given; one line."""


class CouldNotError(Exception):
    """It was tried and did not work; one line."""


@contextlib.contextmanager
def connected(args: argparse.Namespace, config: BridgeConfig) -> Iterator[BridgeClient]:
    """A client with an open session, to a running bridge or to one inside this process."""
    with contextlib.ExitStack() as stack:
        if args.direct:
            client = stack.enter_context(sessions.bridge_inside(config))
        else:
            client = _client_on_the_line(args, config)
        try:
            client.open(args.timeout)
            if args.at:
                _declare(client, args.at, args.by)
            yield client
        finally:
            client.close()


def _client_on_the_line(args: argparse.Namespace, config: BridgeConfig) -> BridgeClient:
    url = args.link or config.service_link
    if url is None:
        raise UsageError(
            f"{args.config}: bridge.service_link: is missing; name the line with --link, "
            "or talk to the motors with --direct"
        )
    return sessions.client_on_the_line(config, url)


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
    _axis_named(config, args.axis)
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
        _print(args, {"stopped": True})
        return
    client = _client_on_the_line(args, config)
    _shout_stop(args.link or str(config.service_link), config.link_baud, args.emergency)
    try:
        client.request_stop(emergency=args.emergency)
        client.open(args.timeout)
        _await_acknowledgement(client)
        _print(args, _status_fields(client.status))
    except LinkLostError as error:
        raise CouldNotError(
            f"STOP was sent {SHOUTS} times, but nobody could be heard acknowledging it ({error})"
        ) from error
    finally:
        client.close()


def _shout_stop(url: str, baud: int, emergency: bool) -> None:
    """Before anything else, session or not, and even if another program has the line."""
    line = SerialTransport(url, baud, exclusive=False)
    try:
        frame = encode_stop(secrets.randbits(32), emergency)
        for _ in range(SHOUTS):
            line.write(frame)
            time.sleep(0.01)
    except TransportError:
        return  # the client says what is wrong with the line
    finally:
        line.close()


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
        _declare(client, args.positions, args.by)
        _print(args, _status_fields(client.status))


def _declare(client: BridgeClient, texts: Sequence[str], by: str) -> None:
    """Texts like "xt=1.5"; axes that are not named stand where they say."""
    positions_um = dict(client.status.positions_um)
    for text in texts:
        axis, _, mm = text.partition("=")
        if axis not in positions_um:
            raise UsageError(f"{text!r}: {axis!r} is not one of {', '.join(positions_um)}")
        positions_um[axis] = _um_from_text(text, mm)
    client.declare_position(positions_um, by)


def _um_from_text(text: str, mm: str) -> int:
    try:
        value = float(mm)
    except ValueError:
        value = math.nan
    if not abs(value) <= 1000.0:
        raise UsageError(f"{text!r}: say AXIS=MM")
    return round(value * 1000)


def measure_steps(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Run one axis in open loop there and back; print the lines for the room's file."""
    _require_direct(args, "runs the motor in open loop")
    axis = _axis_named(config, args.axis)
    if not (1 <= args.steps <= STEPS_MAX and 2 <= args.runs <= 50):
        raise UsageError(f"--steps is 1 to {STEPS_MAX}, --runs 2 to 50")
    _confirm(args, f"run {axis.name} {args.runs} times {args.steps} steps forward and back")
    with sessions.bench(config) as (motors, journal):
        if journal.insertion_locked:
            raise CouldNotError("refused, insertion_locked: the needle may be in")
        if journal.stop.latched:
            raise CouldNotError(f"refused, stop_latched: stop {journal.stop.number}; re-arm first")
        read_um = None if axis.drive == "closed_loop" else _ask_for_um
        if read_um is None:
            _check_room_for(axis, motors.measure_um(axis.name), args.steps)
        measured = calibrate_steps(motors, axis, steps=args.steps, runs=args.runs, read_um=read_um)
    _print(args, measured.as_fields())


def _check_room_for(axis: AxisConfig, here_um: float, steps: int) -> None:
    reach_um = steps * LONGEST_STEP_UM
    if not axis.travel_min_um + reach_um <= here_um <= axis.travel_max_um - reach_um:
        raise CouldNotError(
            f"refused, beyond_travel: axis {axis.name} is at {here_um:.0f} um; {steps} steps of up "
            f"to {LONGEST_STEP_UM:g} um could leave {axis.travel_min_um}..{axis.travel_max_um} um"
        )


def _axis_named(config: BridgeConfig, name: str) -> AxisConfig:
    for axis in config.axes:
        if axis.name == name:
            return axis
    raise UsageError(f"axis {name!r} is not one of {', '.join(a.name for a in config.axes)}")


def _require_direct(args: argparse.Namespace, why: str) -> None:
    if not args.direct:
        raise UsageError(f"{args.command} {why}: it needs --direct, and no bridge running")


def _ask_for_um(what: str) -> float:
    if not sys.stdin.isatty():
        raise UsageError("an axis without encoder is measured by you: run this on a terminal")
    while True:
        with contextlib.suppress(ValueError):
            return float(input(f"{what}: gauge reading along the axis, mm: ")) * 1000.0


def capture(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Write every byte of the controllers' lines to a file while polling them."""
    _require_direct(args, "listens at the controllers (a bridge writes to bridge.capture_file)")
    with sessions.bench(config, capture_file=args.file) as (motors, _journal):
        until_s = time.monotonic() + args.seconds
        while time.monotonic() < until_s:
            motors.poll()
            time.sleep(0.02)
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
    parser.add_argument(
        "--at", action="append", metavar="AXIS=MM", help="first declare that an axis stands here"
    )
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
    add.set_defaults(do=measure_steps)
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
    except (BridgeError, CouldNotError, *COULD_NOT) as error:
        return _fail(error, EXIT_COULD_NOT)
    except KeyboardInterrupt:
        return _fail("interrupted; STOP was sent", EXIT_COULD_NOT)
    return EXIT_DONE


def _fail(error: object, code: int) -> int:
    print(f"autospine robot: {error}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
