"""`autospine listener`: receive slices and assign them."""

import logging
import signal
import sys
import threading
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from case_record.record import CaseRecordError
from dicom_listener.check import self_check
from dicom_listener.process import run
from room_config.exit_codes import BAD_INPUT, COULD_NOT, DONE
from room_config.load import ConfigError, load_config
from room_config.shell import announce, configure_logs, on_parent_gone

# A slice passes through three threads before it is answered; each must not wait 5 ms (the default)
# for the one that reads headers.
_SWITCH_INTERVAL_S = 0.0005

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def listener(
    config: Annotated[Path, typer.Option("--config", help="The room's TOML file.")],
    check: Annotated[
        bool,
        typer.Option("--check", help="Test everything once (C-ECHO, write, clock, disk) and exit."),
    ] = False,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="Exit when standard input is closed.")
    ] = False,
) -> None:
    """Receive slices (C-STORE), keep them durably, and assign them to holds."""
    configure_logs(logging.INFO)
    # odd values stand with their slice in the record; a line of the log is for people
    warnings.filterwarnings("ignore", module="pydicom")
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        room = load_config(config)
        if check:
            sys.exit(_print_check(self_check(room)))
        run(room, _stop_event(exit_with_parent), lambda ready: announce(asdict(ready)))
    except (ConfigError, CaseRecordError) as error:
        _fail(str(error), BAD_INPUT)
    except OSError as error:
        _fail(f"listener: {error}", COULD_NOT)


def _print_check(results: list[tuple[str, bool, str]]) -> int:
    for name, passed, text in results:
        print(f"{'ok  ' if passed else 'FAIL'} {name}: {text}")
    return DONE if all(passed for _, passed, _ in results) else COULD_NOT


def _stop_event(exit_with_parent: bool) -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        on_parent_gone(stop.set)
    return stop


def _fail(text: str, code: int) -> None:
    print(f"autospine: {' '.join(text.split())}", file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    app()
