"""`autospine locate --template TABLE`: the object's own image, learnt from the files of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dicom_slice.header import Slice
from dicom_slice.read import Frame, read_frames
from dicom_slice.reasons import UnusableError
from service.cli.files import BadFileError, files_of, geometry_of, read_shift_table
from sr_engine.errors import EngineError
from sr_engine.template.fit import TemplateFit
from sr_engine.template.learn import Template, learn_template

Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True, eq=False)
class TemplateResult:
    """What is said of one file, and drawn of it."""

    row: dict[str, Any]
    centre_px: Array
    covariance_px2: Array
    radius_px: float


def locate_by_template(
    paths: Sequence[Path],
    table: Path,
    radii_mm: Sequence[float],
    region: tuple[int, ...] | None,
) -> tuple[list[tuple[Frame, TemplateResult]], list[str]]:
    """One result a file, and what is the matter with the files that have none.

    Raises BadFileError where the table or a file of it cannot be used, EngineError where its
    frames do not make a template.
    """
    template, like = _learnt(table, radii_mm)
    found: list[tuple[Frame, TemplateResult]] = []
    problems: list[str] = []
    files = files_of(paths)
    for file in files:
        try:
            frames = read_frames(file)
        except UnusableError as error:
            if len(files) == 1:
                raise BadFileError(str(error)) from None
            problems.append(str(error))
            continue
        for frame in frames:
            try:
                found.append((frame, _located(frame, file, template, like, region)))
            except EngineError as error:
                problems.append(f"{file}: {error}")
    return found, problems


def _learnt(table: Path, radii_mm: Sequence[float]) -> tuple[Template, Slice]:
    shifts = read_shift_table(table)
    frames = []
    for name in shifts:
        file = table.parent / name
        if not file.is_file():
            raise BadFileError(f"{table}: {name} is not in the same folder")
        try:
            frames.append(read_frames(file)[0])
        except UnusableError as error:
            raise BadFileError(str(error)) from None
    first = frames[0][0]
    for name, (header, pixels) in zip(shifts, frames, strict=True):
        if pixels.shape != frames[0][1].shape:
            raise BadFileError(
                f"{table}: {name} is {pixels.shape[0]} x {pixels.shape[1]} pixels, the first file "
                f"{frames[0][1].shape[0]} x {frames[0][1].shape[1]}"
            )
        _refuse_unlike(header, first, f"{table}: {name}")
    spacing = float(np.mean(geometry_of(first, table.parent / next(iter(shifts))).spacing_mm))
    template = learn_template(
        np.array([pixels for _, pixels in frames]),
        np.array(list(shifts.values())),
        radius_px=(radii_mm[0] / spacing, radii_mm[1] / spacing),
    )
    return template, first


def _refuse_unlike(header: Slice, like: Slice, name: str) -> None:
    """Another spacing or orientation shows the object otherwise: that takes another template."""
    here, there = geometry_of(header, Path(name)), geometry_of(like, Path(name))
    if not np.allclose(here.spacing_mm, there.spacing_mm, rtol=1e-3):
        raise BadFileError(
            f"{name}: pixels of {here.spacing_mm} mm, the template's are {there.spacing_mm} mm"
        )
    same = np.allclose(here.row_direction, there.row_direction, atol=1e-3) and np.allclose(
        here.col_direction, there.col_direction, atol=1e-3
    )
    if not same:
        raise BadFileError(f"{name}: the slice's orientation differs from the template's")


def _located(
    frame: Frame,
    file: Path,
    template: Template,
    like: Slice,
    region: tuple[int, ...] | None,
) -> TemplateResult:
    header, pixels = frame
    try:
        _refuse_unlike(header, like, str(file))
    except BadFileError as error:
        raise _UnlikeError(str(error).removeprefix(f"{file}: ")) from None
    bounds = None if region is None else (region[0], region[1], region[2], region[3])
    fit = template.fit(pixels, region=bounds)
    patient_mm = geometry_of(header, file).patient_from_pixel(fit.centre_px)
    row = _row(fit, template, [float(x) for x in patient_mm], file)
    return TemplateResult(row, fit.centre_px, fit.covariance_px2, template.radius_px)


class _UnlikeError(EngineError):
    """A file of another protocol than the template's."""

    reason = "template-mismatch"


def _row(
    fit: TemplateFit, template: Template, patient_mm: list[float], file: Path
) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(fit.covariance_px2))
    return {
        "row": float(fit.centre_px[0]),
        "col": float(fit.centre_px[1]),
        "radius_px": template.radius_px,
        "sigma_row_px": float(sigma[0]),
        "sigma_col_px": float(sigma[1]),
        "systematic_row_px": float(template.systematic_px[0]),
        "systematic_col_px": float(template.systematic_px[1]),
        "patient_mm": patient_mm,
        "snr": fit.snr,
        "chi2_per_dof": fit.chi2_per_dof,
        "method": "template",
        "files": [str(file)],
    }
