"""`autospine reconstruct`: one super-resolution image from DICOM slices at known shifts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from dicom_slice.read import Frame, read_frames
from dicom_slice.reasons import UnusableError
from service.cli.files import BadFileError, files_of, geometry_of, read_shift_table
from service.dicom_out.derived import derived_image
from service.room.images import png_of
from sr_engine.errors import EngineError
from sr_engine.reconstruction.reconstruct import reconstruct

METHODS = ("fourier", "ibp")
app = typer.Typer(add_completion=False)


@app.command(name="reconstruct")
def reconstruct_files(
    path: Annotated[list[Path], typer.Argument(help="DICOM files or folders.")],
    shifts: Annotated[Path, typer.Option(help="CSV with the columns file,row_px,col_px.")],
    out: Annotated[Path, typer.Option(help="The derived DICOM image to write.")],
    factor: Annotated[int, typer.Option(min=2, max=4, help="How many times finer.")] = 2,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = "fourier",
    png: Annotated[Path | None, typer.Option(help="Also write a PNG.")] = None,
) -> int:
    """Super-resolution image from DICOM files."""
    if method not in METHODS:
        raise BadFileError(f"--method {method}: use one of {', '.join(METHODS)}")
    table = read_shift_table(shifts)
    files = files_of(path)
    frames = [_frame(file) for file in files]
    for file in files:
        if file.name not in table:
            raise BadFileError(f"{shifts}: has no row for the file {file.name}")
    shapes = {pixels.shape for _, pixels in frames}
    if len(shapes) > 1:
        raise BadFileError(f"the files have different sizes: {sorted(shapes)}")
    try:
        made = reconstruct(
            np.array([pixels for _, pixels in frames]),
            np.array([table[file.name] for file in files]),
            factor=factor,
            method="ibp" if method == "ibp" else "fourier",
        )
    except EngineError as error:
        raise BadFileError(str(error)) from None
    first_px = made.frame_from_fine((0.0, 0.0))
    grid = geometry_of(frames[0][0], files[0]).finer_grid(
        factor, (float(first_px[0]), float(first_px[1]))
    )
    image = derived_image(made, grid, files)
    part = out.with_name(out.name + ".part")
    image.save_as(part, enforce_file_format=True)
    part.replace(out)
    if png is not None:
        png.write_bytes(png_of(made.image))
    rows, cols = made.image.shape
    print(f"{out}: {rows} x {cols} pixels, condition number {made.condition_number:.3g}")
    return 0


def _frame(file: Path) -> Frame:
    try:
        return read_frames(file)[0]
    except UnusableError as error:
        raise BadFileError(str(error)) from None
