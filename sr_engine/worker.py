"""The worker process: takes requested measurements from the case record, localizes, writes back.

The only module of the engine that does I/O. It never raises over an image: what cannot be measured
is recorded as failed, with the reason.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import sqlite3
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import structlog
from numpy.typing import NDArray

from case_record.attempts import MOST_DEATHS, Attempts
from case_record.cases import Cases
from case_record.connection import json_text
from case_record.presence import Presence, Sole
from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Measurement, SliceRow
from dicom_slice.geometry import SliceGeometry
from dicom_slice.pixels import magnitude_pixels
from dicom_slice.reasons import UnusableError
from room_config.imaging import PointSpreadConfig
from room_config.load import Config
from sr_engine.checks import refuse_non_square
from sr_engine.errors import (
    EngineError,
    ObjectAtBorderError,
    OutsideGateError,
    SingularShiftSetError,
)
from sr_engine.hough import HoughSettings
from sr_engine.localization import Localization
from sr_engine.localize import SEARCH_PX, localize
from sr_engine.paper import PaperMethod, PaperSettings, localize_paper
from sr_engine.psf import Psf
from sr_engine.recognise import psf_of_noise
from sr_engine.reconstruction.reconstruct import reconstruct

IMAGES = "images"
ALIVE = "worker.alive"
_RECORD_RETRY_S = 0.5
_SAME_PLACE = 1e-6
_SAME_SLICE_MM = 0.5
log = structlog.get_logger()


class UnusableSlicesError(Exception):
    """The slices of a measurement do not belong together, or cannot be read."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, eq=False)
class Frames:
    """What a measurement is made from: frames of one geometry, and their known shifts.

    pixels: (N, rows, cols); shifts_px: (N, 2), displacement from the reference pose.
    """

    pixels: NDArray[np.float64]
    shifts_px: NDArray[np.float64]
    geometry: SliceGeometry
    slices: tuple[SliceRow, ...]


class PointSpreads:
    """The point spread of any slices: the configured one, or recognised once for each series."""

    def __init__(self, configured: PointSpreadConfig | None = None) -> None:
        self._configured = None
        if configured is not None:
            self._configured = Psf(configured.kind, configured.parameters, configured.acquired)
        self._recognised: dict[tuple[str, tuple[int, int]], Psf] = {}

    def of(self, frames: Frames) -> Psf:
        """Recognised in the noise of the first frame that is seen of a series."""
        if self._configured is not None:
            return self._configured
        series = str(frames.slices[0].header.get("series_instance_uid", ""))
        key = (series, frames.geometry.shape)
        if key not in self._recognised:
            psf = self._recognised[key] = psf_of_noise(frames.pixels[0])
            log.info("point spread", series=series, kind=psf.kind, acquired=psf.acquired)
        return self._recognised[key]


def serve(config: Config, should_stop: Callable[[], bool]) -> None:
    """Work until `should_stop` on whatever case is open; says every second: alive.

    While the record cannot be read or written it is tried again: the requests stand in it. Raises
    CaseRecordError, which names it, where another worker serves this room.
    """
    cases = Cases(*config.room.folders)
    psfs = PointSpreads(config.imaging.point_spread)
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
                    _work_on(case_dir, cases, config, psfs, alive)
            except (CaseRecordError, sqlite3.Error, OSError) as error:
                log.error("the case record cannot be used", error=str(error))
                time.sleep(_RECORD_RETRY_S)
            except Exception:  # the requests stand in the record: nothing is lost by trying again
                log.exception("the worker's loop")
                time.sleep(_RECORD_RETRY_S)


def _work_on(
    case_dir: Path, cases: Cases, config: Config, psfs: PointSpreads, alive: Callable[[], bool]
) -> None:
    """Answer the requests of one case for as long as it is the open one."""
    factor = config.worker.reconstruction_factor
    with CaseRecord(case_dir, create=True) as record, Attempts(case_dir, "worker") as attempts:
        while alive() and cases.open == case_dir:
            for request in record.requested_measurements():
                attempt(record, request, factor, psfs, attempts)


def attempt(
    record: CaseRecord,
    request: Measurement,
    factor: int,
    psfs: PointSpreads,
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
        measure(record, request, factor, psfs)


def measure(
    record: CaseRecord, request: Measurement, factor: int, psfs: PointSpreads | None = None
) -> None:
    """Carry out one requested measurement and record its result, or why there is none.

    Raises only what the record itself raises: any other fault ends this measurement alone.
    """
    number = request.measurement_id
    try:
        frames = gather_frames(record, request)
        psf = (psfs or PointSpreads()).of(frames)
        found = localize_request(frames, request.method, request.request, psf)
        result = describe_result(frames, found)
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
    geometry = _common_geometry(slices)
    shifts_px = np.array(shifts_mm, dtype=float) / np.array(geometry.spacing_mm)
    return Frames(np.array(pixels), shifts_px, geometry, tuple(slices))


def recorded_point_spread(result: Mapping[str, Any] | None) -> Psf | None:
    """What a recorded measurement was made with; None where its record does not say."""
    recorded = (result or {}).get("point_spread")
    if recorded is None:
        return None
    return Psf(recorded["kind"], tuple(recorded["parameters"]), tuple(recorded["acquired"]))


def is_at_position(row: SliceRow, slice_position_mm: float | None) -> bool:
    """True if the middle of the slice is there along its normal; None is everywhere."""
    if slice_position_mm is None:
        return True
    geometry = geometry_of(row.header)
    return abs(float(geometry.normal @ geometry.position_mm) - slice_position_mm) <= _SAME_SLICE_MM


def geometry_of(header: Mapping[str, Any]) -> SliceGeometry:
    """Return the slice geometry from the header as the record keeps it."""
    geometry = header["geometry"]
    return SliceGeometry(
        position_mm=tuple(geometry["position_mm"]),
        row_direction=tuple(geometry["row_direction"]),
        col_direction=tuple(geometry["col_direction"]),
        spacing_mm=tuple(geometry["spacing_mm"]),
        shape=tuple(geometry["shape"]),
    )


def describe_result(frames: Frames, found: Localization) -> dict[str, Any]:
    """Return what the record keeps of a localization, JSON-ready; see `case_record.rows`."""
    geometry = frames.geometry
    spacing = np.array(geometry.spacing_mm)
    covariance = np.asarray(found.covariance_px2)
    centre = np.asarray(found.centre_px)
    # the newest slice is what the page shows: say where the fiducial is in that one
    shown_px = centre + frames.shifts_px[-1]
    return {
        "slice_id": frames.slices[-1].slice_id,
        "slice_ids": [row.slice_id for row in frames.slices],
        "centre_px": shown_px.tolist(),
        "reference_px": centre.tolist(),
        "sigma_px": np.sqrt(np.diag(covariance)).tolist(),
        "covariance_px2": covariance.tolist(),
        "radius_px": float(found.radius_px),
        "snr": float(found.snr),
        "chi2_per_dof": float(found.chi2_per_dof),
        "residuals_px": np.asarray(found.residuals_px).tolist(),
        "method": found.method,
        "n_frames": int(found.n_frames),
        "patient_mm": geometry.patient_from_pixel(centre).tolist(),
        "plane_mm": (_plane_origin_mm(geometry) + centre * spacing).tolist(),
        "covariance_mm2": (covariance * np.outer(spacing, spacing)).tolist(),
        "plane": {
            "row_direction": list(geometry.row_direction),
            "col_direction": list(geometry.col_direction),
            "spacing_mm": list(geometry.spacing_mm),
        },
        "scan_s": sum(_scan_s(row.header) for row in frames.slices),
    }


def _scan_s(header: Mapping[str, Any]) -> float:
    """How long the scanner took for this slice, by its own clock; 0 where it does not say."""
    interval = header.get("interval") or {}
    start_s, end_s = interval.get("start_s"), interval.get("end_s")
    return 0.0 if start_s is None or end_s is None else float(end_s - start_s)


def _code_of(error: EngineError | UnusableSlicesError | UnusableError) -> str:
    if isinstance(error, UnusableSlicesError):
        return error.code
    if isinstance(error, UnusableError):
        return str(error.reason.code)
    return str(error.reason)


def localize_request(
    frames: Frames, method: str, request: Mapping[str, Any], psf: Psf | None = None
) -> Localization:
    """Localize the fiducial where it is expected, or anywhere if nothing is known of its place.

    request: radius_mm (low, high); expected_plane_mm and gate_mm (both None: not known);
    region_px (r0, c0, r1, c1), where to look then (None: the whole slice); shift_sigma_mm
    (standard deviation of a commanded shift, one axis). Raises an EngineError.
    """
    refuse_non_square(frames.geometry.spacing_mm)
    spacing = np.array(frames.geometry.spacing_mm)
    mean_mm = float(np.mean(spacing))
    low_mm, high_mm = request["radius_mm"]
    radius_px = (low_mm / mean_mm, high_mm / mean_mm)
    if request["expected_plane_mm"] is None:
        start_px = _start_anywhere(frames, method, radius_px, request.get("region_px"))
        return _localize_by(method, frames, start_px, radius_px, request, psf)
    expected_mm = np.array(request["expected_plane_mm"])
    expected_px = (expected_mm - _plane_origin_mm(frames.geometry)) / spacing
    gate_px = float(request["gate_mm"]) / mean_mm
    start_px = expected_px
    if gate_px > SEARCH_PX:  # the engine looks no further than that from a start
        reach = gate_px + 2 * radius_px[1]
        region = (*(expected_px - reach), *(expected_px + reach))
        start_px = _start_in_region(frames, radius_px, region)
    found = _localize_by(method, frames, start_px, radius_px, request, psf)
    miss_px = float(np.linalg.norm(np.asarray(found.centre_px) - expected_px))
    if not miss_px <= gate_px:
        raise OutsideGateError(
            f"the round object found is {miss_px * mean_mm:.1f} mm from where the fiducial is "
            f"expected (limit {gate_px * mean_mm:.1f} mm)"
        )
    return found


def _localize_by(
    method: str,
    frames: Frames,
    start_px: NDArray[np.float64] | None,
    radius_px: tuple[float, float],
    request: Mapping[str, Any],
    psf: Psf | None,
) -> Localization:
    if method in get_args(PaperMethod):
        return localize_paper(
            frames.pixels,
            frames.shifts_px,
            cast(PaperMethod, method),
            start_px=start_px,
            settings=PaperSettings(HoughSettings(radius_px)),
        )
    mean_mm = float(np.mean(frames.geometry.spacing_mm))
    return localize(
        frames.pixels,
        frames.shifts_px,
        start_px=start_px,
        radius_px=radius_px,
        method=method,
        psf=psf,
        shift_sigma_px=float(request.get("shift_sigma_mm", 0.0)) / mean_mm,
    )


def _start_anywhere(
    frames: Frames,
    method: str,
    radius_px: tuple[float, float],
    region_px: Sequence[float] | None,
) -> NDArray[np.float64] | None:
    """None where the method's own search over the whole slice serves."""
    if region_px is not None:
        return _start_in_region(frames, radius_px, region_px)
    if method in get_args(PaperMethod):  # a circle transform takes any edge that is round
        rows, cols = frames.geometry.shape
        return _start_in_region(frames, radius_px, (0, 0, rows, cols))
    return None


def _start_in_region(
    frames: Frames, radius_px: tuple[float, float], region_px: Sequence[float]
) -> NDArray[np.float64]:
    """The one round object of the first frame that lies in the region, in the reference pose."""
    rows, cols = frames.geometry.shape
    r0, c0 = (max(0, math.floor(value)) for value in region_px[:2])
    r1, c1 = min(rows, math.ceil(region_px[2]) + 1), min(cols, math.ceil(region_px[3]) + 1)
    if r1 <= r0 or c1 <= c0:
        raise ObjectAtBorderError(
            f"rows {r0} to {r1}, columns {c0} to {c1}, where the fiducial is looked for, lie "
            f"outside of the {rows} x {cols} slice"
        )
    found = localize(frames.pixels[0, r0:r1, c0:c1], radius_px=radius_px)
    return np.asarray(found.centre_px) + np.array([r0, c0]) - frames.shifts_px[0]


def _plane_origin_mm(geometry: SliceGeometry) -> NDArray[np.float64]:
    """Projections of the centre of pixel (0, 0) onto row and column direction, mm."""
    position = np.array(geometry.position_mm)
    return np.array([position @ geometry.row_direction, position @ geometry.col_direction])


def _common_geometry(slices: list[SliceRow]) -> SliceGeometry:
    first = geometry_of(slices[0].header)
    for row in slices[1:]:
        other = geometry_of(row.header)
        same = other.shape == first.shape and all(
            np.allclose(getattr(other, name), getattr(first, name), atol=_SAME_PLACE)
            for name in ("position_mm", "row_direction", "col_direction", "spacing_mm")
        )
        if not same:
            raise UnusableSlicesError(
                "geometry_changed",
                f"slice {row.sop_instance_uid} is not at the same position as slice "
                f"{slices[0].sop_instance_uid} of the same measurement",
            )
    return first


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
