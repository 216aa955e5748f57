"""Boards on a port that nobody has configured yet: who answers, and giving an address.

Blocking, for an engineer at the bench. Every board leaves the factory with address 0, and two with
the same address answer at once, which is no answer; so they are connected one after the other.
"""

import re
import time
from dataclasses import dataclass

from robot_bridge.daemon.motors import MotorError
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd.line import PmdLine, Port, Procedure
from robot_bridge.pmd.protocol import BROADCAST_ADDRESS, MAX_ADDRESS, Command, LineReader, PmdError

ALL_ANSWER_S = 0.5  # 2 ms an address, and the 300 ms of silence after a broadcast
ANSWER_S = 0.3
FACTORY_ADDRESS = 0


@dataclass(frozen=True)
class Board:
    address: int
    identity: str
    serial_number: str

    def as_fields(self) -> dict[str, object]:
        return {
            "address": self.address,
            "identity": self.identity,
            "serial_number": self.serial_number,
        }


def scan(port: Port) -> list[Board]:
    """All boards that answer to their address on this port. Raises MotorError, OSError."""
    port.write(b"\x1b;")
    port.reset_input_buffer()
    port.write(f"X{BROADCAST_ADDRESS}\r".encode("ascii"))
    reader, lines = LineReader(), []
    until_s = time.monotonic() + ALL_ANSWER_S
    while time.monotonic() < until_s:
        lines += reader.feed(port.read(256))
    pinged = (re.fullmatch(r"X(\d*)", line) for line in lines)
    addresses = {int(match[1] or 0) for match in pinged if match}
    addresses.discard(BROADCAST_ADDRESS)  # an adapter that echoes
    addresses.add(FACTORY_ADDRESS)  # a board that does not know the broadcast
    bus = PmdLine(port, ANSWER_S)
    found = [board for address in sorted(addresses) if (board := _board(bus, address))]
    if not found and reader.bad_lines:
        raise MotorError(
            "protocol", "unreadable answers: two boards with the same address, or noise"
        )
    return found


def _board(line: PmdLine, address: int) -> Board | None:
    answers: dict[str, str] = {}

    def ask() -> Procedure:
        for name in ("?", "Y42"):
            reply = yield pmd_protocol.read(address, name)
            answers[name] = reply.value if reply else ""

    try:
        line.run(ask(), f"question to address {address}", time.monotonic() + 10 * ANSWER_S)
    except PmdError:
        if "?" not in answers:
            return None
    return Board(address, answers["?"], answers.get("Y42", "").partition(",")[0].strip())


def set_address(port: Port, old: int, new: int) -> Board:
    """Give the board at `old` the address `new`, in flash too. Raises MotorError, OSError."""
    if not (0 <= old <= MAX_ADDRESS and 0 <= new <= MAX_ADDRESS) or old == new:
        raise MotorError(
            "bad_address",
            f"from address {old} to {new}: two different addresses of 0..{MAX_ADDRESS} are needed",
        )
    line = PmdLine(port, ANSWER_S)
    board = _board(line, old)
    if board is None:
        raise MotorError("no_answer", f"no board answers at address {old}")
    if _board(line, new) is not None:
        raise MotorError("address_taken", f"another board already answers at address {new}")
    saved: list[str] = []

    def give() -> Procedure:
        yield Command(old, f"Y40,{new}", reads=False)
        reply = yield pmd_protocol.read(new, "Y32")
        saved.append(reply.value if reply else "")

    try:
        line.run(give(), f"new address {new}", time.monotonic() + 10 * ANSWER_S)
    except PmdError as error:
        raise MotorError("protocol", f"the board did not take address {new}: {error}") from error
    if not re.match(r"0\b.*Flash OK", saved[0]):
        raise MotorError("flash", f"address {new} was not stored in flash: '{saved[0]}'")
    moved = _board(line, new)
    if moved is None or moved.serial_number != board.serial_number:
        raise MotorError("protocol", f"the board does not answer at address {new}")
    return moved
