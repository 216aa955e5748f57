"""What the camera needs of a room's TOML file, and how it says what is wrong."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from room_config.camera import CameraConfig
from room_config.exit_codes import BAD_INPUT, COULD_NOT
from room_config.load import load_config


class CameraConfigError(ValueError):
    """The `[camera]` table or a file that it names cannot be used; one line."""

    exit_code = BAD_INPUT


class CameraError(Exception):
    """The camera does not give what is needed; one line, with what to do."""

    exit_code = COULD_NOT


class BenchRoom(BaseModel):
    """What the camera needs of the room's file; `folder` is where that lies."""

    model_config = ConfigDict(frozen=True)

    camera: CameraConfig
    folder: Path
    listener_port: int
    listener_ae_title: str
    radius_mm: tuple[float, float]


def load_bench(path: Path) -> BenchRoom:
    """Raises CameraConfigError where there is no camera, ConfigError for what is wrong."""
    room = load_config(path)
    if room.camera is None:
        raise CameraConfigError(f"{path}: missing table [camera]")
    return BenchRoom(
        camera=room.camera,
        folder=path.parent.resolve(),
        listener_port=room.listener.port,
        listener_ae_title=room.listener.ae_title,
        radius_mm=(room.imaging.fiducial_radius_min_mm, room.imaging.fiducial_radius_max_mm),
    )
