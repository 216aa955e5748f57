"""`autospine study benchtop --room`: the trials in the room, the measured places, the tables."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from room_config.load import ConfigError, load_config
from room_config.service import ServiceConfig
from service.client import RefusedByServiceError, RoomClient, ServiceGoneError
from simulator.scan_operator import TOKEN_VARIABLE
from studies.measured_places import read_places, write_form
from studies.navigation_report import draw_punctures, print_measured
from studies.navigation_study import PAPER_TABLE, STRATEGY_NAMES, NavigationStudy
from studies.room_trials import Log, RoomTrials, StudyEndedError, with_places

FORM = "places.csv"
_MOST_PUNCTURES = 1000


@dataclass(frozen=True)
class Asked:
    """What the command line asks for."""

    strategies: str
    punctures: int
    seed: int
    measured: Path | None
    px_per_mm: float | None
    hole_mm: tuple[float, float]

    @property
    def names(self) -> list[str]:
        """The strategies; ValueError names one that there is not, or that is there twice."""
        names = [name.strip() for name in self.strategies.split(",")]
        for name in names:
            if name not in STRATEGY_NAMES or names.count(name) > 1:
                raise ValueError(
                    f"--strategies: {name!r}: use each once, of {', '.join(STRATEGY_NAMES)}"
                )
        return names


def run_in_room(room: Path, out: Path, asked: Asked, *, as_json: bool) -> None:
    """Go on with the study in `out`; ValueError, OSError, StudyEndedError."""
    names = asked.names
    if not 3 <= asked.punctures <= _MOST_PUNCTURES:
        raise ValueError(f"--trials is {asked.punctures}; allowed: 3 to {_MOST_PUNCTURES}")
    if not 0 < asked.hole_mm[0] < asked.hole_mm[1] or (asked.px_per_mm or 1) <= 0:
        raise ValueError("--hole-mm and --px-per-mm must be positive, the larger radius last")
    try:
        service = load_config(room).service
    except ConfigError as error:
        raise ValueError(str(error)) from error
    console = Console(stderr=as_json)
    log = Log(out)
    tell = partial(console.print, highlight=False, soft_wrap=True)
    with _client(service) as client:
        try:
            trials = RoomTrials(client, log, lambda text: _ask(console, text), tell)
            trials.run(names, asked.punctures, asked.seed)
        except RefusedByServiceError as error:
            raise StudyEndedError(f"the room refused: {error}") from error
        except ServiceGoneError as error:
            raise StudyEndedError(f"{error}; run this again once it is back") from error
    measured = asked.measured
    if measured is None:
        measured = out / FORM
        if not measured.exists():
            write_form(measured, names, asked.punctures)
            console.print(
                f"All punctures are made. Measure them into {measured}, or photograph each sheet "
                "(--measured FOLDER --px-per-mm SCALE); then run this again."
            )
            return
    places = read_places(measured, names, asked.punctures, asked.px_per_mm, asked.hole_mm)
    study = with_places(names, asked.seed, log.made, places)
    files = draw_punctures(study, out)
    if as_json:
        print(json.dumps(_as_json(study, files), allow_nan=False))
        return
    print_measured(study, console)
    for file in files:
        console.print(f"written: {file}", highlight=False)


def _as_json(study: NavigationStudy, files: Sequence[Path]) -> dict[str, Any]:
    iterations, minutes = ("mean_iterations", "sd_iterations"), ("mean_minutes", "sd_minutes")
    kept = ("strategy", "punctures", "puncture_sd_mm", *iterations, *minutes, "median_frames")
    return {
        "strategies": [{k: asdict(row)[k] for k in kept} for row in study.summaries()],
        "f_tests": [asdict(test) for test in study.tests()],
        "paper": PAPER_TABLE[study.setup],
        "files": [str(file) for file in files],
    }


def _client(service: ServiceConfig) -> RoomClient:
    """Of the room's own service, with the operator's token from the environment."""
    scheme = "http" if service.tls_certificate is None else "https"
    host = "127.0.0.1" if service.host in ("0.0.0.0", "::") else service.host
    url = service.public_url or f"{scheme}://{host}:{service.port}"
    ca = None if service.public_url else service.tls_certificate
    return RoomClient(url, token=os.environ.get(TOKEN_VARIABLE, "").strip(), by="study", ca=ca)


def _ask(console: Console, text: str) -> None:
    """Show what a person has to do, and wait for Enter."""
    console.print(f"{text} Enter when done: ", end="", highlight=False, soft_wrap=True)
    try:
        input()
    except EOFError:
        raise StudyEndedError("no answer; run this again at a terminal to continue") from None
    console.print()
