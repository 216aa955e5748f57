"""The status words of PMD401/PMD301 controllers, as bits and back.

`U0` answers four nibbles d1 d2 d3 d4 as hex digits. Here they are one 16-bit flag with d1 in the
top nibble. d1, RESET and INDEX are latched in the controller until they are reported once;
everything else is live. Reference: PMD401 manual 150025-01, section 4.2.3.
"""

from dataclasses import dataclass
from enum import IntFlag

from robot_bridge.pmd.protocol import PmdReplyError


class Status(IntFlag):
    """One bit a fact, d1 (the errors) in the top nibble."""

    COM_ERROR = 0x8000
    ENCODER_ERROR = 0x4000
    VOLTAGE_ERROR = 0x2000
    COMMAND_ERROR = 0x1000
    RESET = 0x0800
    EXTERNAL_LIMIT = 0x0400
    SCRIPT = 0x0200
    INDEX = 0x0100
    SERVO_MODE = 0x0080
    TARGET_LIMIT = 0x0040
    TARGET_MODE = 0x0020
    TARGET_REACHED = 0x0010
    PARKED = 0x0008
    OVERHEAT = 0x0004
    REVERSE = 0x0002
    RUNNING = 0x0001


ERRORS = Status.COM_ERROR | Status.ENCODER_ERROR | Status.VOLTAGE_ERROR | Status.COMMAND_ERROR
LATCHED = ERRORS | Status.RESET | Status.INDEX


def parse_status(text: str) -> Status:
    """The four hex digits of a `U0` answer, in either case; a `U4` answer's `,io` part is ignored.

    Raises PmdReplyError if the digits are not four or not hexadecimal.
    """
    digits = text.split(",", 1)[0].strip()
    if len(digits) != 4 or not all(c in "0123456789abcdefABCDEF" for c in digits):
        raise PmdReplyError(f"status '{text}' is not four hexadecimal digits")
    return Status(int(digits, 16))


def parse_input_bits(text: str) -> int:
    """in3..in0 as four bits, from a `U4` answer. Raises PmdReplyError."""
    _, comma, io = text.partition(",")
    if not comma or len(io.strip()) != 2:
        raise PmdReplyError(f"status '{text}' has no inputs")
    try:
        return int(io.strip()[1], 16)
    except ValueError:
        raise PmdReplyError(f"inputs '{io}' are not hexadecimal") from None


def format_status(status: Status) -> str:
    return f"{int(status):04x}"


def names(status: Status) -> str:
    """For people: `reset, parked`, or `none`."""
    return ", ".join(b.name.lower().replace("_", " ") for b in Status if b & status and b.name) or (
        "none"
    )


@dataclass(frozen=True)
class Inputs:
    """The limit switches as they stand; each stops motion in its own direction alone."""

    reverse: bool
    forward: bool


LIMITS_OFF, ACTIVE_HIGH = 0, 1


def parse_inputs(text: str, wiring: int) -> Inputs:
    """A `U1` answer: two hex digits, outputs and inputs; in1 is limit reverse, in2 forward.

    wiring: Y2, 0 not connected (no switch is active), 1 active high, 2 active low.
    """
    digits = text.strip()
    if len(digits) != 2 or not all(c in "0123456789abcdefABCDEF" for c in digits):
        raise PmdReplyError(f"inputs '{text}' are not two hexadecimal digits")
    if wiring == LIMITS_OFF:
        return Inputs(reverse=False, forward=False)
    inputs = int(digits[1], 16)
    level = wiring == ACTIVE_HIGH
    return Inputs(reverse=bool(inputs & 2) is level, forward=bool(inputs & 4) is level)


@dataclass(frozen=True)
class Supply:
    """A `U2` answer: supply voltages, the motor test figure and the board's temperature."""

    volts_5: float
    volts_3v3: float
    volts_48: float
    motor_test: int
    board_celsius: int
    error_seen: bool  # an asterisk: some value was out of range since it was last asked


def parse_supply(text: str) -> Supply:
    """`5.05,3.32,47.2*,23,56C` (PMD401) or with the sensor supply appended (PMD301)."""
    fields = text.replace("*", "").split(",")
    try:
        return Supply(
            float(fields[0]),
            float(fields[1]),
            float(fields[2]),
            int(fields[3]),
            int(fields[4].strip().rstrip("Cc")),
            "*" in text,
        )
    except (IndexError, ValueError):
        raise PmdReplyError(f"cannot parse supply readings '{text}'") from None


@dataclass(frozen=True)
class Drive:
    """A `U3` answer: what the motor's capacitance allows. Measured by the controller at unpark."""

    capacitance_nf: int
    max_frequency_hz: int
    waveform: str


def parse_drive(text: str) -> Drive:
    """`2064nF,457Hz Delta`."""
    try:
        capacitance, rest = text.split(",", 1)
        frequency, _, waveform = rest.strip().partition(" ")
        return Drive(
            int(capacitance.strip().removesuffix("nF")),
            int(frequency.removesuffix("Hz")),
            waveform.strip(),
        )
    except ValueError:
        raise PmdReplyError(f"cannot parse drive limits '{text}'") from None
