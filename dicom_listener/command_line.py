"""`autospine listener`: receive slices and assign them."""

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import structlog
import typer

from case_record.record import CaseRecordError
from dicom_listener.check import self_check
from dicom_listener.process import Ready, run
from room_config.load import ConfigError, load_config

BAD_INPUT = 2
COULD_NOT = 3
# A slice passes through three threads before it is answered; each must not wait 5 ms (the default)
# for the one that reads headers.
_SWITCH_INTERVAL_S = 0.0005

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def listener(
    config: Annotated[Path, typer.Option("--config", help="The room's TOML file.")],
    check: Annotated[
        bool,
        typer.Option("--check", help="Try everything once (C-ECHO, write, clock, disk) and end."),
    ] = False,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when standard input is closed.")
    ] = False,
) -> None:
    """Receive slices (C-STORE), keep them durably, and assign them to holds."""
    _log_to_stderr()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        room = load_config(config)
        if check:
            sys.exit(_print_check(self_check(room)))
        run(room, _stop_event(exit_with_parent), _announce)
    except (ConfigError, CaseRecordError) as error:
        _fail(str(error), BAD_INPUT)
    except OSError as error:
        _fail(f"listener: {error}", COULD_NOT)


def _announce(ready: Ready) -> None:
    print(json.dumps({"ready": True, **asdict(ready)}), flush=True)


def _print_check(results: list[tuple[str, bool, str]]) -> int:
    for name, passed, text in results:
        print(f"{'ok  ' if passed else 'FAIL'} {name}: {text}")
    return 0 if all(passed for _, passed, _ in results) else COULD_NOT


def _stop_event(exit_with_parent: bool) -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        _when_input_ends(stop.set)
    return stop


def _when_input_ends(end: Callable[[], None]) -> None:
    def wait() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 4096):
                pass
        end()

    threading.Thread(target=wait, name="parent", daemon=True).start()


def _log_to_stderr() -> None:
    """Text on a terminal, one JSON object a line elsewhere; standard output is the ready line's."""
    renderer: structlog.typing.Processor = (
        structlog.dev.ConsoleRenderer()
        if sys.stderr.isatty()
        else structlog.processors.JSONRenderer()
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(20),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )


def _fail(text: str, code: int) -> None:
    print(f"autospine: {' '.join(text.split())}", file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    app()
