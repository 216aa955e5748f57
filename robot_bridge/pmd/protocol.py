"""The ASCII protocol of PiezoMotor PMD401 and PMD301 controllers: bytes in, replies out, no I/O.

A command is `X<address><body><CR>`. A set command is answered by its own echo, a read command by
its echo, a colon and a value. References: PMD401 manual 150025-01 and PMD301 manual 150024-00,
section 4.2; where the two are silent, the reader here accepts what either reading would send:
replies may end in CR or LF, hex digits may have either case, an answer may carry a description.
"""

import re
from dataclasses import dataclass
from typing import Literal

BROADCAST_ADDRESS = 127
MAX_ADDRESS = 126
MICROSTEPS_PER_STEP = 8192  # one waveform step
SPEED_PARAMETER_PER_COUNT = 32  # Y11 = 32 x microsteps a count
MAX_LINE_BYTES = 2048  # the longest answer (100 logged positions) is some 1200
I32_MIN, I32_MAX = -(2**31), 2**31 - 1


class PmdError(Exception):
    """Something about a controller or its line; the text names axis address and command."""


class PmdReplyError(PmdError):
    """The controller's answer was received but makes no sense (remote fault)."""


class PmdTimeoutError(PmdError):
    """No whole answer came in time (line or controller)."""


class PmdNoValueError(PmdTimeoutError):
    """Something else came, every time: the board lives, and does not know the command."""


class PmdSyntaxError(PmdError):
    """The controller did not understand the command (`_??_`)."""


class PmdEchoError(PmdError):
    """A controller echoed what was not asked for: a command was damaged on the line.

    Raised for what moves a motor or sets its position; other damage is only a missing answer.
    """


class PmdRefusedError(PmdError):
    """The controller understood and cannot do it now (`!`); a parked motor unparks instead."""


class PmdCommandError(PmdError, ValueError):
    """The command cannot be formed: our own fault (local), nothing was sent."""


@dataclass(frozen=True)
class Command:
    """One command for one controller. `reads` tells which form of answer to expect.

    A command that moves relatively must never be sent again after a lost answer, because it may
    have been executed; `repeatable` is what the bus goes by.
    """

    address: int
    body: str
    reads: bool
    repeatable: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.address <= BROADCAST_ADDRESS:
            raise PmdCommandError(f"controller address {self.address} is outside 0..127")
        if not self.body.isascii() or any(c in "\r\n;\x1bX" for c in self.body):
            raise PmdCommandError(f"command body {self.body!r} holds a reserved character")

    @property
    def text(self) -> str:
        return f"X{self.address}{self.body}"

    @property
    def line(self) -> bytes:
        """The bytes to send; always CR, the one terminator that both manuals show."""
        return self.text.encode("ascii") + b"\r"


def read(address: int, name: str) -> Command:
    return Command(address, name, reads=True)


def _checked_i32(value: int, what: str) -> int:
    if not isinstance(value, int) or not I32_MIN <= value <= I32_MAX:
        raise PmdCommandError(f"{what} {value!r} is not a 32-bit integer")
    return value


def set_parameter(address: int, number: int, value: int) -> Command:
    """`Y<number>,<value>`: one setting in the controller's memory (not its flash)."""
    if not 0 <= number <= 99:
        raise PmdCommandError(f"parameter Y{number} does not exist")
    if not isinstance(value, int) or not I32_MIN <= value <= 2**32 - 1:
        raise PmdCommandError(f"value {value!r} for Y{number} is not a 32-bit integer")
    return Command(address, f"Y{number},{value}", reads=False)


def move_to_count(address: int, target_count: int, speed_hz: int) -> Command:
    """Closed loop, absolute, so sending it twice moves once."""
    _checked_i32(target_count, "target")
    return Command(address, f"T{target_count},{_checked_speed(speed_hz)}", reads=False)


def run_microsteps(address: int, microsteps: int, speed_hz: int) -> Command:
    """Open loop, relative: never to be repeated. Raises PmdCommandError on zero.

    Whole steps and microsteps carry the same sign, because a negative sign on either reverses the
    whole motion; a negative zero would lose it, so a zero part stays unsigned.
    """
    if not isinstance(microsteps, int) or microsteps == 0:
        raise PmdCommandError(f"an open-loop run of {microsteps!r} microsteps is not a motion")
    steps, rest = divmod(abs(microsteps), MICROSTEPS_PER_STEP)
    _checked_i32(steps, "steps")
    sign = -1 if microsteps < 0 else 1
    body = f"J{sign * steps},{sign * rest},{_checked_speed(speed_hz)}"
    return Command(address, body, reads=False, repeatable=False)


def store(command: Command) -> Command:
    """The same command with a trailing `b`: kept by the controller, not yet run.

    The line has no checksum, and one wrong bit makes `T0` of `U0`. A motion is therefore stored
    first; only when its echo has shown that it arrived unharmed is it run, by `run_stored`.
    """
    return Command(command.address, command.body + "b", reads=False)


def run_stored(command: Command) -> Command:
    """`B1`, as repeatable as the stored command itself."""
    return Command(command.address, "B1", reads=False, repeatable=command.repeatable)


def overwrite_stored(address: int) -> Command:
    """A harmless question takes the place of a stored motion.

    Not `B0`, which would clear it: one wrong bit makes `B1` of that, and the motion runs again.
    """
    return Command(address, "Eb", reads=False)


def _checked_speed(speed_hz: int) -> int:
    if not isinstance(speed_hz, int) or not 1 <= speed_hz <= 2500:
        raise PmdCommandError(f"drive frequency {speed_hz!r} Hz is outside 1..2500 Hz")
    return speed_hz


def run_to_index(address: int, microsteps: int, speed_hz: int) -> Command:
    """`I`: as `J`, until the encoder's index is passed. Relative: never to be repeated."""
    run = run_microsteps(address, microsteps, speed_hz)
    return Command(address, "I" + run.body[1:], reads=False, repeatable=False)


def stop(address: int) -> Command:
    return Command(address, "S", reads=False)


Waveform = Literal["rhomb", "delta"]
PARK_BODY = "M4"


def unpark(address: int, waveform: Waveform = "delta") -> Command:
    return Command(address, "M1" if waveform == "rhomb" else "M2", reads=False)


def park(address: int) -> Command:
    return Command(address, PARK_BODY, reads=False)


def emergency_stop_bytes(addresses: list[int]) -> bytes:
    """One write that stops every motor of a bus without waiting for any answer.

    The leading ESC and delimiter cancel whatever half line the controllers hold. Whether the
    broadcast of S works is not confirmed on hardware, so each axis is named as well.
    """
    named = "".join(f"X{a}S;" for a in addresses)
    return b"\x1b;" + f"X{BROADCAST_ADDRESS}S;{named}".encode("ascii")


class LineReader:
    """Collects bytes into lines. CR and LF both end a line; empty lines are dropped.

    Bytes that cannot be part of an answer make the line unusable; it is counted, never guessed.
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self.bad_lines = 0

    def feed(self, received: bytes) -> list[str]:
        self._pending += received
        *whole, rest = re.split(rb"[\r\n]", bytes(self._pending))
        self._pending = bytearray(rest)
        if len(self._pending) > MAX_LINE_BYTES:
            self._pending.clear()
            self.bad_lines += 1
        return [line for line in map(self._decode, whole) if line]

    def _decode(self, raw: bytes) -> str:
        if all(0x20 <= byte < 0x7F for byte in raw):
            return raw.decode("ascii")
        self.bad_lines += 1
        return ""

    def clear(self) -> None:
        self._pending.clear()

    @property
    def pending(self) -> bytes:
        return bytes(self._pending)


@dataclass(frozen=True)
class Reply:
    """A matched answer: the value behind the colon, or an empty text for an echo.

    retried: an earlier answer to the same command was lost (what it had latched went with it).
    """

    value: str = ""
    retried: bool = False

    def integer(self) -> int:
        """The leading integer; descriptions behind it (`1, Quad_32`) are ignored."""
        found = re.match(r"\s*([+-]?\d+)", self.value)
        if not found:
            raise PmdReplyError(f"'{self.value}' does not begin with an integer")
        return int(found[1])

    def integers(self) -> tuple[int, ...]:
        """All the comma-separated leading integers."""
        try:
            return tuple(int(part) for part in self.value.split(","))
        except ValueError:
            raise PmdReplyError(f"'{self.value}' is not a list of integers") from None


_GRAVE_ECHO = re.compile(r"X\d{0,3}~?(?:[JTRCIE][=\d+-].*(?<!b)|B1)$")


def is_grave(line: str) -> bool:
    """Whether this is the echo of a command that moves something or sets its position."""
    return _GRAVE_ECHO.match(line) is not None and ":" not in line


def match_reply(command: Command, line: str) -> Reply | None:
    """The reply that `line` is to `command`; None if it answers something else (chatter).

    Raises PmdSyntaxError or PmdRefusedError if the controller says so, PmdEchoError if any
    controller echoes a motion or a new position that this command did not ask for.
    """
    address, body = f"X{command.address}", command.body
    if line.startswith(f"{address}_??_"):
        raise PmdSyntaxError(f"controller {command.address} did not understand '{command.text}'")
    if not line.startswith(address + body):
        if is_grave(line):
            raise PmdEchoError(f"'{line}' was answered to '{command.text}': damaged on the line")
        return None
    rest = line[len(address + body) :]
    if rest in ("!", ":!"):
        raise PmdRefusedError(f"controller {command.address} cannot execute '{command.text}' now")
    if command.reads and rest.startswith(":"):
        return Reply(rest[1:].strip())
    if not command.reads and not rest:
        return Reply()
    if is_grave(line):
        raise PmdEchoError(f"'{line}' was answered to '{command.text}': damaged on the line")
    return None
