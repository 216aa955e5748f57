"""`autospine locate`: the round objects in DICOM files, with covariance, in px and patient mm."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from dicom_slice.header import Slice
from dicom_slice.read import Frame, read_frames
from dicom_slice.reasons import UnusableError
from room_config.exit_codes import COULD_NOT, DONE
from service.cli.files import BadFileError, files_of, geometry_of, read_shift_table
from service.cli.locate_template import locate_by_template
from sr_engine.checks import refuse_non_square
from sr_engine.detect import detect
from sr_engine.errors import EngineError, NoRoundObjectError
from sr_engine.localization import Localization
from sr_engine.localize import localize
from sr_engine.locate import Located, locate_all
from sr_engine.recognise import psf_of_noise

RADIUS_SLACK = 0.03  # of the range's ends: what a radius is uncertain by
METHODS = ("ml", "sr", "bicubic", "base")
app = typer.Typer(add_completion=False)


@app.command()
def locate(
    path: Annotated[list[Path], typer.Argument(help="DICOM files or folders.")],
    shifts: Annotated[
        Path | None,
        typer.Option(
            help="CSV with the columns file,row_px,col_px: localize one object from all files "
            "together."
        ),
    ] = None,
    template: Annotated[
        Path | None,
        typer.Option(
            help="CSV with the columns file,row_px,col_px: learn the object's image from the files "
            "listed (beside the CSV), and fit it in every file of PATH."
        ),
    ] = None,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = "ml",
    radius_mm: Annotated[str, typer.Option(help="Smallest and largest radius: LO,HI.")] = "2,20",
    roi: Annotated[str, typer.Option(help="Region to search, in pixels: R0,C0,R1,C1.")] = "",
    json_: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    png: Annotated[Path | None, typer.Option(help="Write a PNG of what was found.")] = None,
) -> int:
    """Find the round objects in DICOM files."""
    if method not in METHODS:
        raise BadFileError(f"--method {method}: use one of {', '.join(METHODS)}")
    radii_mm = _numbers(radius_mm, 2, "--radius-mm")
    region = tuple(round(x) for x in _numbers(roi, 4, "--roi")) if roi else None
    if template is not None and (shifts is not None or method != "ml"):
        raise BadFileError("--template cannot be combined with --shifts or --method")
    if template is not None:
        found, shown, problems = _locate_by_template(path, template, radii_mm, region)
    elif shifts is not None:
        found, shown, problems = _locate_together(path, shifts, method, radii_mm, region)
    else:
        found, shown, problems = _locate_each(path, method, radii_mm, region)
    console = Console(stderr=True)
    for problem in problems:
        console.print(f"autospine: {problem}", style="yellow", highlight=False, soft_wrap=True)
    if png is not None and shown:
        from service.cli.overlay import write_overlay  # plotting is slow to import

        write_overlay(png, [(frame, [f["_found"] for f in rows]) for frame, rows in shown])
    rows = [{k: v for k, v in row.items() if k != "_found"} for row in found]
    if json_:
        print(json.dumps({"fiducials": rows}))
    elif rows:
        # in a pipe there is no width to fit into
        Console(width=None if sys.stdout.isatty() else 140).print(_table(rows))
    return DONE if rows else COULD_NOT


Rows = list[dict[str, Any]]
Shown = list[tuple[Frame, Rows]]


def _locate_each(
    paths: Sequence[Path],
    method: str,
    radii_mm: Sequence[float],
    roi: tuple[int, ...] | None,
) -> tuple[Rows, Shown, list[str]]:
    """Every round object of every file; a file that yields none is a problem that says why."""
    found: Rows = []
    shown: Shown = []
    problems: list[str] = []
    files = files_of(paths)
    many = len(files) > 1 and Console(stderr=True).is_terminal
    for file in track(files, console=Console(stderr=True), transient=True, disable=not many):
        try:
            frames = read_frames(file)
        except UnusableError as error:
            if len(files) == 1:
                raise BadFileError(str(error)) from None
            problems.append(str(error))
            continue
        for frame in frames:
            try:
                rows = _round_objects(frame, file, method, radii_mm, roi)
            except BadFileError as error:
                if len(files) == 1:
                    raise
                problems.append(str(error))
                continue
            except EngineError as error:
                problems.append(f"{file}: {error}")
                continue
            found += rows
            shown.append((frame, rows))
            if not rows:
                problems.append(f"{_name(file, frame[0])}: no round object of {_range(radii_mm)}")
    return found, shown, problems


def _locate_by_template(
    paths: Sequence[Path],
    table: Path,
    radii_mm: Sequence[float],
    region: tuple[int, ...] | None,
) -> tuple[Rows, Shown, list[str]]:
    try:
        results, problems = locate_by_template(paths, table, radii_mm, region)
    except EngineError as error:
        return [], [], [f"{table}: {error}"]
    rows = [{**result.row, "_found": result} for _, result in results]
    return rows, [(frame, [row]) for (frame, _), row in zip(results, rows, strict=True)], problems


def _round_objects(
    frame: Frame, file: Path, method: str, radii_mm: Sequence[float], roi: tuple[int, ...] | None
) -> Rows:
    header, pixels = frame
    refuse_non_square(geometry_of(header, file).spacing_mm)
    spacing = float(np.mean(geometry_of(header, file).spacing_mm))
    radii_px = (radii_mm[0] / spacing, radii_mm[1] / spacing)
    bounds = None if roi is None else (roi[0], roi[1], roi[2], roi[3])
    found: list[Located] | list[Localization]
    if method == "ml":
        found = locate_all(pixels, radii_px, roi=bounds)
    else:
        found = _by_the_papers_method(pixels, radii_px, bounds, method)
    rows = [_row(one, header, [file]) for one in _of_size(found, radii_px)]
    return sorted(rows, key=lambda row: (round(row["row"]), row["col"]))


def _by_the_papers_method(
    pixels: NDArray[np.float64],
    radii_px: tuple[float, float],
    roi: tuple[int, int, int, int] | None,
    method: str,
) -> list[Localization]:
    """What the paper's circle finder says of each round object that is seen."""
    found: list[Localization] = []
    for candidate in detect(pixels, radii_px, roi=roi):
        near = (candidate.radius_px * 0.8, candidate.radius_px * 1.25)
        try:
            found.append(
                localize(pixels, start_px=candidate.centre_px, radius_px=near, method=method)
            )
        except NoRoundObjectError:
            continue  # the circle finder does not see it; the others are told
    return found


def _locate_together(
    paths: Sequence[Path],
    table: Path,
    method: str,
    radii_mm: Sequence[float],
    region: tuple[int, ...] | None,
) -> tuple[Rows, Shown, list[str]]:
    """One object in several slices taken at known shifts."""
    shifts_px = read_shift_table(table)
    frames: list[Frame] = []
    shifts: list[tuple[float, float]] = []
    files = files_of(paths)
    for file in files:
        if file.name not in shifts_px:
            raise BadFileError(f"{table}: has no row for the file {file.name}")
        try:
            frames.append(read_frames(file)[0])
        except UnusableError as error:
            raise BadFileError(str(error)) from None
        shifts.append(shifts_px[file.name])
    shapes = {frame[1].shape for frame in frames}
    if len(shapes) > 1:
        raise BadFileError(f"the files have different sizes: {sorted(shapes)}")
    header = frames[0][0]
    spacing = float(np.mean(geometry_of(header, files[0]).spacing_mm))
    try:
        refuse_non_square(geometry_of(header, files[0]).spacing_mm)
        radii_px = (radii_mm[0] / spacing, radii_mm[1] / spacing)
        one = localize(
            np.array([frame[1] for frame in frames]),
            np.array(shifts),
            start_px=_start_in(region, frames[0][1], shifts[0], radii_px),
            radius_px=radii_px,
            method=method,
            psf=psf_of_noise(frames[0][1]) if method == "ml" else None,
        )
        _refuse_size(one, radii_px)
    except EngineError as error:
        return [], [], [str(error)]
    row = _row(one, header, files)
    return [row], [(frames[0], [row])], []


def _start_in(
    region: tuple[int, ...] | None,
    first: NDArray[np.float64],
    shift: tuple[float, float],
    radii_px: tuple[float, float],
) -> tuple[float, float] | None:
    """Where the one round object of the region is in the reference pose; None without a region."""
    if region is None:
        return None
    bounds = (region[0], region[1], region[2], region[3])
    seen = detect(first, radii_px, roi=bounds, max_objects=2)
    if not seen:
        raise NoRoundObjectError("no round object of the allowed size in the region of interest")
    row, col = seen[0].centre_px
    return row - shift[0], col - shift[1]


def _refuse_size(one: Localization | Located, radii_px: tuple[float, float]) -> None:
    """Detection takes what is somewhat outside of the range; what is reported is inside."""
    low, high = (1 - RADIUS_SLACK) * radii_px[0], (1 + RADIUS_SLACK) * radii_px[1]
    if not low <= one.radius_px <= high:
        row, col = one.centre_px
        raise NoRoundObjectError(
            f"the round object at row {row:.1f}, col {col:.1f} has a radius of about "
            f"{one.radius_px:.2f} px; {radii_px[0]:.2f} to {radii_px[1]:.2f} px is allowed"
        )


def _of_size(
    found: Sequence[Localization | Located], radii_px: tuple[float, float]
) -> list[Localization | Located]:
    """Those of the wanted size. Raises what is the matter with the only ones there are."""
    fitting: list[Localization | Located] = []
    refusal: EngineError | None = None
    for one in found:
        try:
            _refuse_size(one, radii_px)
            fitting.append(one)
        except NoRoundObjectError as error:
            refusal = refusal or error
    if refusal is not None and not fitting:
        raise refusal
    return fitting


def _row(one: Localization | Located, header: Slice, files: Sequence[Path]) -> dict[str, Any]:
    common = np.zeros(2) if one.systematic_px is None else one.systematic_px
    patient_mm = geometry_of(header, files[0]).patient_from_pixel(one.centre_px)
    return {
        "row": float(one.centre_px[0]),
        "col": float(one.centre_px[1]),
        "radius_px": float(one.radius_px),
        "sigma_row_px": float(one.sigma_px[0]),
        "sigma_col_px": float(one.sigma_px[1]),
        "systematic_row_px": float(common[0]),
        "systematic_col_px": float(common[1]),
        "patient_mm": [float(value) for value in patient_mm],
        "snr": float(one.snr),
        "chi2_per_dof": float(one.chi2_per_dof),
        "method": one.method,
        "files": [str(file) for file in files],
        "_found": one,
    }


def _table(rows: Rows) -> Table:
    table = Table()
    for name in (
        "file",
        "row px",
        "col px",
        "radius px",
        "σ px",
        "patient mm (LPS)",
        "SNR",
        "χ²/n",
    ):
        table.add_column(name, justify="left" if name == "file" else "right", no_wrap=True)
    for row in rows:
        first, *more = row["files"]
        table.add_row(
            Path(first).name + (f" +{len(more)}" if more else ""),
            f"{row['row']:.3f}",
            f"{row['col']:.3f}",
            f"{row['radius_px']:.2f}",
            f"{row['sigma_row_px']:.3f} {row['sigma_col_px']:.3f}",
            " ".join(f"{value:.2f}" for value in row["patient_mm"]),
            f"{row['snr']:.0f}",
            f"{row['chi2_per_dof']:.2f}",
        )
    return table


def _numbers(text: str, count: int, name: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    growing = count != 2 or values == sorted(values)
    if len(values) != count or not all(np.isfinite(values)) or not growing:
        raise BadFileError(
            f"{name} {text!r}: expected {count} increasing numbers, separated by commas"
        )
    return values


def _range(radii_mm: Sequence[float]) -> str:
    return f"{radii_mm[0]:g} to {radii_mm[1]:g} mm radius"


def _name(file: Path, header: Slice) -> str:
    return f"{file} frame {header.frame}" if header.n_frames > 1 else str(file)
