"""Images of slices and reconstructions: PNG, raw pixels, and the DICOM file as received."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.responses import FileResponse
from numpy.typing import NDArray

from service.room.images import (
    Rendering,
    png_of,
    raw_of,
    reconstruction_pixels,
    residual_pixels,
    slice_file,
    slice_pixels,
)
from service.web.of_case import AskedCase, OfCase
from service.web.pagination import Id
from service.web.problems import responses

Window = Annotated[float | None, Query(gt=0, le=1e9, allow_inf_nan=False)]
Level = Annotated[float | None, Query(ge=-1e9, le=1e9, allow_inf_nan=False)]
Scale = Annotated[int, Query(ge=1, le=8, description="Enlargement along rows and columns.")]
Match = Annotated[str | None, Header(alias="If-None-Match")]


async def _rendering(window: Window = None, level: Level = None, scale: Scale = 1) -> Rendering:
    return Rendering(window, level, scale)


How = Annotated[Rendering, Depends(_rendering)]
_MOST_AT_ONCE_BYTES = 8 * 2**20
_BINARY = {"schema": {"type": "string", "format": "binary"}}


def _answers(media_type: str) -> dict[int | str, dict[str, Any]]:
    return {
        **responses(401, 404, 409, 422, 429),
        200: {"description": "The image", "content": {media_type: _BINARY}},
        304: {"description": "The caller has it already"},
    }


_PNG = _answers("image/png")
_RAW = _answers("application/octet-stream")
_DICOM = _answers("application/dicom")


def slice_image_router() -> APIRouter:
    router = APIRouter(tags=["images"], prefix="/api/v1/slices/{slice_id}")

    @router.get("/image.png", response_class=Response, responses=_PNG)
    def slice_image(slice_id: Id, case: OfCase, how: How, match: Match = None) -> Response:
        """The slice as an 8-bit PNG; window and level in the units of its magnitudes."""
        with case.record() as record:
            image = f"{record.slice(slice_id).sha256} {slice_id}"
            return _png(case, image, lambda: slice_pixels(record, slice_id), how, match)

    @router.get("/pixels", response_class=Response, responses=_RAW)
    def raw_slice(slice_id: Id, case: OfCase, match: Match = None) -> Response:
        """The magnitudes, row by row, little-endian 32-bit floats; `X-Shape: rows,cols`."""
        with case.record() as record:
            image = f"{record.slice(slice_id).sha256} {slice_id}"
            return _raw(case, image, slice_pixels(record, slice_id), match)

    @router.get("/image.dcm", response_class=Response, responses=_DICOM)
    def dicom_file(slice_id: Id, case: OfCase, match: Match = None) -> Response:
        """The DICOM file, bit for bit as it was received."""
        with case.record() as record:
            path = slice_file(record, slice_id)
            key = f"dcm {record.slice(slice_id).sha256}"
        if path.stat().st_size > _MOST_AT_ONCE_BYTES:
            return FileResponse(
                path, media_type="application/dicom", filename=f"slice-{slice_id}.dcm"
            )
        name = {"Content-Disposition": f'attachment; filename="slice-{slice_id}.dcm"'}
        return _answer(case, key, match, "application/dicom", path.read_bytes, **name)

    return router


def measurement_image_router() -> APIRouter:
    router = APIRouter(tags=["images"], prefix="/api/v1/measurements/{measurement_id}")

    def pixels_of(measurement_id: int, case: AskedCase) -> NDArray[Any]:
        with case.record() as record:
            return reconstruction_pixels(record, measurement_id)

    @router.get("/image.png", response_class=Response, responses=_PNG)
    def measurement_image(
        measurement_id: Id, case: OfCase, how: How, match: Match = None
    ) -> Response:
        """The super-resolution reconstruction of a measurement as an 8-bit PNG."""
        pixels = pixels_of(measurement_id, case)
        image = f"{case.folder} measurement {measurement_id}"
        return _png(case, image, lambda: pixels, how, match)

    @router.get("/pixels", response_class=Response, responses=_RAW)
    def raw_measurement(measurement_id: Id, case: OfCase, match: Match = None) -> Response:
        """The reconstruction as little-endian 32-bit floats; `X-Shape: rows,cols`."""
        pixels = pixels_of(measurement_id, case)
        return _raw(case, f"{case.folder} measurement {measurement_id}", pixels, match)

    @router.get("/residual", response_class=Response, responses=_RAW)
    def raw_residual(measurement_id: Id, case: OfCase, match: Match = None) -> Response:
        """The newest slice less the fitted fiducial, floats as above; 0 far from the fiducial."""
        with case.record() as record:
            pixels = residual_pixels(record, measurement_id)
        return _raw(case, f"{case.folder} residual {measurement_id}", pixels, match)

    return router


def _answer(
    case: AskedCase,
    key: str,
    match: str | None,
    media_type: str,
    make: Callable[[], bytes],
    **headers: str,
) -> Response:
    """The image, or 304 if the caller has it; what an ETag names never changes.

    An address that does not name the case means another image in the next one: no browser may show
    it again without asking.
    """
    etag = f'"{hashlib.sha256(key.encode()).hexdigest()[:32]}"'
    how_long = "max-age=86400, immutable" if case.is_named else "no-cache"
    cached = {"ETag": etag, "Cache-Control": f"private, {how_long}"}
    if match is not None and etag in match:
        return Response(status_code=304, headers=cached)
    return Response(make(), media_type=media_type, headers={**cached, **headers})


def _png(
    case: AskedCase,
    image: str,
    pixels: Callable[[], NDArray[Any]],
    how: Rendering,
    match: str | None,
) -> Response:
    key = f"png {image} {how.window} {how.level} {how.scale}"
    return _answer(case, key, match, "image/png", lambda: png_of(pixels(), how))


def _raw(case: AskedCase, image: str, pixels: NDArray[Any], match: str | None) -> Response:
    shape = {"X-Shape": ",".join(map(str, pixels.shape))}
    octets = "application/octet-stream"
    return _answer(case, f"raw {image}", match, octets, lambda: raw_of(pixels), **shape)
