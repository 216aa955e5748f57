"""Faults, switches and the truth of an emulator, while it runs: requests and answers of one line.

where                     true positions (mm), counts, parked, whether anything moves
fault ADDRESS NAME on|off a fault of one controller or motor (AxisFaults)
line NAME NUMBER          a fault of the serial line (LineFaults)
switch NAME VALUE         how an open question of the manual is answered (Switches)
power-cycle [ADDRESS]     the supply is lost and comes back
push ADDRESS MM           something pushes the stage
"""

import json
import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, get_args

from robot_bridge.emulator.axis import EmulatedController
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.switches import AxisFaults, LineFaults, Switches


class RequestError(ValueError):
    """A request that cannot be carried out; one line."""


def set_fault(controller: EmulatedController, name: str, on_off: str) -> None:
    """Raises RequestError."""
    known = [fault.name for fault in fields(AxisFaults)]
    if name not in known or on_off not in ("on", "off"):
        raise RequestError(f"fault {name} {on_off}: say on or off for one of {', '.join(known)}")
    setattr(controller.faults, name, on_off == "on")


def set_line_fault(bus: EmulatedBus, name: str, number: str) -> None:
    """Raises RequestError."""
    known = {fault.name: fault.type for fault in fields(LineFaults) if fault.name != "chatter"}
    if name not in known:
        raise RequestError(f"line {name}: not one of {', '.join(known)}")
    try:
        value = float(number) if known[name] is float else int(number)
    except ValueError:
        raise RequestError(f"line {name}: {number!r} is not a valid number") from None
    if not 0 <= value < 1e9:
        raise RequestError(f"line {name}: {number} is not from 0 to 1e9")
    setattr(bus.faults, name, value)


def set_switch(bus: EmulatedBus, name: str, text: str) -> None:
    """Raises RequestError."""
    kinds = {switch.name: switch.type for switch in fields(Switches)}
    if name not in kinds:
        raise RequestError(f"switch {name}: not one of {', '.join(kinds)}")
    choices: dict[str, Any] = (
        {"true": True, "false": False}
        if kinds[name] is bool
        else {choice: choice for choice in get_args(kinds[name])}
    )
    if text not in choices:
        raise RequestError(f"switch {name} {text}: not one of {', '.join(choices)}")
    bus.set_switches(replace(bus.switches, **{name: choices[text]}))


class Control:
    """Answers one request at a time; called from the loop that serves the bus."""

    def __init__(self, bus: EmulatedBus) -> None:
        self._bus = bus

    def answer(self, request: str) -> str:
        """One line of JSON; `error` says what was wrong."""
        word, *args = request.split()
        handlers: dict[str, Callable[..., dict[str, object] | None]] = {
            "where": self._where,
            "fault": lambda a, name, on: set_fault(self._at(a), name, on),
            "line": lambda name, number: set_line_fault(self._bus, name, number),
            "switch": lambda name, text: set_switch(self._bus, name, text),
            "power-cycle": self._power_cycle,
            "push": self._push,
        }
        try:
            if word not in handlers:
                raise RequestError(f"unknown request {word!r}; known: {', '.join(handlers)}")
            return json.dumps(handlers[word](*args) or {"ok": True})
        except TypeError:
            return json.dumps({"error": f"{word}: wrong number of arguments ({len(args)})"})
        except ValueError as error:
            return json.dumps({"error": f"{word}: {error}"})

    def _at(self, address: str) -> EmulatedController:
        for controller in self._bus.controllers:
            if str(controller.address) == address:
                return controller
        raise RequestError(f"no controller {address}")

    def _where(self) -> dict[str, object]:
        controllers = {str(c.address): c for c in self._bus.controllers}
        return {
            "positions_mm": {a: c.physics.position_um / 1000 for a, c in controllers.items()},
            "counts": {a: c.count for a, c in controllers.items()},
            "parked": {a: c.parked for a, c in controllers.items()},
            "moving": any(c.moving for c in controllers.values()),
        }

    def _power_cycle(self, address: str | None = None) -> None:
        chosen = [self._at(address)] if address else self._bus.controllers
        for controller in chosen:
            controller.power_on(time.monotonic())

    def _push(self, address: str, mm: str) -> None:
        self._at(address).physics.displace(float(mm) * 1000)
