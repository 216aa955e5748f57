"""`autospine up`: the control-room computer's listener, worker and service, supervised."""

from __future__ import annotations

import contextlib
import signal
import threading
from pathlib import Path
from typing import Annotated

import structlog
import typer

from case_record.cases import Cases
from room_config.load import load_config
from room_config.shell import announce, autospine, configure_logs, on_parent_gone
from service.cli.children import ChildError, Family, quiet_environment

app = typer.Typer(add_completion=False)
_PROCESSES = ("listener", "worker", "service")
_RESTART_WAIT_S = 1.0
_RESTARTS_IN_A_ROW = 5
_STABLE_S = 30.0


@app.command()
def up(
    config: Annotated[Path, typer.Option("--config", help="The room's TOML file.")],
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when standard input is closed.")
    ] = False,
) -> None:
    """Run listener, worker and service; one that dies is started again."""
    configure_logs()
    quiet_environment()
    room = load_config(config)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        on_parent_gone(stop.set)
    family = Family(Cases(*room.room.folders).home / "logs")
    try:
        for name in _PROCESSES:
            family.launch(name, autospine(name, "--config", str(config)))
        facts = {n: family.children[n].wait_ready(30.0) for n in _PROCESSES}
        announce({"url": facts["service"]["url"], "listener": facts["listener"]})
        _watch(family, config, stop)
    finally:
        family.end()


def _watch(family: Family, config: Path, stop: threading.Event) -> None:
    """Start again whoever dies; ChildError when that happens too often in a row."""
    log = structlog.get_logger()
    restarts, quiet_s = 0, 0.0
    while not stop.wait(0.2):
        quiet_s += 0.2
        if quiet_s > _STABLE_S:
            restarts = 0
        dead = family.dead()
        if dead is None:
            continue
        restarts, quiet_s = restarts + 1, 0.0
        text = dead.describe_end()
        log.error("a process ended", process=dead.name, text=text, restarts=restarts)
        if restarts > _RESTARTS_IN_A_ROW:
            raise ChildError(text)
        stop.wait(_RESTART_WAIT_S)
        family.end(dead.name)
        family.launch(dead.name, autospine(dead.name, "--config", str(config)))
        # one that does not come up is found dead in the next round and counted again
        with contextlib.suppress(ChildError):
            family.children[dead.name].wait_ready(30.0)
