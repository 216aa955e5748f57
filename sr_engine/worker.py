"""The worker process: takes requested measurements from the case record, localizes, writes back.

The only module of the engine that does I/O. It never raises over an image: what cannot be measured
is recorded as failed, with the reason.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import sqlite3
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from case_record.attempts import MOST_DEATHS, Attempts
from case_record.cases import Cases
from case_record.connection import json_text
from case_record.presence import Presence, Sole
from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Measurement, SliceRow
from dicom_slice.pixels import magnitude_pixels
from dicom_slice.reasons import UnusableError
from room_config.load import Config
from sr_engine.errors import EngineError, SingularShiftSetError, TemplateError
from sr_engine.psf import Psf
from sr_engine.reconstruction.reconstruct import reconstruct
from sr_engine.request import (
    PointSpreads,
    UnusableSlicesError,
    common_geometry,
    is_at_position,
    localize_request,
)
from sr_engine.result import TEMPLATE, Found, describe_result
from sr_engine.views import Frames, Templates, View

IMAGES = "images"
ALIVE = "worker.alive"
_RECORD_RETRY_S = 0.5
log = structlog.get_logger()


@dataclass(frozen=True)
class Known:
    """What is worked out once for many measurements."""

    psfs: PointSpreads = field(default_factory=PointSpreads)
    templates: Templates = field(default_factory=Templates)


def serve(config: Config, should_stop: Callable[[], bool]) -> None:
    """Work until `should_stop` on whatever case is open; says every second: alive.

    While the record cannot be read or written it is tried again: the requests stand in it. Raises
    CaseRecordError, which names it, where another worker serves this room.
    """
    cases = Cases(*config.room.folders)
    known = Known(PointSpreads(config.imaging.point_spread))
    with Sole(cases.home, "worker"), Presence(cases.home, "worker") as presence:
        told_s = 0.0

        def alive() -> bool:
            nonlocal told_s
            presence.beat()
            if time.monotonic() - told_s > 1.0:
                told_s = time.monotonic()
                with contextlib.suppress(OSError):  # a disk that takes nothing
                    (cases.home / ALIVE).touch()
            time.sleep(config.worker.poll_s)
            return not should_stop()

        while alive():
            try:
                case_dir = cases.open
                if case_dir is not None:
                    _work_on(case_dir, cases, config, known, alive)
            except (CaseRecordError, sqlite3.Error, OSError) as error:
                log.error("the case record cannot be used", error=str(error))
                time.sleep(_RECORD_RETRY_S)
            except Exception:  # the requests stand in the record: nothing is lost by trying again
                log.exception("the worker's loop")
                time.sleep(_RECORD_RETRY_S)


def _work_on(
    case_dir: Path, cases: Cases, config: Config, known: Known, alive: Callable[[], bool]
) -> None:
    """Answer the requests of one case for as long as it is the open one."""
    factor = config.worker.reconstruction_factor
    with CaseRecord(case_dir, create=True) as record, Attempts(case_dir, "worker") as attempts:
        while alive() and cases.open == case_dir:
            for request in record.requested_measurements():
                attempt(record, request, factor, known, attempts)


def attempt(
    record: CaseRecord,
    request: Measurement,
    factor: int,
    known: Known,
    attempts: Attempts,
) -> None:
    """As `measure`, unless this request has ended the worker again and again."""
    key = f"measurement {request.measurement_id}"
    if attempts.deaths(key) >= MOST_DEATHS:
        text = f"the worker crashed {attempts.deaths(key)} times during this measurement"
        _fail(record, request.measurement_id, "worker_ended", text)
        attempts.forget(key)
        return
    with attempts.at(key):
        measure(record, request, factor, known)


def measure(
    record: CaseRecord, request: Measurement, factor: int, known: Known | None = None
) -> None:
    """Carry out one requested measurement and record its result, or why there is none.

    Raises only what the record itself raises: any other fault ends this measurement alone.
    """
    number = request.measurement_id
    try:
        frames = gather_frames(record, request)
        known = known or Known()
        psf = known.psfs.of(frames)
        result = describe_result(frames, localize_as_asked(record, request, frames, psf, known))
        result["point_spread"] = asdict(psf)
        result |= _reconstruction(record.case_dir, number, frames, factor)
        json_text(result)  # NaN, or a value of no known type, is found here and not in the record
    except (EngineError, UnusableSlicesError, UnusableError) as error:
        _fail(record, number, _code_of(error), str(error))
        return
    except sqlite3.Error:
        raise
    except Exception as error:
        log.exception("measurement failed", measurement_id=number)
        text = f"the measurement could not be made ({type(error).__name__}: {error})"
        _fail(record, number, "internal_error", text)
        return
    with record.transaction():
        record.finish_measurement(number, result)
        record.append_event(
            "measurement_done",
            {"measurement_id": number, "patient_mm": result["patient_mm"]},
            source="worker",
        )


def _fail(record: CaseRecord, number: int, code: str, text: str) -> None:
    with record.transaction():
        record.fail_measurement(number, code, text)
        body = {"measurement_id": number, "reason": text}
        record.append_event("measurement_failed", body, source="worker")
    log.warning("measurement failed", measurement_id=number, reason=text)


def gather_frames(record: CaseRecord, request: Measurement) -> Frames:
    """Read every assigned slice of the request's holds; all must share one geometry."""
    pixels: list[NDArray[np.float64]] = []
    shifts_mm: list[tuple[float, float]] = []
    slices: list[SliceRow] = []
    for hold in request.request["holds"]:
        for row in record.slices(hold_id=hold["hold_id"], state="assigned"):
            if not is_at_position(row, request.request.get("slice_position_mm")):
                continue
            pixels.append(magnitude_pixels(record.case_dir / row.path, row.frame))
            shifts_mm.append(tuple(hold["shift_mm"]))
            slices.append(row)
    if not slices:
        raise UnusableSlicesError("no_slices", "no slice is assigned to the holds")
    geometry = common_geometry(slices)
    shifts_px = np.array(shifts_mm, dtype=float) / np.array(geometry.spacing_mm)
    return Frames(np.array(pixels), shifts_px, geometry, tuple(slices))


def frames_then(frames: Frames, row: Measurement) -> Frames:
    """Only the slices that were there then: more may have been taken at the same hold later."""
    used = (row.result or {}).get("slice_ids")
    if used is None:
        until_s = np.inf if row.finished_s is None else row.finished_s
        used = [one.slice_id for one in frames.slices if one.received_s <= until_s]
    then = [number for number, one in enumerate(frames.slices) if one.slice_id in used]
    if not then:
        raise UnusableSlicesError("no_slices", "the slices of this measurement are not assigned")
    return replace(
        frames,
        pixels=frames.pixels[then],
        shifts_px=frames.shifts_px[then],
        slices=tuple(frames.slices[number] for number in then),
    )


def localize_as_asked(
    record: CaseRecord,
    request: Measurement,
    frames: Frames,
    psf: Psf,
    known: Known,
    method: str | None = None,
) -> Found:
    """The answer to a request, or what another method says of its frames."""
    method = method or request.method
    ids = request.request.get(TEMPLATE, ()) if method == TEMPLATE else ()
    views = [view_of(record, number) for number in ids]
    return localize_request(frames, method, request.request, psf, views, known.templates)


def view_of(record: CaseRecord, number: int) -> View:
    """An earlier measurement as a template is learnt from it: by the record, now and later."""
    row = record.measurement(number)
    if row.result is None:
        raise TemplateError(
            f"measurement {number}, which the template is learnt from, has no result"
        )
    set_aside = UnusableSlicesError(
        "no_slices",
        f"a slice of measurement {number}, which the template is learnt from, has since been "
        "set aside: calibrate again",
    )
    try:
        frames = frames_then(gather_frames(record, row), row)
    except UnusableSlicesError as error:
        raise set_aside if error.code == "no_slices" else error from None
    if len(frames.slices) != len(row.result["slice_ids"]):
        raise set_aside
    return View(number, frames, np.array(row.result["reference_px"]))


def _code_of(error: EngineError | UnusableSlicesError | UnusableError) -> str:
    if isinstance(error, UnusableSlicesError):
        return error.code
    if isinstance(error, UnusableError):
        return str(error.reason.code)
    return str(error.reason)


def _reconstruction(case_dir: Path, number: int, frames: Frames, factor: int) -> dict[str, Any]:
    """Write the super-resolution image as .npy beside the record; its name (None where there is no
    image), and what the file is sworn to be.
    """
    if len(frames.pixels) < factor**2:
        return {"reconstruction": None}
    try:
        made = reconstruct(frames.pixels, frames.shifts_px, factor=factor, method="fourier")
    except SingularShiftSetError:
        return {"reconstruction": None}  # slices at one place only: nothing finer to show
    folder = case_dir / IMAGES
    folder.mkdir(exist_ok=True)
    path = folder / f"measurement-{number}.npy"
    temporary = path.with_suffix(".part")
    buffer = io.BytesIO()
    np.save(buffer, made.image.astype(np.float32))
    temporary.write_bytes(buffer.getvalue())
    temporary.replace(path)
    digest = hashlib.sha256(buffer.getvalue()).hexdigest()
    return {"reconstruction": f"{IMAGES}/{path.name}", "reconstruction_sha256": digest}
