"""`autospine up`: the control-room computer's listener, worker and service, supervised.

A child that ends is started again, after a pause that grows while it keeps ending, for as long as
the room runs: no child's end ever ends another. One that hangs is killed, and started again like
any other. The service, which has STOP, is the last to go.
The same policy as systemd units: `examples/systemd/`.
"""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path
from typing import Annotated

import structlog
import typer

from case_record.cases import Cases
from case_record.presence import Hanging
from room_config.exit_codes import BAD_INPUT
from room_config.shell import announce, autospine, configure_logs, on_parent_gone
from service.cli.children import ChildError, Family, quiet_environment
from service.cli.room_checks import checked_room

app = typer.Typer(add_completion=False)
PROCESSES = ("listener", "worker", "service")
FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 10.0
END_S = 1.5
# longer than any unit of work takes between two beats
HUNG_S = 30.0
_MOST_START_S = 120.0
_STABLE_S = 30.0
_LOOK_S = 0.1
_ROTATE_EVERY_S = 5.0


@app.command()
def up(
    config: Annotated[Path, typer.Option("--config", help="The room's TOML file.")],
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="Exit when standard input is closed.")
    ] = False,
) -> None:
    """Run listener, worker and service; one that ends is started again."""
    configure_logs()
    quiet_environment()
    room, _ = checked_room(config)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        on_parent_gone(stop.set)
    home = Cases(*room.room.folders).home
    family = Family(home / "logs")
    hanging = Hanging(home, "up", HUNG_S)
    kept = [Kept(family, name, autospine(name, "--config", str(config))) for name in PROCESSES]
    try:
        _keep(family, kept, hanging, stop)
    finally:
        # nobody is waited for who does not come: a child that hangs is killed
        family.end_all([name for name in PROCESSES if name != "service"], END_S / 2)
        family.end_all(["service"], END_S / 2)
        hanging.close()


def _keep(family: Family, kept: list[Kept], hanging: Hanging, stop: threading.Event) -> None:
    """Look after the children until `stop`; the ready line is said once all of them are."""
    told, rotated_s = False, time.monotonic()
    while not stop.is_set():
        hung = hanging.look(PROCESSES)
        for one in kept:
            one.look(was_ready=told, hangs=one.name in hung)
        if not told and all(one.is_ready for one in kept):
            told = True
            facts = {one.name: family.children[one.name].ready for one in kept}
            announce({"url": facts["service"]["url"], "listener": facts["listener"]})
        if time.monotonic() - rotated_s > _ROTATE_EVERY_S:
            rotated_s = time.monotonic()
            family.rotate_logs()
        stop.wait(_LOOK_S)


class Kept:
    """One child, started again and again; how long it is waited grows while it keeps ending."""

    def __init__(self, family: Family, name: str, words: list[str]) -> None:
        self.name = name
        self._family = family
        self._words = words
        self._pause_s = 0.0
        self._start_at_s = 0.0
        self._started_s = 0.0
        self._runs = False

    @property
    def is_ready(self) -> bool:
        return self._runs and bool(self._family.children[self.name].ready)

    def look(self, *, was_ready: bool, hangs: bool = False) -> None:
        """Start it if it is due. ChildError if it can never run, which shows at the first start.

        hangs: it runs, and does nothing any more.
        """
        now_s = time.monotonic()
        if self._runs:
            child = self._family.children[self.name]
            if hangs or (not child.ready and now_s - self._started_s > _MOST_START_S):
                structlog.get_logger().error("a process hangs: killed", process=self.name)
                child.process.kill()
                child.process.wait()
            code = child.process.poll()
            if code is None:
                return
            if code == BAD_INPUT and not was_ready:
                raise ChildError(child.describe_end())
            self._has_ended(child.describe_end(), now_s)
        if not self._runs and now_s >= self._start_at_s:
            self._start(now_s)

    def _has_ended(self, text: str, now_s: float) -> None:
        self._runs = False
        if now_s - self._started_s > _STABLE_S:
            self._pause_s = 0.0
        self._pause_s = min(max(2 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
        self._start_at_s = now_s + self._pause_s
        structlog.get_logger().error(
            "a process ended", process=self.name, text=text, started_again_in_s=self._pause_s
        )

    def _start(self, now_s: float) -> None:
        self._started_s = now_s
        try:
            self._family.end(self.name)
            self._family.launch(self.name, self._words)
            self._runs = True
        except OSError as error:  # no memory or no descriptors for another process, for one
            self._has_ended(f"{self.name} could not be started: {error}", now_s)
