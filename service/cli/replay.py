"""`autospine replay CASE`: go through a recorded case step by step, also with another method.

Every procedure is fed its recorded outcomes again and must take the recorded steps; every
measurement is made again from the recorded slices. Nothing in the case is changed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from case_record.record import CaseRecord
from case_record.rows import Measurement, Procedure
from dicom_slice.reasons import UnusableError
from room_config.exit_codes import BAD_INPUT, COULD_NOT
from service.procedure.estimate import axis_sigma
from service.procedure.observe import ProcedureFailedError
from service.procedure.registry import build_procedure
from service.procedure.runner import ReplayMismatchError, same_step
from service.procedure.steps import outcome_from_json
from sr_engine.errors import EngineError
from sr_engine.request import UnusableSlicesError
from sr_engine.result import describe_result, recorded_point_spread
from sr_engine.worker import Known, frames_then, gather_frames, localize_as_asked

app = typer.Typer(add_completion=False)
METHODS = ("ml", "base", "bicubic", "sr")


class ReplayError(ValueError):
    """The case cannot be replayed as asked."""

    exit_code = BAD_INPUT


@dataclass(frozen=True)
class ReplayedProcedure:
    """`ended`: how it ended when fed its outcomes; `agrees`: as it is recorded."""

    procedure_id: int
    name: str
    state: str
    steps: int
    ended: str
    agrees: bool


@dataclass(frozen=True)
class ReplayedMeasurement:
    """A measurement and what `method` says of the same slices; places in the image plane, mm.

    difference_mm is replayed minus recorded; None where either of them has no place.
    """

    measurement_id: int
    recorded_method: str
    method: str
    frames: int
    recorded_mm: tuple[float, float] | None
    replayed_mm: tuple[float, float] | None
    difference_mm: float | None
    sigma_mm: float | None
    reason: str


@app.command()
def replay(
    case: Annotated[Path, typer.Argument(help="The case's folder.")],
    method: Annotated[
        str | None, typer.Option(help=f"Measure with this method instead: {', '.join(METHODS)}.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of tables.")] = False,
) -> int:
    """Go through a recorded case step by step; with --method, what another one would have said."""
    if method is not None and method not in METHODS:
        raise ReplayError(f"unknown method {method!r}; known: {', '.join(METHODS)}")
    with CaseRecord(case) as record:
        events = record.verify().events
        procedures = [replay_procedure(record, row) for row in record.procedures()]
        measurements = list(replay_measurements(record, method))
    if as_json:
        print(json.dumps(_as_json(events, procedures, measurements), allow_nan=False))
    else:
        _print(events, procedures, measurements)
    if all(row.agrees for row in procedures):
        return 0
    print("autospine: a procedure does not repeat its recorded steps", file=sys.stderr)
    return COULD_NOT


def replay_procedure(record: CaseRecord, row: Procedure) -> ReplayedProcedure:
    """Feed a fresh generator the recorded outcomes and see whether it takes the recorded steps."""
    steps = record.steps(row.procedure_id)
    procedure = build_procedure(row)
    ended = "waits"
    number = 0
    try:
        step = next(procedure)
        for number, known in enumerate(steps):
            if not same_step(known, step):
                ended = f"takes a different step {number}"
                break
            if known.outcome is None:
                break
            step = procedure.send(outcome_from_json(known.kind, known.outcome))
    except StopIteration:
        ended = "done"
    except ProcedureFailedError as error:
        ended = f"failed: {error}"
    except ReplayMismatchError as error:
        ended = str(error)
    finally:
        procedure.close()
    return ReplayedProcedure(
        row.procedure_id, row.name, row.state, len(steps), ended, _agrees(row, ended)
    )


def _agrees(row: Procedure, ended: str) -> bool:
    """Aborted and running procedures stand wherever they were left."""
    if row.state == "done":
        return ended == "done"
    if row.state == "failed":
        return ended.startswith("failed") and str((row.result or {}).get("reason")) in ended
    return ended == "waits"


def replay_measurements(record: CaseRecord, method: str | None) -> Iterator[ReplayedMeasurement]:
    """Make every measurement again, in order; `method` None: by the recorded method."""
    known = Known()
    for row in record.measurements():
        if row.state != "requested":
            yield _replay_one(record, row, method or row.method, known)


def _replay_one(
    record: CaseRecord, row: Measurement, method: str, known: Known
) -> ReplayedMeasurement:
    recorded = None if row.result is None else np.array(row.result["plane_mm"])
    frames, reason = 0, ""
    replayed = sigma = None
    try:
        taken = frames_then(gather_frames(record, row), row)
        frames = len(taken.pixels)
        psf = recorded_point_spread(row.result) or known.psfs.of(taken)
        answer = localize_as_asked(record, row, taken, psf, known, method)
        found = describe_result(taken, answer)
        replayed = np.array(found["plane_mm"])
        sigma = axis_sigma(found["covariance_mm2"])
    except (EngineError, UnusableSlicesError, UnusableError) as error:
        reason = " ".join(str(error).split())
    both = recorded is not None and replayed is not None
    difference = float(np.linalg.norm(replayed - recorded)) if both else None  # type: ignore[operator]
    return ReplayedMeasurement(
        row.measurement_id,
        row.method,
        method,
        frames,
        _pair(recorded),
        _pair(replayed),
        difference,
        sigma,
        reason,
    )


def _pair(place: np.ndarray | None) -> tuple[float, float] | None:
    return None if place is None else (float(place[0]), float(place[1]))


def _as_json(
    events: int,
    procedures: list[ReplayedProcedure],
    measurements: list[ReplayedMeasurement],
) -> dict[str, Any]:
    return {
        "events_verified": events,
        "procedures": [asdict(row) for row in procedures],
        "measurements": [asdict(row) for row in measurements],
    }


def _print(
    events: int,
    procedures: list[ReplayedProcedure],
    measurements: list[ReplayedMeasurement],
) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console.print(f"{events} events, the event chain verifies")
    table = Table("procedure", "", "recorded", "steps", "replayed", "agrees")
    for one in procedures:
        agrees = "yes" if one.agrees else "NO"
        table.add_row(str(one.procedure_id), one.name, one.state, str(one.steps), one.ended, agrees)
    console.print(table)
    table = Table("measurement", "recorded by", "replayed by", "frames", "σ µm", "difference µm")
    for row in measurements:
        table.add_row(
            str(row.measurement_id),
            row.recorded_method,
            row.method,
            str(row.frames),
            _um(row.sigma_mm),
            _um(row.difference_mm) if not row.reason else row.reason,
        )
    console.print(table)


def _um(value_mm: float | None) -> str:
    return "" if value_mm is None else f"{value_mm * 1000:.1f}"
