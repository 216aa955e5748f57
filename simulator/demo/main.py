"""`autospine demo`: the whole room, virtual, unattended, with the truth beside every estimate."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console

from case_record.record import CaseRecord
from room_config.exit_codes import BAD_INPUT, COULD_NOT, INTERRUPTED
from service.cli.children import ChildError, quiet_environment
from service.client import RoomClient
from simulator.config import FiducialKind, parse_virtual_room
from simulator.demo.attended import attend_room
from simulator.demo.operator import WHO, DemoFailedError, Operator
from simulator.demo.room import DemoOptions, DemoRoom, known_faults
from simulator.demo.screen import DemoScreen, final_table
from simulator.truth_client import TruthAddress
from simulator.unintended import ask_motions, unintended_motions

app = typer.Typer(add_completion=False)


class _Ended(Exception):
    """Ctrl-C or SIGTERM."""


@app.command()
def demo(
    exit_: Annotated[bool, typer.Option("--exit", help="Exit when done.")] = False,
    json_: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
    punctures: Annotated[int, typer.Option(min=1, help="Number of punctures.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of physics and targets.")] = 0,
    case: Annotated[
        Path | None, typer.Option(help="Case folder to keep; an existing case is continued.")
    ] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help=f"One of: {', '.join(known_faults())}.")
    ] = None,
    guide: Annotated[
        bool, typer.Option("--guide", help="Two fiducials and four axes, steering the needle tip.")
    ] = False,
    fiducial: Annotated[
        FiducialKind,
        typer.Option(help="Slightly oval with a cannula's void, or a plain sphere."),
    ] = "cannulated",
    page_port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free port.")] = 0,
    dicom_port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free port.")] = 0,
    attended: Annotated[
        bool,
        typer.Option("--attended", help="Operate the room yourself, on its page."),
    ] = False,
    tokens: Annotated[
        bool, typer.Option("--tokens", help="Require a token, as a room on a network does.")
    ] = False,
) -> int:
    """The whole room, virtual: calibration and punctures, unattended or by you on the page."""
    quiet_environment()
    for name in fault or ():
        if name not in known_faults():
            print(
                f"autospine: unknown fault {name!r}; known: {', '.join(known_faults())}",
                file=sys.stderr,
            )
            return BAD_INPUT
    # a folder of its own: the page lists the cases that lie beside this one
    home = case or Path(tempfile.mkdtemp(prefix="autospine-demo-"))
    folder = case or home / "demo"
    folder.mkdir(parents=True, exist_ok=True)
    code = INTERRUPTED
    with _signals():
        faults = tuple(fault or ())
        options = DemoOptions(
            folder,
            seed,
            faults,
            page_port,
            dicom_port,
            tokens=tokens,
            guide=guide,
            attended=attended,
            fiducial=fiducial,
        )
        if attended:
            code = attend(DemoRoom(options))
        else:
            code = _run(DemoRoom(options), punctures, leave=exit_, as_json=json_)
    if case is None and code != COULD_NOT:
        shutil.rmtree(home, ignore_errors=True)  # what failed may be gone on with
    return code


def _run(room: DemoRoom, punctures: int, *, leave: bool, as_json: bool) -> int:
    screen = DemoScreen(Console(stderr=True), room.folder)
    operator: Operator | None = None
    try:
        screen.note("starting the processes of the virtual room")
        room.start()
        screen.note(f"page: {room.url}")
        if room.operator_token:
            screen.note(f"log in there as operator with the token {room.operator_token}")
        virtual = parse_virtual_room(room.virtual_table)
        truth = TruthAddress("127.0.0.1", room.truth_port)
        results_file = room.virtual_dir / "punctures.jsonl"
        client = RoomClient(room.url, token=room.operator_token, by=WHO)
        operator = Operator(client, virtual, truth, results_file, room.options.seed)
        with screen:
            operator.run(punctures, lambda s: screen.show(s, operator), room.check)
        with CaseRecord(room.folder) as record:
            record.verify_events()
            unintended = unintended_motions(ask_motions(truth), record.moves())
        _print_results(operator, len(unintended), as_json)
        if not leave:
            screen.note(f"done; the page stays at {room.url} until Ctrl-C")
            _wait_until_ended(room)
        return 0
    except _Ended:
        screen.note("ending")
        return 0 if operator is not None and len(operator.results) >= punctures else INTERRUPTED
    except (ChildError, DemoFailedError) as error:
        _stand_still(room, operator, screen)
        print(f"autospine: {error}", file=sys.stderr)
        print(
            "autospine: the robot stands still; continue with: autospine demo --case "
            f"{room.folder}",
            file=sys.stderr,
        )
        return COULD_NOT
    finally:
        if operator is not None:
            operator.close()
        room.end()


def attend(room: DemoRoom) -> int:
    """Let a person operate the room until Ctrl-C."""
    screen = DemoScreen(Console(stderr=True), room.folder)
    try:
        screen.note("starting the processes of the virtual room")
        room.start()
        attend_room(room, screen.note)
        return 0
    except _Ended:
        screen.note("ending")
        return 0
    except ChildError as error:
        screen.note(room.wait_for_standstill())
        print(f"autospine: {error}", file=sys.stderr)
        return COULD_NOT
    finally:
        room.end()


def _stand_still(room: DemoRoom, operator: Operator | None, screen: DemoScreen) -> None:
    """Something is broken: press STOP, then see that nothing moves any more."""
    if operator is not None:
        operator.stop()
    screen.note(room.wait_for_standstill())


def _print_results(operator: Operator, unintended: int, as_json: bool) -> None:
    if as_json:
        punctures = [result.public() for result in operator.results]
        print(json.dumps({"punctures": punctures, "unintended_motions": unintended}))
        return
    Console().print(final_table(operator.results, unintended))


def _wait_until_ended(room: DemoRoom) -> None:
    while True:
        room.check()
        threading.Event().wait(0.2)


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """Make SIGTERM and Ctrl-C end the demo through its `finally` blocks, once."""

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        raise _Ended

    before: dict[int, Any] = {
        number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    except _Ended:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
