"""What an emulated controller tells when it is asked: identity, status, supply, inputs, log.

Like every command: (controller, arguments) in, the value behind the colon out, or None for a mere
echo. Exact texts follow the examples in the manuals.
"""

from collections.abc import Callable

from robot_bridge.emulator.axis import EmulatedController
from robot_bridge.emulator.refusals import NotPossibleError, NotUnderstoodError
from robot_bridge.emulator.runs import PositionLog
from robot_bridge.pmd.status import format_status


def identify(c: EmulatedController, args: list[int]) -> str:
    return f"{c.motor.model} {c.motor.firmware}"


def status(c: EmulatedController, args: list[int]) -> str:
    readings: dict[int, Callable[[EmulatedController], str]] = {
        0: _status_word,
        1: _io_word,
        2: _supply,
        3: _drive_limits,
        4: lambda c: f"{_status_word(c)},{_io_word(c)}",
    }
    number = args[0] if args else 0
    if number not in readings or (not args and not c.switches.bare_status):
        raise NotUnderstoodError
    return readings[number](c)


def _cased(c: EmulatedController, text: str) -> str:
    return text.upper() if c.switches.hex_case == "upper" else text


def _status_word(c: EmulatedController) -> str:
    return _cased(c, format_status(c.report_status()))


def _io_word(c: EmulatedController) -> str:
    fan = 8 if c.faults.overheat else 0
    return _cased(c, f"{fan | c.outputs:x}{c.inputs:x}")


def _supply(c: EmulatedController) -> str:
    lost, hot = c.faults.supply_lost, c.faults.overheat
    seen = c.supply_error_seen or lost
    c.supply_error_seen = lost
    volts_48 = "31.4" if lost else "47.2"
    readings = f"5.05,3.32,{volts_48}{'*' if seen else ''},23,{78 if hot else 41}C"
    return readings + (",5" if c.motor.model == "PMD301" else "")


def _drive_limits(c: EmulatedController) -> str:
    shape = "Rhomb" if c.waveform == 1 else "Delta"
    return f"{c.motor.capacitance_nf}nF,{c.motor.max_frequency_hz}Hz {shape}"


def digital(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return f"{c.outputs:03b},{c.inputs:04b}"
    outputs = 3 if c.motor.model == "PMD401" else 2
    if len(args) != 2 or not 0 <= args[0] < outputs or args[1] not in (0, 1):
        raise NotPossibleError
    c.outputs = (c.outputs & ~(1 << args[0])) | (args[1] << args[0])
    return None


def log(c: EmulatedController, args: list[int]) -> str | None:
    if not args or args == [0]:
        if c.log is None:
            raise NotPossibleError
        shown = c.log.positions if args else c.log.positions[:1]
        head = f"{c.log.started_at_ms},{round(c.log.period_s * 1000)},{c.time_ms}"
        return ",".join([head, str(len(c.log.positions)), *map(str, shown)])
    if args[0] > 0:
        c.log = PositionLog(args[0] / 1000, c.time_ms)
    else:
        c.log_armed_s = -args[0] / 1000
    return None
