"""`autospine commission`: with a phantom on the table, measure what a site must know."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

import typer

from dicom_listener.promptness import FEWEST_DELAYS, TooFewDelaysError
from room_config.exit_codes import BAD_INPUT, COULD_NOT, DONE
from room_config.load import Config, load_config
from service.commissioning.acceptance import Item, as_toml, items_of, room_keys
from service.commissioning.clocks import find_clock
from service.commissioning.evidence import CommissioningError, Press
from service.commissioning.imaging import find_imaging
from service.commissioning.motion import jacobian_items, jacobian_of_case
from service.commissioning.report import Signature, verdict_of, write_html, write_pdf
from service.commissioning.session import Session, Step

app = typer.Typer(add_completion=False)
_LOOK_S = 0.1


class BrokenOffError(Exception):
    """Standard input ended: somebody goes on later."""

    exit_code = COULD_NOT


@app.command()
def commission(
    config: Annotated[Path, typer.Option("--config", help="The room's TOML file.")],
    out: Annotated[
        Path, typer.Option(help="Folder for the evidence; name the same one to continue.")
    ],
    who: Annotated[str, typer.Option(help="Who measures and signs.")],
    series: Annotated[
        int, typer.Option(min=1, help="Number of series with the usual readout.")
    ] = 5,
    slices: Annotated[int, typer.Option(min=1, help="Slices per series.")] = 4,
    reversed_readout: Annotated[
        bool, typer.Option(help="One more series with the readout direction reversed.")
    ] = True,
    patience_s: Annotated[
        float, typer.Option(min=1, help="How long to wait for the slices of a series.")
    ] = 300.0,
    case: Annotated[
        Path | None,
        typer.Option(help="Folder of a case calibrated here; its image Jacobian is accepted too."),
    ] = None,
) -> None:
    """Measure the clocks, promptness and imaging of a site; write keys and an acceptance."""
    warnings.filterwarnings("ignore", module="pydicom")
    if series * slices < FEWEST_DELAYS:
        print(
            f"autospine: at least {FEWEST_DELAYS} slices are needed; {series} series of {slices} "
            f"would give {series * slices}",
            file=sys.stderr,
        )
        raise SystemExit(BAD_INPUT)
    room = load_config(config)
    motion = [] if case is None else jacobian_items(jacobian_of_case(case), case.name)
    with Session(room, out) as session:
        print(f"Slices are received on port {session.port} as {room.listener.ae_title}.")
        print("Put a phantom with the fiducial on the table and leave it still; nothing may move.")
        for step in session.steps(series, reversed_too=reversed_readout):
            while not _scan(session, step, slices, patience_s):
                print("The same series again.")
        raise SystemExit(_judge(session, room, who, out, motion))


def _scan(session: Session, step: Step, slices: int, patience_s: float) -> bool:
    """One series; False where it has to be made again."""
    how = ", READOUT DIRECTION REVERSED" if step.reversed_readout else ""
    print(f"Series {step.number}: {slices} coronal slices with the guide's protocol{how}.")
    started = _pressed("start", "Press Enter the moment it STARTS.")
    ended = _pressed("end", "Press Enter the moment it ENDS.")
    deadline_s = time.monotonic() + patience_s
    while len(came := session.came_since(started)) < slices and time.monotonic() < deadline_s:
        time.sleep(_LOOK_S)
    print(f"{len(came)} of {slices} slices arrived.", flush=True)
    try:
        session.keep(step, started, ended)
    except CommissioningError as error:
        print(f"Not used: {error}.")
        return False
    return True


def _pressed(kind: str, words: str) -> Press:
    print(words, flush=True)
    if not sys.stdin.readline():
        raise BrokenOffError("interrupted; run it again with the same --out to continue")
    return Press("start" if kind == "start" else "end", time.time())


def _judge(session: Session, room: Config, who: str, out: Path, motion: list[Item]) -> int:
    """Write what was found; 0 where all of it is within its limits."""
    scanned, site = session.series(), room.room.name
    try:
        clock, images = find_clock(scanned), find_imaging(scanned, room.imaging)
    except TooFewDelaysError as error:
        raise CommissioningError(f"{error}: scan more series") from None
    items = [*items_of(clock, images), *motion]
    signature = Signature(who, time.time(), session.digest())
    (out / "room_keys.toml").write_text(
        as_toml(room_keys(clock, images), f"By autospine commission. {signature}")
    )
    findings = {
        "clock": dataclasses.asdict(clock),
        "imaging": dataclasses.asdict(images),
        "items": [dataclasses.asdict(item) for item in items],
    }
    (out / "findings.json").write_text(json.dumps(findings, indent=1))
    write_html(out / "acceptance.html", site, items, signature)
    write_pdf(out / "acceptance.pdf", site, items, signature)
    for item in items:
        print(f"{item.what}: {item.value}")
    print(f"{verdict_of(items)}. Keys for the room's file: {out / 'room_keys.toml'}")
    return COULD_NOT if any(item.passed is False for item in items) else DONE
