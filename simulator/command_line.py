"""`autospine scanner`: the virtual scanner as a process."""

import contextlib
import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from room_config.exit_codes import BAD_INPUT
from room_config.load import ConfigError, read_toml
from simulator.config import VirtualRoom, VirtualRoomError, parse_virtual_room
from simulator.scan_operator import operate, read_token
from simulator.scanner import Note

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def scanner(
    config: Annotated[Path, typer.Option(help="The room's TOML file; its [virtual] table.")],
    exit_with_parent: Annotated[
        bool, typer.Option(help="Exit when standard input is closed.")
    ] = False,
) -> None:
    """A virtual scanner: acquires what the service asks for and sends it by C-STORE.

    Prints one JSON line when it is ready: {"ready": "scanner", "truth_file": …}.
    """
    try:
        room = _virtual_room(config)
        assert room.scanner is not None
        stop = stop_event(exit_with_parent)
        ready = {"ready": "scanner", "truth_file": room.scanner.truth_file}
        token = read_token(room.scanner, os.environ)
        operate(room, stop, note_as("scanner"), lambda: print(json.dumps(ready), flush=True), token)
    except (ConfigError, VirtualRoomError) as error:
        print(error, file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None


def _virtual_room(path: Path) -> VirtualRoom:
    try:
        room = parse_virtual_room(read_toml(path).get("virtual", {}))
    except VirtualRoomError as error:
        raise VirtualRoomError(f"{path}: {error}") from None
    if room.scanner is None:
        raise VirtualRoomError(f"{path}: virtual.scanner: missing table")
    # Relative to the configuration, as every path in it.
    paths = {
        name: str((path.parent / getattr(room.scanner, name)).resolve())
        for name in ("truth_file", "token_file")
        if getattr(room.scanner, name)
    }
    scanner = room.scanner.model_copy(update=paths)
    return room.model_copy(update={"scanner": scanner})


def stop_event(exit_with_parent: bool) -> threading.Event:
    """Set by SIGINT, SIGTERM and, if wanted, the end of standard input."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        threading.Thread(target=_stop_at_end_of_input, args=(stop,), daemon=True).start()
    return stop


def _stop_at_end_of_input(stop: threading.Event) -> None:
    # Not sys.stdin: a thread inside of its lock would break the interpreter's own exit.
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    stop.set()


def note_as(process: str) -> Note:
    """Writes one JSON object a line to standard error, under the name of the process."""

    def note(line: str) -> None:
        if line:
            print(json.dumps({"process": process, "note": line}), file=sys.stderr, flush=True)

    return note


if __name__ == "__main__":
    app()
