"""The engineer's commands at a port that no file names yet: who answers, and new addresses."""

import argparse
import contextlib
from collections.abc import Iterator

from robot_bridge.engineer.terminal import CouldNotError, confirm, show
from robot_bridge.pmd.discovery import FACTORY_ADDRESS, Board, scan, set_address
from robot_bridge.pmd.ports import SerialPort


@contextlib.contextmanager
def _port(args: argparse.Namespace) -> Iterator[SerialPort]:
    """Held alone: a bridge that has it is not disturbed. Raises OSError."""
    port = SerialPort(args.port, args.baud)
    try:
        yield port
    finally:
        port.close()


def scan_port(args: argparse.Namespace) -> None:
    """Who answers on a port. Nothing moves and nothing is changed."""
    with _port(args) as port:
        boards = scan(port)
    if not boards:
        raise CouldNotError(
            f"no board answers on {args.port}: check supply, cable and baud rate (115200). Two "
            "boards with the same address answer at once: connect them one at a time"
        )
    fields: dict[str, object] = {"boards": [board.as_fields() for board in boards]}
    if hint := _hint(boards):
        fields["hint"] = hint
    show(args, fields)


def _hint(boards: list[Board]) -> str:
    if any(board.address == FACTORY_ADDRESS for board in boards):
        return (
            "a board answers at 0, the factory address: before adding another to this bus, give "
            "it its own with `set-address PORT 0 NEW`"
        )
    return ""


def give_address(args: argparse.Namespace) -> None:
    confirm(args, f"change address {args.old} to {args.new} on {args.port}, in flash")
    with _port(args) as port:
        board = set_address(port, args.old, args.new)
    show(args, board.as_fields())
