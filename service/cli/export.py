"""`autospine export CASE`: a case as one zip of DICOM files, JSON lines and images.

Slices are as they were received, byte for byte, outputs as they were made; MANIFEST.json names
every member with its SHA-256.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import sqlite3
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from case_record.record import CaseRecord
from room_config.exit_codes import BAD_INPUT
from service.dicom_out.make import FOLDER as OUTPUTS
from service.room.images import (
    ImageMissingError,
    Rendering,
    png_of,
    reconstruction_pixels,
    slice_pixels,
)
from service.room.integrity import check_slice_file

app = typer.Typer(add_completion=False)
FORMAT = "autospine-case-export"
FORMAT_VERSION = 1
_EVENTS_AT_ONCE = 1000
_SCALE = 3


class ExportError(ValueError):
    """The case cannot be exported as asked; one line."""

    exit_code = BAD_INPUT


@app.command()
def export(
    case: Annotated[Path, typer.Argument(help="The case's folder.")],
    out: Annotated[
        Path | None, typer.Option(help="The zip to write; by default CASE.zip here.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Overwrite an existing file.")] = False,
    slicer: Annotated[
        bool, typer.Option("--slicer", help="Write a 3D Slicer scene (CASE.mrb) instead.")
    ] = False,
) -> None:
    """Write a case as one zip: DICOM, JSON lines, images. Or as a scene for 3D Slicer."""
    target = out or Path(f"{case.resolve().name}.{'mrb' if slicer else 'zip'}")
    if target.exists() and not force:
        raise ExportError(f"{target} already exists (--force overwrites it)")
    try:
        with CaseRecord(case, read_only=True) as record:
            members = (_write_scene if slicer else write_export)(record, target)
    except ExportError:
        raise
    except (sqlite3.Error, KeyError, TypeError, ValueError) as error:
        # damaged pages of the database, or what stands in them
        what = f"{type(error).__name__}: {error}"
        raise ExportError(
            f"{case}: the case record is damaged ({what}): restore it from its backup"
        ) from error
    print(f"{target}: {members} files")


def _write_scene(record: CaseRecord, target: Path) -> int:
    """As `write_export`, for 3D Slicer."""
    from service.cli.slicer_scene import scene_members, write_scene

    if record.case() is None:
        raise ExportError(f"{record.case_dir}: no case here")
    fresh = target.with_name(target.name + ".part")
    members = list(scene_members(record))
    try:
        write_scene(members, fresh, target.stem)
        os.replace(fresh, target)
    except OSError as error:
        raise ExportError(f"{target}: cannot be written ({error.strerror})") from error
    finally:
        fresh.unlink(missing_ok=True)
    return len(members) + 1


def write_export(record: CaseRecord, target: Path) -> int:
    """Write the zip atomically; return the number of its members. The case is not changed."""
    if record.case() is None:
        raise ExportError(f"{record.case_dir}: no case here")
    whole = record.verify()
    fresh = target.with_name(target.name + ".part")
    digests: dict[str, str] = {}
    missing: list[str] = []
    try:
        with zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in _members(record, missing):
                archive.writestr(name, content)
                digests[name] = hashlib.sha256(content).hexdigest()
            manifest = {
                "format": FORMAT,
                "version": FORMAT_VERSION,
                "sha256": digests,
                "missing": missing,
                "record": asdict(whole),
            }
            archive.writestr("MANIFEST.json", json.dumps(manifest, indent=1))
        os.replace(fresh, target)
    except OSError as error:
        raise ExportError(f"{target}: cannot be written ({error.strerror})") from error
    finally:
        fresh.unlink(missing_ok=True)
    return len(digests) + 1


def tables(record: CaseRecord) -> Iterator[tuple[str, Iterable[Any]]]:
    """Name and rows of every table of the record."""
    procedures = record.procedures()
    yield "case", [record.case()]
    yield "events", _events(record)
    yield "holds", record.holds()
    yield "slices", record.slices()
    yield "measurements", record.measurements()
    yield "procedures", procedures
    yield "steps", [step for row in procedures for step in record.steps(row.procedure_id)]
    yield "moves", record.moves()


def _events(record: CaseRecord) -> Iterator[Any]:
    after = 0
    while batch := record.events(after, _EVENTS_AT_ONCE):
        yield from batch
        after = batch[-1].event_id


def _members(record: CaseRecord, missing: list[str]) -> Iterator[tuple[str, bytes]]:
    for name, rows in tables(record):
        yield f"{name}.jsonl", _json_lines(asdict(row) for row in rows)
    seen: set[str] = set()
    for row in record.slices():
        path = record.case_dir / row.path
        if row.path in seen:
            continue
        seen.add(row.path)
        if not path.is_file():
            missing.append(row.path)
            continue
        check_slice_file(record, row)
        yield f"dicom/{Path(row.path).name}", path.read_bytes()
    for path in sorted((record.case_dir / OUTPUTS).glob("*.dcm")):
        record.is_sealed(f"{OUTPUTS}/{path.name}")
        yield f"outputs/{path.name}", path.read_bytes()
    yield from _images(record)


def _images(record: CaseRecord) -> Iterator[tuple[str, bytes]]:
    """A PNG of every slice that was used, and of every reconstruction."""
    how = Rendering(scale=_SCALE)
    for row in record.slices(state="assigned"):
        try:
            yield (
                f"images/slice-{row.slice_id}.png",
                png_of(slice_pixels(record, row.slice_id), how),
            )
        except ImageMissingError:
            continue
    for measurement in record.measurements("done"):
        try:
            pixels = reconstruction_pixels(record, measurement.measurement_id)
        except ImageMissingError:
            continue
        yield f"images/measurement-{measurement.measurement_id}.png", png_of(pixels, how)


def _json_lines(rows: Iterable[Mapping[str, Any]]) -> bytes:
    stream = io.StringIO()
    for row in rows:
        stream.write(json.dumps(row, allow_nan=False) + "\n")
    return stream.getvalue().encode("utf-8")
