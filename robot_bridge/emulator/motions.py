"""What makes an emulated controller move: power, open-loop runs, targets, the encoder's count.

Like every command: (controller, arguments) in, the value behind the colon out, or None for a mere
echo.
"""

from collections.abc import Callable

from robot_bridge.emulator import settings as y
from robot_bridge.emulator.axis import INDEX_SEARCHES, INDEXED, EmulatedController
from robot_bridge.emulator.refusals import (
    NotPossibleError,
    NotUnderstoodError,
    require_power,
    require_speed,
)
from robot_bridge.emulator.runs import OpenRun
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP


def waveform(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return str(c.waveform + 4 if c.parked else c.waveform)
    if args[0] in (1, 2):
        c.unpark(args[0])
    elif args[0] == 4 or (args[0] == 6 and c.switches.m6_parks):
        c.park()
    else:
        raise NotPossibleError
    return None


def open_run(c: EmulatedController, args: list[int]) -> str | None:
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
        raise NotUnderstoodError
    steps, microsteps, speed = (*args, *(0, c.default_speed_hz)[len(args) - 1 :])
    require_speed(c, speed)
    require_power(c)
    direction = -1 if min(args) < 0 else 1
    distance = abs(steps) * MICROSTEPS_PER_STEP + abs(microsteps)
    return OpenRun(distance, direction, c.clamp_speed(speed))


def default_speed(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return str(c.default_speed_hz)
    require_speed(c, args[0])
    c.default_speed_hz = abs(args[0])
    return None


def run_to_index(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return _run_answer(c)
    if c.index_mode not in INDEX_SEARCHES or c.index_found:
        raise NotPossibleError
    run = _open_run_from(c, args)
    run.until_index = True
    c.begin_open_run(run, "index")
    return None


def target(c: EmulatedController, args: list[int]) -> str | None:
    return _go_to(c, args, lambda value: value)


def relative_to_target(c: EmulatedController, args: list[int]) -> str | None:
    return _go_to(c, args, lambda value: c.last_target + value)


def relative_to_count(c: EmulatedController, args: list[int]) -> str | None:
    return _go_to(c, args, lambda value: c.count + value)


def _go_to(c: EmulatedController, args: list[int], target_from: Callable[[int], int]) -> str | None:
    if not args:
        return str(c.last_target)
    if len(args) > 2:
        raise NotUnderstoodError
    target = target_from(args[0])
    beyond = not c.settings[y.LIMIT_A] <= target <= c.settings[y.LIMIT_B]
    if beyond and c.switches.target_beyond_limit == "refuse":
        raise NotPossibleError
    if len(args) == 2:
        require_speed(c, args[1])
        c.settings.store(y.SPEED, abs(args[1]))
    require_power(c)
    c.begin_target(target, c.settings[y.SPEED])
    return None


def encoder(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return str(c.count)
    c.count = args[0]
    c.settings.store(y.INDEX_OFFSET, 0)
    c.index_mode = 0
    return None


def index(c: EmulatedController, args: list[int]) -> str | None:
    if args:
        if args[0] not in (0, *INDEX_SEARCHES):
            raise NotPossibleError
        c.index_mode, c.index_found = args[0], False
        return None
    dot = "." if c.index_unreported else ""
    c.index_unreported = False
    return f"{c.index_mode},{c.index_position}{dot}"


_INDEX_MODES = {0: "off", INDEXED: "indexed", 2: "stopI", 4: "resetI"}


def index_described(c: EmulatedController) -> str:
    return f"{index(c, [])}, {_INDEX_MODES[c.index_mode]}"
