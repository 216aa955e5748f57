"""What an emulated controller answers to one command. Text in, text out.

`execute(controller, body)` gets what stands between the address and the delimiter, and returns
what follows the address in the answer. Exact texts follow the examples in the manuals.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

from robot_bridge import emulator_settings as y
from robot_bridge.emulator_axis import (
    REBOOT_S,
    SCRIPT_STEPS,
    EmulatedController,
    OpenRun,
    PositionLog,
    TargetRun,
)
from robot_bridge.pmd_protocol import MICROSTEPS_PER_STEP
from robot_bridge.pmd_status import Status, format_status

ENCODER_TYPE_NAMES = {0: "None", 1: "Quad_32", 2: "Analog", 3: "Servo"}


class Answer(NamedTuple):
    text: str  # behind the address
    generated: bool  # not a mere echo


class _NotUnderstoodError(Exception):
    """Answered by `_??_`."""


class _NotPossibleError(Exception):
    """Answered by a trailing `!`."""


class _NotImplementedHereError(Exception):
    """Answered by `:!`."""


def execute(controller: EmulatedController, body: str) -> Answer:
    """Run one command; an empty body is a ping."""
    if not body:
        return Answer("", False)
    try:
        value = _run(controller, body)
    except _NotUnderstoodError:
        return Answer(f"_??_{body}", False)
    except _NotPossibleError:
        return Answer(f"{body}!", False)
    except _NotImplementedHereError:
        return Answer(f"{body}:!", True)
    return Answer(body, False) if value is None else Answer(f"{body}:{value}", True)


def failed(answer: Answer) -> bool:
    return answer.text.startswith("_??_") or answer.text.endswith("!")


def _run(controller: EmulatedController, body: str) -> str | None:
    if body.endswith("b") and len(body) > 1:
        controller.stored = body[:-1]
        return None
    letter, rest = body[0], body[1:]
    if letter == "S":  # whatever follows, a stop is a stop
        controller.stop()
        return None
    if letter == "Y":
        return _parameter(controller, rest)
    handler = _HANDLERS.get(letter)
    if handler is None:
        raise _NotUnderstoodError
    described = rest.endswith("?") and letter == "N"
    return handler(controller, _integers(rest[:-1] if described else rest))


def _integers(text: str) -> list[int]:
    text = text.removeprefix("=")
    if not text:
        return []
    if not re.fullmatch(r"[+-]?\d+(,[+-]?\d+)*", text):
        raise _NotUnderstoodError
    return [int(part) for part in text.split(",")]


# Reading


def _identify(c: EmulatedController, args: list[int]) -> str:
    return f"{c.motor.model} {c.motor.firmware}"


def _status(c: EmulatedController, args: list[int]) -> str:
    readings: dict[int, Callable[[EmulatedController], str]] = {
        0: _status_word,
        1: _io_word,
        2: _supply,
        3: _drive_limits,
        4: lambda c: f"{_status_word(c)},{_io_word(c)}",
    }
    number = args[0] if args else 0
    if number not in readings or (not args and not c.switches.bare_status):
        raise _NotUnderstoodError
    return readings[number](c)


def _cased(c: EmulatedController, text: str) -> str:
    return text.upper() if c.switches.hex_case == "upper" else text


def _status_word(c: EmulatedController) -> str:
    return _cased(c, format_status(c.report_status()))


def _io_word(c: EmulatedController) -> str:
    fan = 8 if c.faults.overheat else 0
    return _cased(c, f"{fan | c.outputs:x}{0xC | int(c.faults.limit_switch):x}")


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


# Running


def _require_power(c: EmulatedController) -> None:
    """A run while parked is answered by `!`, and unparks instead of moving."""
    if c.can_run:
        return
    if not c.powerless:
        c.unpark()
    raise _NotPossibleError


def _waveform(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return str(c.waveform + 4 if c.parked else c.waveform)
    if args[0] in (1, 2):
        c.unpark(args[0])
    elif args[0] == 4 or (args[0] == 6 and c.switches.m6_parks):
        c.park()
    else:
        raise _NotPossibleError
    return None


def _open_run(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return _run_answer(c)
    c.begin_open_run(_open_run_from(c, args), "run")
    return None


def _run_answer(c: EmulatedController) -> str:
    if not c.moving:
        return "0"
    if c.switches.run_answer == "one":
        return "1"
    return "-222" if c.reverse else "222"


def _open_run_from(c: EmulatedController, args: list[int]) -> OpenRun:
    """`wfm[,ustep[,speed]]`; a negative sign on any of them reverses the whole motion."""
    if len(args) > 3:
        raise _NotUnderstoodError
    steps, microsteps, speed = (*args, *(0, c.default_speed_hz)[len(args) - 1 :])
    _require_speed(c, speed)
    _require_power(c)
    direction = -1 if min(args) < 0 else 1
    distance = abs(steps) * MICROSTEPS_PER_STEP + abs(microsteps)
    return OpenRun(distance, direction, c.clamp_speed(speed))


def _require_speed(c: EmulatedController, speed_hz: int) -> None:
    if speed_hz == 0 or (
        c.switches.overspeed == "refuse" and abs(speed_hz) > c.motor.max_frequency_hz
    ):
        raise _NotPossibleError


def _default_speed(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return str(c.default_speed_hz)
    _require_speed(c, args[0])
    c.default_speed_hz = abs(args[0])
    return None


def _run_to_index(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return _run_answer(c)
    if c.index_mode not in (2, 4):
        raise _NotPossibleError
    run = _open_run_from(c, args)
    run.until_index = True
    c.begin_open_run(run, "index")
    return None


def _target(c: EmulatedController, args: list[int]) -> str | None:
    return _go_to(c, args, lambda value: value)


def _relative_to_target(c: EmulatedController, args: list[int]) -> str | None:
    return _go_to(c, args, lambda value: c.last_target + value)


def _relative_to_count(c: EmulatedController, args: list[int]) -> str | None:
    return _go_to(c, args, lambda value: c.count + value)


def _go_to(c: EmulatedController, args: list[int], target_from: Callable[[int], int]) -> str | None:
    if not args:
        return str(c.last_target)
    if len(args) > 2:
        raise _NotUnderstoodError
    target = target_from(args[0])
    beyond = not c.settings[y.LIMIT_A] <= target <= c.settings[y.LIMIT_B]
    if beyond and c.switches.target_beyond_limit == "refuse":
        raise _NotPossibleError
    if len(args) == 2:
        _require_speed(c, args[1])
        c.settings.store(y.SPEED, abs(args[1]))
    _require_power(c)
    c.begin_target(target, c.settings[y.SPEED])
    return None


def _encoder(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return str(c.count)
    c.count = args[0]
    if args[0] == 0:
        c.settings.store(y.INDEX_OFFSET, 0)
        c.index_mode = 0
    return None


def _index(c: EmulatedController, args: list[int]) -> str | None:
    if args:
        if args[0] not in (0, 2, 4):
            raise _NotPossibleError
        c.index_mode = args[0]
        return None
    dot = "." if c.index_unreported else ""
    c.index_unreported = False
    return f"{c.index_mode},{c.index_position}{dot}"


def _stored(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return c.stored or ""
    if args[0] == 0:
        c.stored = None
    elif args[0] == 1 and c.stored:
        if failed(execute(c, c.stored)):
            raise _NotPossibleError
    else:
        raise _NotPossibleError
    return None


def _digital(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return f"{c.outputs:03b},110{int(c.faults.limit_switch)}"
    outputs = 3 if c.motor.model == "PMD401" else 2
    if len(args) != 2 or not 0 <= args[0] < outputs or args[1] not in (0, 1):
        raise _NotPossibleError
    c.outputs = (c.outputs & ~(1 << args[0])) | (args[1] << args[0])
    return None


def _log(c: EmulatedController, args: list[int]) -> str | None:
    if not args or args == [0]:
        if c.log is None:
            raise _NotPossibleError
        shown = c.log.positions if args else c.log.positions[:1]
        head = f"{c.log.started_at_ms},{round(c.log.period_s * 1000)},{c.time_ms}"
        return ",".join([head, str(len(c.log.positions)), *map(str, shown)])
    if args[0] > 0:
        c.log = PositionLog(args[0] / 1000, c.time_ms)
    else:
        c.log_armed_s = -args[0] / 1000
    return None


_HANDLERS: dict[str, Callable[[EmulatedController, list[int]], str | None]] = {
    "?": _identify,
    "U": _status,
    "M": _waveform,
    "J": _open_run,
    "H": _default_speed,
    "I": _run_to_index,
    "T": _target,
    "R": _relative_to_target,
    "C": _relative_to_count,
    "E": _encoder,
    "N": _index,
    "B": _stored,
    "D": _digital,
    "L": _log,
}


# Parameters


def _parameter(c: EmulatedController, rest: str) -> str | None:
    matched = re.fullmatch(r"(\d+)(?:[,=]([+-]?\d+))?(\?)?", rest)
    if not matched:
        raise _NotUnderstoodError
    number, value = int(matched[1]), matched[2]
    if value is None:
        return _read_parameter(c, number)
    _set_parameter(c, number, int(value))
    return None


def _read_parameter(c: EmulatedController, number: int) -> str:
    if number == y.ENCODER_TYPE and c.switches.encoder_type_description:
        value = c.settings[number]
        return f"{value}, {ENCODER_TYPE_NAMES.get(value, 'Serial')}"
    if number in y.SETTINGS:
        return str(c.settings[number])
    if number not in _READINGS:
        raise _NotImplementedHereError
    return _READINGS[number](c)


def _set_parameter(c: EmulatedController, number: int, value: int) -> None:
    if number in y.SETTINGS:
        if not c.settings.accepts(number, value):
            raise _NotPossibleError
        c.settings.store(number, value)
    elif number == 25 and value == 1:
        _start_script(c)
    elif number == 1 and value == 2:
        c.settings.power_on()
    elif number == 1 and value == 3:
        c.settings.factory()
    else:
        raise _NotPossibleError


def _start_script(c: EmulatedController) -> None:
    _require_power(c)
    run = OpenRun(SCRIPT_STEPS * MICROSTEPS_PER_STEP, 1, 100.0, script=True)
    c.begin_open_run(run, "script")


def _script_state(c: EmulatedController) -> str:
    running = isinstance(c.run, OpenRun) and c.run.script
    return f"1,{1 if running else c.script_outcome}"


def _compare_flash(c: EmulatedController) -> str:
    state = c.settings.compare_flash()
    return f"{state}, {('Flash equal', 'Flash differ', 'Axis differ')[state]}"


def _save(c: EmulatedController) -> str:
    c.settings.save()
    return "0, Flash OK" if c.switches.flash_answer_comma else "0 Flash OK"


def _reset(c: EmulatedController) -> str:
    c.power_on(c._now_s, deaf_s=REBOOT_S)
    return "0, Reset"


def _target_timer(c: EmulatedController) -> str:
    if not isinstance(c.run, TargetRun):
        return "0,0"
    return f"{round(c.run.timer_s * 1000)},{int(c.run.reached)}"


def _limit_timer(c: EmulatedController) -> str:
    at_ms = c.external_limit_at_ms
    return f"{at_ms or 0},{int(at_ms is not None)}"


_READINGS: dict[int, Callable[[EmulatedController], str]] = {
    0: lambda c: f"0,{c.microsteps % MICROSTEPS_PER_STEP}",
    1: _compare_flash,
    21: lambda c: str(c.time_ms),
    22: _limit_timer,
    23: _target_timer,
    25: _script_state,
    30: lambda c: ",".join(str(c.settings[n]) for n in range(2, 14)),
    32: _save,
    41: _reset,
    42: lambda c: str(c.motor.serial_number),
}


def status_error(controller: EmulatedController) -> None:
    """A command went wrong where no answer was allowed: only the status tells."""
    controller.latched |= Status.COMMAND_ERROR
