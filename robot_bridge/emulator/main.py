"""`autospine emulator`: controllers with ideal stages, on a pseudo-terminal or a TCP port.

`serve` (it need not be said) prints one JSON line when it is ready: the url to give to a driver and
the control port.
`tell` sends one request to a running emulator: where, fault, line, switch, power-cycle, push.
"""

import argparse
import contextlib
import json
import random
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from robot_bridge.emulator import control
from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.control import Control
from robot_bridge.emulator.line_server import LineServer
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.server import EmulatorServer, PseudoTerminal, TcpPort, Wire, serve_until
from robot_bridge.emulator.switches import Switches

EXIT_DONE, EXIT_BAD_INPUT, EXIT_COULD_NOT = 0, 2, 3


class StageWithEnds(IdealStage):
    """An ideal stage between two hard stops."""

    def __init__(self, travel_um: float) -> None:
        super().__init__()
        self._end_um = travel_um / 2

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        super().drive(microsteps, frequency_hz)
        self._position_um = min(max(self._position_um, -self._end_um), self._end_um)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="autospine emulator", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    commands = parser.add_subparsers(dest="command", required=True)
    serve = commands.add_parser("serve", help="emulate controllers until stopped")
    serve.add_argument("--addresses", default="1,2", help="comma-separated, default 1,2")
    serve.add_argument("--model", choices=("PMD401", "PMD301"), default="PMD401")
    serve.add_argument("--serial-number", type=int, default=4010001, help="of the first board")
    serve.add_argument("--pty-path", type=Path, help="create a link to the pseudo-terminal here")
    serve.add_argument("--tcp-port", type=int, help="serve on 127.0.0.1 instead (0: any)")
    serve.add_argument("--control-port", type=int, default=0, help="on 127.0.0.1 (0: any)")
    serve.add_argument("--um-per-count", type=float, default=0.1, help="of the encoders")
    serve.add_argument(
        "--encoder-reversed", action="store_true", help="it counts down when the motor runs forward"
    )
    serve.add_argument("--index-mm", type=float, help="where the encoders have their index")
    serve.add_argument("--travel-mm", type=float, default=60.0, help="between the hard stops")
    serve.add_argument("--switches", action="store_true", help="limit switches 1 mm inside them")
    serve.add_argument("--speed-factor", type=float, default=1.0)
    tell = commands.add_parser(
        "tell",
        help="send one request to a running emulator",
        description=control.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    tell.add_argument("--control-port", type=int, required=True)
    tell.add_argument("request", nargs="+")
    return parser


def _bus_from(args: argparse.Namespace) -> EmulatedBus:
    """Raises ValueError."""
    addresses = [int(a) for a in args.addresses.split(",")]
    if len(set(addresses)) != len(addresses) or not all(0 <= a <= 126 for a in addresses):
        raise ValueError(f"--addresses {args.addresses}: must be distinct numbers from 0 to 126")
    for name, value in (("speed-factor", args.speed_factor), ("travel-mm", args.travel_mm)):
        if not 0 < value <= 1000:
            raise ValueError(f"--{name} {value} is outside 0..1000")
    if not 1e-4 <= args.um_per_count <= 1000:
        raise ValueError(f"--um-per-count {args.um_per_count} is outside 0.0001..1000")
    travel_um, switches = args.travel_mm * 1000, Switches()
    pressed_um = travel_um / 2 - 1000

    def controller(number: int, address: int) -> EmulatedController:
        motor = Motor(
            args.model,
            serial_number=args.serial_number + number,
            firmware="V13" if args.model == "PMD401" else "V20",
            um_per_count=args.um_per_count,
            encoder_reversed=args.encoder_reversed,
            index_um=None if args.index_mm is None else args.index_mm * 1000,
            switches_um=(-pressed_um, pressed_um) if args.switches else None,
        )
        stage = StageWithEnds(travel_um)
        return EmulatedController(
            address, stage, motor, switches, time.monotonic(), args.speed_factor
        )

    controllers = [controller(number, address) for number, address in enumerate(addresses)]
    return EmulatedBus(controllers, switches, random.Random(0))


def _serve(args: argparse.Namespace) -> int:
    bus = _bus_from(args)
    wire: Wire = PseudoTerminal(args.pty_path) if args.tcp_port is None else TcpPort(args.tcp_port)
    going = [True]

    def stop(signal_number: int, frame: FrameType | None) -> None:
        going[0] = False

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, stop)
    with (
        contextlib.closing(EmulatorServer(bus, wire)) as server,
        contextlib.closing(LineServer(args.control_port, Control(bus).answer)) as asked,
    ):
        ready = {"ready": True, "url": wire.url, "control_port": asked.port}
        print(json.dumps(ready), flush=True)
        serve_until(lambda: going[0], server, [asked])
    return EXIT_DONE


def _tell(args: argparse.Namespace) -> int:
    with socket.create_connection(("127.0.0.1", args.control_port), 5.0) as line:
        line.sendall(" ".join(args.request).encode() + b"\n")
        answer: dict[str, object] = json.loads(line.makefile().readline())
    print(json.dumps(answer))
    return EXIT_BAD_INPUT if "error" in answer else EXIT_DONE


def main(argv: Sequence[str] | None = None) -> int:
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0].startswith("--") and words[0] != "--help":
        words = ["serve", *words]
    args = _parser().parse_args(words)
    try:
        return _serve(args) if args.command == "serve" else _tell(args)
    except ValueError as error:
        print(f"autospine emulator: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as error:
        print(f"autospine emulator: {error}", file=sys.stderr)
        return EXIT_COULD_NOT
