"""`autospine demo --attended`: a person operates the virtual room on its page.

The page asks, the visitor clicks, the virtual scanner answers. Faults are switched on and off by
typing their names into the terminal.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable

from simulator.demo.room import DemoRoom
from simulator.faults import FAULTS

_POLL_S = 0.2
_STEPS = (
    "Confirm the stage positions (here the assumed ones are right), which arms the robot.",
    "Start the calibration; the virtual scanner answers each request by itself.",
    "Pick target: click on the slice, then Set target{entry}.",
    "Start the approach. Check each move, then CONFIRM MOVE, until READY.",
    "Record the puncture, then click Needle withdrawn.",
    "Open the report from the Case card.",
)


def attend_room(room: DemoRoom, note: Callable[[str], None]) -> None:
    """Say what to do, then switch faults as they are typed; raises ChildError."""
    room.faults_file.unlink(missing_ok=True)
    note(f"open this page in a browser: {room.url}")
    if room.operator_token:
        note(f"log in there with the token {room.operator_token}")
    entry = ", and Set entry point on another slice" if room.options.guide else ""
    for number, step in enumerate(_STEPS, start=1):
        note(f"{number}. {step.format(entry=entry)}")
    note("STOP (or Esc) works at any time. Ctrl-C here closes the room.")
    note(f"faults: type a name here to switch one on or off: {', '.join(FAULTS)}")
    switches = FaultSwitches(room, note)
    lines = _lines_of_stdin()
    while True:
        room.check()
        try:
            switches.toggle(lines.get(timeout=_POLL_S).strip())
        except queue.Empty:
            continue


class FaultSwitches:
    """Which faults are on; the scanner reads their file before each acquisition."""

    def __init__(self, room: DemoRoom, note: Callable[[str], None]) -> None:
        self._path = room.faults_file
        self._note = note
        self._on: set[str] = set()

    def toggle(self, name: str) -> None:
        """Switch a fault on or off; says so, or which there are."""
        if not name:
            return
        if name not in FAULTS:
            self._note(f"unknown fault {name!r}; known: {', '.join(FAULTS)}")
            return
        self._on ^= {name}
        fresh = self._path.with_suffix(".part")
        fresh.write_text("".join(f"{one}\n" for one in sorted(self._on)), encoding="ascii")
        fresh.replace(self._path)
        state = f"on: {FAULTS[name]}" if name in self._on else "off"
        self._note(f"{name} is {state}; on now: {', '.join(sorted(self._on)) or 'none'}")


def _lines_of_stdin() -> queue.Queue[str]:
    lines: queue.Queue[str] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)

    threading.Thread(target=read, name="typed", daemon=True).start()
    return lines
