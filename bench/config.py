"""The `[camera]` table of a room's TOML file: strict, frozen, units in the names."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from room_config.exit_codes import BAD_INPUT, COULD_NOT
from room_config.load import load_config, read_toml

Positive = Annotated[float, Field(gt=0)]
AeTitle = Annotated[str, Field(min_length=1, max_length=16, pattern=r"^[\x21-\x5b\x5d-\x7e]+$")]


class CameraConfigError(ValueError):
    """The `[camera]` table or a file that it names cannot be used; one line."""

    exit_code = BAD_INPUT


class CameraError(Exception):
    """The camera does not give what is needed; one line, with what to do."""

    exit_code = COULD_NOT


class CameraConfig(BaseModel):
    """A camera over the robot, in the place of a scanner."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    source: str
    """Number or path of a video device (0, /dev/video0), a video file, pictures (frames/*.png), or
    an http, https or rtsp address."""
    colour: Literal["redness", "greenness", "blueness", "grey", "dark"] = "redness"
    """Channel in which the circle is brighter than its surroundings: redness for red on white."""
    lens_file: str = ""
    """Made by `autospine camera --board`; corrects the lens and gives the scale. Relative to this
    file."""
    sensor_px_per_mm: Positive | None = None
    """Scale if there is no lens_file; the calibration moves reveal an error in it."""
    shape: tuple[Annotated[int, Field(ge=32, le=2048)], Annotated[int, Field(ge=32, le=2048)]] = (
        128,
        128,
    )
    """Rows and columns of a slice."""
    pixel_mm: Positive = 1.0
    """Size of a pixel of a slice."""
    centre_sensor_px: tuple[float, float] | None = None
    """Row and column in the picture that the middle of the slice shows; absent: its middle."""
    frames: Annotated[int, Field(ge=1, le=1000)] = 4
    """Pictures that are averaged into one slice."""
    latency_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    """Longest delay between the exposure of a picture and its arrival."""
    stall_s: Positive = 2.0
    """No picture for this long means that the camera has stalled."""
    most_overexposed: Annotated[float, Field(ge=0, le=1)] = 0.005
    """Largest fraction of the picture's pixels that may be overexposed."""
    service_url: Annotated[str, Field(pattern=r"^https?://[^\s/]+")] = "http://127.0.0.1:8080"
    """The service, which says what to acquire next."""
    token_file: str = ""
    """File with the token that the service asks for; AUTOSPINE_TOKEN overrides it."""
    listener_host: str = "127.0.0.1"
    """Where slices are sent; the port and AE title are those of `[listener]`."""
    ae_title: AeTitle = "BENCHCAMERA"
    """Calling AE title, and the station's name."""
    poll_s: Positive = 0.05
    """How often the service is polled."""
    retry_s: Positive = 0.5
    """Wait after a failed delivery before the next attempt."""
    retries: Annotated[int, Field(ge=0)] = 120
    """Attempts after the first."""
    preview_port: Annotated[int, Field(ge=0, le=65535)] | None = 8090
    """Loopback port of the live preview with focus and exposure; 0: any, absent: none."""


class BenchRoom(BaseModel):
    """What the camera needs of the room's file; `folder` is where that lies."""

    model_config = ConfigDict(frozen=True)

    camera: CameraConfig
    folder: Path
    listener_port: int
    listener_ae_title: str
    radius_mm: tuple[float, float]


def load_bench(path: Path) -> BenchRoom:
    """Raises CameraConfigError, or ConfigError for the rest of the file."""
    room = load_config(path)
    table = read_toml(path).get("camera")
    if table is None:
        raise CameraConfigError(f"{path}: missing table [camera]")
    return BenchRoom(
        camera=parse_camera(table, str(path)),
        folder=path.parent.resolve(),
        listener_port=room.listener.port,
        listener_ae_title=room.listener.ae_title,
        radius_mm=(room.imaging.fiducial_radius_min_mm, room.imaging.fiducial_radius_max_mm),
    )


def parse_camera(table: Mapping[str, Any], where: str = "camera") -> CameraConfig:
    """The checked table; CameraConfigError names every key at fault in one line."""
    try:
        return CameraConfig.model_validate_json(json.dumps(table))
    except ValidationError as error:
        faults = [
            f"{'.'.join(['camera', *map(str, one['loc'])])}: {one['msg']}"
            for one in error.errors(include_url=False)
        ]
        raise CameraConfigError(f"{where}: {'; '.join(faults)}") from None
