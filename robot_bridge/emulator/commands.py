"""What an emulated controller answers to one command. Text in, text out.

`execute(controller, body)` gets what stands between the address and the delimiter, and returns
what follows the address in the answer. Exact texts follow the examples in the manuals.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

from robot_bridge.emulator import motions, readings
from robot_bridge.emulator.axis import EmulatedController
from robot_bridge.emulator.parameters import parameter
from robot_bridge.emulator.refusals import (
    NotImplementedHereError,
    NotPossibleError,
    NotUnderstoodError,
)
from robot_bridge.pmd.status import Status


class Answer(NamedTuple):
    text: str  # behind the address
    generated: bool  # not a mere echo


def execute(controller: EmulatedController, body: str) -> Answer:
    """Run one command; an empty body is a ping."""
    if not body:
        return Answer("", False)
    try:
        value = _run(controller, body)
    except NotUnderstoodError:
        return Answer(f"_??_{body}", False)
    except NotPossibleError:
        return Answer(f"{body}!", False)
    except NotImplementedHereError:
        return Answer(f"{body}:!", True)
    return Answer(body, False) if value is None else Answer(f"{body}:{value}", True)


def failed(answer: Answer) -> bool:
    return answer.text.startswith("_??_") or answer.text.endswith("!")


def status_error(controller: EmulatedController) -> None:
    """A command went wrong where no answer was allowed: only the status tells."""
    controller.latched |= Status.COMMAND_ERROR


def _run(controller: EmulatedController, body: str) -> str | None:
    if body.endswith("b") and len(body) > 1:
        controller.stored = body
        return None
    letter, rest = body[0], body[1:]
    if letter == "S":  # whatever follows, a stop is a stop
        controller.stop()
        return None
    if letter == "Y":
        return parameter(controller, rest)
    handler = _HANDLERS.get(letter)
    if handler is None:
        raise NotUnderstoodError
    if letter == "N" and rest == "?":
        return motions.index_described(controller)
    return handler(controller, _integers(rest))


def _integers(text: str) -> list[int]:
    text = text.removeprefix("=")
    if not text:
        return []
    if not re.fullmatch(r"[+-]?\d+(,[+-]?\d+)*", text):
        raise NotUnderstoodError
    return [int(part) for part in text.split(",")]


def _stored(c: EmulatedController, args: list[int]) -> str | None:
    if not args:
        return c.stored or ""
    if args[0] == 0:
        c.stored = None
    elif args[0] == 1 and c.stored:
        if failed(execute(c, c.stored.removesuffix("b"))):
            raise NotPossibleError
    else:
        raise NotPossibleError
    return None


_HANDLERS: dict[str, Callable[[EmulatedController, list[int]], str | None]] = {
    "?": readings.identify,
    "U": readings.status,
    "M": motions.waveform,
    "J": motions.open_run,
    "H": motions.default_speed,
    "I": motions.run_to_index,
    "T": motions.target,
    "R": motions.relative_to_target,
    "C": motions.relative_to_count,
    "E": motions.encoder,
    "N": motions.index,
    "B": _stored,
    "D": readings.digital,
    "L": readings.log,
}
