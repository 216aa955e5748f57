"""The `Y` parameters of an emulated controller: settings, and numbers that do or tell something."""

import re
from collections.abc import Callable

from robot_bridge.emulator import settings as y
from robot_bridge.emulator.axis import INDEXED, REBOOT_S, SCRIPT_STEPS, EmulatedController
from robot_bridge.emulator.refusals import (
    NotImplementedHereError,
    NotPossibleError,
    NotUnderstoodError,
    require_power,
)
from robot_bridge.emulator.runs import OpenRun, TargetRun
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP

ENCODER_TYPE_NAMES = {0: "None", 1: "Quad_32", 2: "Analog", 3: "Servo"}


def parameter(c: EmulatedController, rest: str) -> str | None:
    matched = re.fullmatch(r"(\d+)(?:[,=]([+-]?\d+))?(\?)?", rest)
    if not matched:
        raise NotUnderstoodError
    number, value = int(matched[1]), matched[2]
    if value is None:
        told = _read_parameter(c, number)
        if matched[3] and number in y.SETTINGS and "," not in told:
            told += f", {y.SETTINGS[number].name}"
        return told
    _set_parameter(c, number, int(value))
    return None


def _read_parameter(c: EmulatedController, number: int) -> str:
    if number == y.ENCODER_TYPE and c.switches.encoder_type_description:
        value = c.settings[number]
        return f"{value}, {ENCODER_TYPE_NAMES.get(value, 'Serial')}"
    if number in y.SETTINGS:
        return str(c.settings[number])
    if number not in _READINGS:
        raise NotImplementedHereError
    return _READINGS[number](c)


def _set_parameter(c: EmulatedController, number: int, value: int) -> None:
    if number in y.SETTINGS:
        if not c.settings.accepts(number, value):
            raise NotPossibleError
        if number == y.INDEX_OFFSET and c.index_mode == INDEXED:
            c.count += value - c.settings[number]  # the position of the index is another one now
        c.settings.store(number, value)
    elif number == 25 and value == 1:
        _start_script(c)
    elif number == 25 and value == 0:
        _stop_script(c)
    elif number == 1 and value == 2:
        c.settings.reload()
    elif number == 1 and value == 3:
        c.settings.factory()
    else:
        raise NotPossibleError


def _start_script(c: EmulatedController) -> None:
    require_power(c)
    run = OpenRun(SCRIPT_STEPS * MICROSTEPS_PER_STEP, 1, 100.0, script=True)
    c.begin_open_run(run, "script")


def _stop_script(c: EmulatedController) -> None:
    if isinstance(c.run, OpenRun) and c.run.script:
        c.stop()


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
