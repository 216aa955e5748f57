"""`autospine`: one command, its subcommands imported only when they are called.

The computer in the scanner room has few packages; whatever a subcommand needs is imported by that
subcommand alone. Exit codes: 0 done, 2 bad input or configuration, 3 could not do it.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

from room_config.exit_codes import BAD_INPUT, COULD_NOT, INTERRUPTED

# name: (module:attribute, what it does); an attribute called `main` takes the arguments as a list
SUBCOMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("simulator.demo.main:app", "The whole room, virtual."),
    "up": ("service.cli.supervisor:app", "Listener, worker and service under one supervisor."),
    "listener": ("dicom_listener.command_line:app", "Receive slices and assign them."),
    "worker": ("service.cli.processes:worker", "Localize and reconstruct."),
    "service": ("service.cli.processes:service", "Page, API, procedures and planning."),
    "bridge": ("robot_bridge.__main__:main", "The daemon in the scanner room."),
    "robot": ("robot_bridge.engineer.main:main", "Engineering commands for bridge and motors."),
    "emulator": ("robot_bridge.emulator.main:main", "Emulated motor controllers alone."),
    "scanner": ("simulator.command_line:scanner", "The virtual scanner alone."),
    "camera": ("bench.command_line:app", "A camera over the robot in place of the scanner."),
    "locate": ("service.cli.locate:app", "Find the round objects in DICOM files."),
    "reconstruct": (
        "service.cli.reconstruct_files:app",
        "Super-resolution image from DICOM files.",
    ),
    "study": ("studies.command_line:app", "The paper's studies beside our own."),
    "token": ("service.cli.token_command:token", "Make an access token for a person."),
    "replay": ("service.cli.replay:app", "Replay a recorded case, optionally with another method."),
    "export": ("service.cli.export:app", "Export a case as one zip: DICOM, JSON lines, images."),
    "report": ("service.cli.report:app", "Report of a case as one page: images, tables, plots."),
    "commission": (
        "service.cli.commission:app",
        "Commission a site with a phantom: clock, delays, imaging.",
    ),
    "check-config": ("service.cli.check_config:app", "Check a room's configuration."),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `autospine`."""
    # what is written holds patient data: for its owner alone
    os.umask(0o077)
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_usage())
        sys.exit(0)
    if words[0] == "--version":
        print(_version())
        sys.exit(0)
    name, rest = words[0], words[1:]
    if name not in SUBCOMMANDS:
        _fail(f"unknown command {name!r}; known: {', '.join(SUBCOMMANDS)}", BAD_INPUT)
    sys.exit(_run(name, rest))


def _run(name: str, words: list[str]) -> int:
    place, _ = SUBCOMMANDS[name]
    module_name, attribute = place.split(":")
    try:
        entry = getattr(importlib.import_module(module_name), attribute)
        if attribute == "main":
            return int(entry(words) or 0)
        return _run_typer(entry, name, words)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        if os.environ.get("AUTOSPINE_DEBUG"):
            raise
        code = int(getattr(error, "exit_code", 0))
        if not code:
            _fail(
                f"{name}: unexpected {type(error).__name__}: {_one_line(error)} "
                "(AUTOSPINE_DEBUG=1 shows where)",
                COULD_NOT,
            )
        _fail(_one_line(error), code)
        return code


def _run_typer(entry: Any, name: str, words: list[str]) -> int:
    import typer

    app = entry
    if not isinstance(entry, typer.Typer):
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        app.command()(entry)
    try:
        result = typer.main.get_command(app).main(
            words, prog_name=f"autospine {name}", standalone_mode=False
        )
    except Exception as error:
        # usage errors of the command-line library carry their own one-line text
        show: Callable[[], str] | None = getattr(error, "format_message", None)
        if show is None:
            raise
        _fail(f"{name}: {show()}", BAD_INPUT)
    return int(result) if isinstance(result, int) else 0


def _fail(text: str, code: int) -> None:
    print(f"autospine: {text}", file=sys.stderr)
    sys.exit(code)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _usage() -> str:
    width = max(map(len, SUBCOMMANDS))
    rows = [f"  {name:<{width}}  {text}" for name, (_, text) in SUBCOMMANDS.items()]
    return "\n".join(
        [
            "usage: autospine COMMAND [OPTIONS]   (autospine COMMAND --help)",
            "",
            *rows,
            "",
            "Research software, not a medical device.",
        ]
    )


def _version() -> str:
    from importlib.metadata import version

    return f"autospine {version('autospine')}"


if __name__ == "__main__":
    main()
