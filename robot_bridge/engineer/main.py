"""The engineer's commands, `autospine robot ...`: to a running bridge or straight at the motors.

With `--link` (or bridge.service_link in the file) they speak to a running bridge; with `--direct`
they run the same bridge inside this process, over the same journal, limits and lock, so a running
daemon on the same state folder is refused. Every motion is armed for and disarmed after.

Exit codes: 0 done, 2 bad input or configuration, 3 refused or could not.
"""

import argparse
import getpass
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from robot_bridge.__main__ import EXIT_BAD_INPUT, EXIT_COULD_NOT, EXIT_DONE
from robot_bridge.client.client import BridgeError, RefusedError
from robot_bridge.daemon.config import ConfigError, load_bridge_config
from robot_bridge.daemon.journal import JournalError
from robot_bridge.daemon.motors import MotorError
from robot_bridge.engineer.at_bridge import (
    JOG_MAX_MM,
    declare,
    drives,
    home,
    jog,
    rearm,
    show_status,
    stop,
)
from robot_bridge.engineer.at_motors import accept_boards, capture, find_encoder, measure_steps
from robot_bridge.engineer.at_ports import give_address, scan_port
from robot_bridge.engineer.calibrate_steps import CalibrationError
from robot_bridge.engineer.terminal import CouldNotError, UsageError
from robot_bridge.protocol.transport import TransportError

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

COULD_NOT = (CalibrationError, JournalError, MotorError, OSError, TransportError)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="autospine robot", description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, help="the room's TOML file (not for a bare port)")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--link", help="the service's end of the line to a running bridge")
    where.add_argument("--direct", action="store_true", help="talk directly to the controllers")
    parser.add_argument("--by", default=_user(), help="who is doing this (default: the user)")
    parser.add_argument("--yes", action="store_true", help="move without asking")
    parser.add_argument(
        "--at",
        action="append",
        metavar="AXIS=MM[+-MM]",
        help="first declare the position of an axis",
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--timeout", type=float, default=8.0, help="seconds to find the bridge")
    _add_commands(parser.add_subparsers(dest="command", required=True))
    return parser


def _add_commands(commands: _Commands) -> None:
    commands.add_parser("status", help="the state of the bridge").set_defaults(do=show_status)
    add = commands.add_parser("jog", help=f"move one axis by at most {JOG_MAX_MM:g} mm")
    add.add_argument("axis")
    add.add_argument("mm", type=float)
    add.set_defaults(do=jog)
    add = commands.add_parser("stop", help="stop all motors")
    add.add_argument("--emergency", action="store_true", help="also park the drives")
    add.set_defaults(do=stop)
    commands.add_parser("rearm", help="clear a latched stop").set_defaults(do=rearm)
    add = commands.add_parser("home", help="find the reference of these axes, or of all")
    add.add_argument("axes", nargs="*", metavar="AXIS")
    add.set_defaults(do=home)
    add = commands.add_parser("declare", help="declare where the robot is")
    add.add_argument("positions", nargs="+", metavar="AXIS=MM[+-MM]")
    add.set_defaults(do=declare)
    add = commands.add_parser("calibrate-steps", help="measure the step length of one axis")
    add.add_argument("axis")
    add.add_argument("--steps", type=int, default=200)
    add.add_argument("--runs", type=int, default=3)
    add.set_defaults(do=measure_steps)
    add = commands.add_parser("find-encoder", help="let the controller find direction and gain")
    add.add_argument("axis")
    add.set_defaults(do=find_encoder)
    add = commands.add_parser("drives", help="motor power; off for imaging")
    add.add_argument("power", choices=("on", "off"))
    add.set_defaults(do=drives)
    commands.add_parser(
        "accept-boards", help="boards were exchanged on purpose: accept these as the axes' own"
    ).set_defaults(do=accept_boards)
    add = commands.add_parser("scan", help="which boards answer on a port (needs no file)")
    add.add_argument("port")
    add.add_argument("--baud", type=int, default=115200)
    add.set_defaults(at_port=scan_port)
    add = commands.add_parser("set-address", help="give a board its address (needs no file)")
    add.add_argument("port")
    add.add_argument("old", type=int)
    add.add_argument("new", type=int)
    add.add_argument("--baud", type=int, default=115200)
    add.set_defaults(at_port=give_address)
    add = commands.add_parser("capture", help="write the controllers' bytes to a file")
    add.add_argument("file", type=Path)
    add.add_argument("--seconds", type=float, default=10.0)
    add.set_defaults(do=capture)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "engineer"


def main(argv: Sequence[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    logging.getLogger("robot_bridge").setLevel(logging.ERROR)
    try:
        if "at_port" in args:
            args.at_port(args)
            return EXIT_DONE
        if args.config is None:
            raise UsageError("--config is missing: the room's TOML file")
        args.do(args, load_bridge_config(args.config))
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
