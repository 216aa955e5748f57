"""`autospine study ...`: the paper's experiments repeated, and ours beside them."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer

from room_config.exit_codes import BAD_INPUT
from simulator.config import FiducialKind

app = typer.Typer(no_args_is_help=True, help="Repeat the paper's experiments beside our own.")

PIPE_WIDTH = 120


@app.callback()
def study() -> None:
    """Repeat the paper's experiments beside our own."""


@app.command()
def numerical(
    trials: Annotated[int, typer.Option(help="Number of circle positions.")] = 100,
    seed: Annotated[
        int, typer.Option(help="Seed of every random draw; the same seed gives the same numbers.")
    ] = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for CSV, PNG and SVG.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of tables.")] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://HOST:PORT.")
    ] = None,
    map_trials: Annotated[
        int, typer.Option(help="Trials per cell of the map; 0 leaves it out.")
    ] = 10,
    radius: Annotated[
        float, typer.Option(help="Radius of the circle, px of the base frame.")
    ] = 4.0,
    snr: Annotated[float, typer.Option(help="Amplitude over noise per channel.")] = 20.0,
    blur: Annotated[float, typer.Option(help="Sigma of the Gaussian blur, px.")] = 0.2,
    sensitivity: Annotated[
        float, typer.Option(help="Sensitivity of the circle finder, 0 to 1.")
    ] = 0.85,
    shift_set: Annotated[
        str, typer.Option(help="paper (random), quarter, half or lattice5.")
    ] = "paper",
) -> None:
    """The paper's Table I: base frame, bicubic and SR beside the maximum-likelihood fit."""
    with _one_line_errors():
        _check(trials, map_trials, seed, radius, snr, blur)
        _run_numerical(
            trials,
            map_trials,
            {
                "seed": seed,
                "radius_px": radius,
                "snr": snr,
                "blur_sigma_px": blur,
                "sensitivity": sensitivity,
                "shift_set": shift_set,
            },
            out,
            as_json,
            scheduler,
        )


@app.command()
def benchtop(
    trials: Annotated[
        int | None,
        typer.Option(
            help="Punctures per strategy (default: 140, in rooms of 14; with --room: 14)."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of every random draw; the same seed gives the same numbers.")
    ] = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for CSV, PNG and SVG.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of tables.")] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://HOST:PORT.")
    ] = None,
    snr: Annotated[float, typer.Option(help="Contrast over noise, one camera pixel.")] = 10.0,
    step_scatter: Annotated[
        float, typer.Option(help="Relative scatter of the motors' step length.")
    ] = 0.002,
    room: Annotated[
        Path | None, typer.Option(help="Drive this real room instead (its room.toml); needs --out.")
    ] = None,
    strategies: Annotated[
        str, typer.Option(help="With --room: those to compare, in this order.")
    ] = "base,bicubic,sr,hybrid,adaptive",
    measured: Annotated[
        Path | None,
        typer.Option(help="With --room: places as CSV, or a folder of photos STRATEGY.png."),
    ] = None,
    px_per_mm: Annotated[float | None, typer.Option(help="Scale of the photos.")] = None,
    hole_mm: Annotated[
        tuple[float, float], typer.Option(help="Least and largest radius of a hole in the photos.")
    ] = (0.1, 0.8),
) -> None:
    """The paper's Table III, benchtop columns: every strategy steers by the camera.

    With --room it drives the real room through the paper's Table II; the same command again goes on
    where it ended.
    """
    with _one_line_errors():
        if room is None:
            _run_navigation(
                "benchtop", trials or 140, seed, out, as_json, scheduler, snr, step_scatter
            )
            return
        if out is None:
            raise ValueError("--room needs --out: the folder in which the study is kept")
        # Loaded here, so that the command's help costs nothing.
        from studies.room_study import Asked, run_in_room

        asked = Asked(strategies, trials or 14, seed, measured, px_per_mm, hole_mm)
        run_in_room(room, out, asked, as_json=as_json)


@app.command()
def mri(
    trials: Annotated[int, typer.Option(help="Punctures per strategy, in rooms of 14.")] = 140,
    seed: Annotated[
        int, typer.Option(help="Seed of every random draw; the same seed gives the same numbers.")
    ] = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for CSV, PNG and SVG.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of tables.")] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://HOST:PORT.")
    ] = None,
    snr: Annotated[float, typer.Option(help="Signal over noise per channel, one pixel.")] = 10.0,
    step_scatter: Annotated[
        float, typer.Option(help="Relative scatter of the motors' step length.")
    ] = 0.002,
    fiducial: Annotated[
        FiducialKind,
        typer.Option(help="A sphere, or slightly oval with a cannula's void."),
    ] = "sphere",
    encoders: Annotated[bool, typer.Option("--encoders", help="On every axis.")] = False,
) -> None:
    """The paper's Table III, MRI columns: every strategy steers by the virtual scanner."""
    with _one_line_errors():
        room = (fiducial, encoders)
        _run_navigation("mri", trials, seed, out, as_json, scheduler, snr, step_scatter, room)


def _run_navigation(
    setup: Literal["benchtop", "mri"],
    trials: int,
    seed: int,
    out: Path | None,
    as_json: bool,
    scheduler: str | None,
    snr: float,
    step_scatter: float,
    room: tuple[FiducialKind, bool] = ("sphere", False),
) -> None:
    checks = (
        (3 <= trials <= 1_000_000, f"--trials is {trials}; allowed: 3 to 1000000"),
        (0 <= seed < 2**31, f"--seed is {seed}; allowed: 0 to 2147483647"),
        (5.0 <= snr <= 1e6, f"--snr is {snr:g}; allowed: 5 to 1000000"),
        (0.0 <= step_scatter <= 0.05, f"--step-scatter is {step_scatter:g}; allowed: 0 to 0.05"),
    )
    for holds, message in checks:
        if not holds:
            raise ValueError(message)
    # Loaded here, so that the command's help costs nothing.
    from rich.console import Console

    from studies import cluster, navigation_report, navigation_study

    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    fiducial, encoders = room
    groups = navigation_study.groups_of(
        setup, trials, seed, snr, step_scatter, fiducial, encoders=encoders
    )
    with cluster.mapper(scheduler) as mapper, _progress_bar("rooms", len(groups)) as advance:
        study = navigation_study.run_study(setup, groups, mapper, advance)
    files: list[Path] = []
    if out is not None:
        files = navigation_report.write_csv(study, out)
        files += navigation_report.draw_punctures(study, out)
    if as_json:
        settings: dict[str, object] = {"trials": trials, "seed": seed, "snr": snr}
        settings |= {"step_scatter": step_scatter, "fiducial": fiducial, "encoders": encoders}
        typer.echo(json.dumps(navigation_report.as_json(study, settings, files), allow_nan=False))
        return
    console = Console()
    navigation_report.print_tables(study, console)
    for file in files:
        console.print(f"written: {file}", highlight=False)


def _run_numerical(
    trials: int,
    map_trials: int,
    parameters: dict[str, object],
    out: Path | None,
    as_json: bool,
    scheduler: str | None,
) -> None:
    # The matrices are small: threads would only wait for each other. Before numpy is loaded.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    # Loaded here, so that the command's help costs nothing.
    from rich.console import Console

    from studies import cluster, numerical_figures, numerical_report, numerical_study
    from studies.numerical import StudyPoint

    point = StudyPoint(**parameters)  # type: ignore[arg-type]
    _check_point(point)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    total = numerical_study.trials_in_all(trials, map_trials)
    with cluster.mapper(scheduler) as mapper, _progress_bar("trials", total) as advance:
        study = numerical_study.run_study(point, trials, map_trials, mapper, advance)
    files: list[Path] = []
    if out is not None:
        files = numerical_report.write_csv(study, out) + numerical_figures.draw_all(study, out)
    if as_json:
        typer.echo(json.dumps(numerical_report.as_json(study, files), allow_nan=False))
        return
    console = Console() if sys.stdout.isatty() else Console(width=PIPE_WIDTH)
    numerical_report.print_tables(study, console)
    for file in files:
        console.print(f"written: {file}", highlight=False)


def _check(trials: int, map_trials: int, seed: int, radius: float, snr: float, blur: float) -> None:
    checks = (
        (2 <= trials <= 1_000_000, f"--trials is {trials}; allowed: 2 to 1000000"),
        (
            map_trials == 0 or 2 <= map_trials <= 100_000,
            f"--map-trials is {map_trials}; allowed: 0, or 2 to 100000",
        ),
        (0 <= seed < 2**63, f"--seed is {seed}; it must not be negative"),
        (1.5 <= radius <= 20.0, f"--radius is {radius:g} px; allowed: 1.5 to 20"),
        (1.0 <= snr <= 1e6, f"--snr is {snr:g}; allowed: 1 to 1000000"),
        (0.0 <= blur <= 3.0, f"--blur is {blur:g} px; allowed: 0 to 3"),
    )
    for holds, message in checks:
        if not holds:
            raise ValueError(message)


def _check_point(point: object) -> None:
    """What only the engine knows: the sensitivity's range, the names of the shift sets."""
    from sr_engine.reconstruction.shiftset import named
    from studies.numerical import StudyPoint

    assert isinstance(point, StudyPoint)
    _ = point.hough
    if point.shift_set != "paper":
        named(point.shift_set)


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Bad input ends in one line on stderr and exit code 2."""
    try:
        yield
    except (ValueError, OSError) as error:
        typer.echo(f"autospine study: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(BAD_INPUT) from error


@contextmanager
def _progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on a terminal, nothing in a pipe."""
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, advance=done)
