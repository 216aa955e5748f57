"""Read the configuration of a room: one strict TOML file, environment variables over it.

`AUTOSPINE_LISTENER__PORT=11112` overrides `port` in `[listener]`. An unknown, missing or misspelt
key is a `ConfigError` whose one line names the file and the key.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from room_config.camera import CameraConfig
from room_config.exit_codes import BAD_INPUT
from room_config.imaging import ImagingConfig
from room_config.listener import ListenerConfig
from room_config.openigtlink import OpenIgtLinkConfig
from room_config.outputs import OutputsConfig
from room_config.room import RoomConfig
from room_config.service import ServiceConfig
from room_config.worker import WorkerConfig

ENVIRONMENT_PREFIX = "AUTOSPINE_"
Model = TypeVar("Model", bound=BaseModel)


class ConfigError(Exception):
    """The configuration cannot be used; the text is one line that names file and key."""

    exit_code = BAD_INPUT


class Config(BaseModel):
    """The whole file. `[bridge]` and `[virtual]` are checked by those who own them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    room: RoomConfig
    imaging: ImagingConfig = Field(default_factory=ImagingConfig)
    listener: ListenerConfig = Field(default_factory=ListenerConfig)
    worker: WorkerConfig = Field(default_factory=WorkerConfig)
    service: ServiceConfig
    outputs: OutputsConfig = Field(default_factory=OutputsConfig)
    openigtlink: OpenIgtLinkConfig = Field(default_factory=OpenIgtLinkConfig)
    bridge: dict[str, Any] = Field(default_factory=dict)
    virtual: dict[str, Any] = Field(default_factory=dict)
    camera: CameraConfig | None = None


def load_config(path: Path, environment: Mapping[str, str] = os.environ) -> Config:
    """Return the checked configuration in `path`; relative paths are relative to that file."""
    table = read_toml(path)
    _override(table, environment)
    try:
        config = Config.model_validate(table)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_first_error(error)}") from None
    sections = {name: getattr(config, name) for name in ("room", "listener", "service")}
    here = path.parent
    update: dict[str, BaseModel] = {n: _absolute(section, here) for n, section in sections.items()}
    sent_to = [_absolute(one, here) for one in config.outputs.destination]
    update["listener"] = _with_instant_of_comparison(update["listener"], path)
    update["outputs"] = config.outputs.model_copy(update={"destination": sent_to})
    return config.model_copy(update=update)


def _with_instant_of_comparison(listener: Model, path: Path) -> Model:
    """A comparison of the clocks in the file is no younger than the file."""
    if not isinstance(listener, ListenerConfig) or listener.clock_compared_at is not None:
        return listener
    written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    return listener.model_copy(update={"clock_compared_at": written})


def _absolute(section: Model, folder: Path) -> Model:
    """The section with every path in it taken from the folder of its file, not from this one."""
    paths = {
        name: (folder / value).resolve()
        for name in type(section).model_fields
        if isinstance(value := getattr(section, name), Path)
    }
    return section.model_copy(update=paths)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file, or say in one line why it cannot be read."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML ({error})") from None


def _override(table: dict[str, Any], environment: Mapping[str, str]) -> None:
    for name, value in environment.items():
        if not name.startswith(ENVIRONMENT_PREFIX) or "__" not in name:
            continue
        section, key = name.removeprefix(ENVIRONMENT_PREFIX).lower().split("__", 1)
        table.setdefault(section, {})[key] = value


def _first_error(error: ValidationError) -> str:
    faults = error.errors()
    # a misspelt key is missing, too
    first = next((one for one in faults if one["type"] == "extra_forbidden"), faults[0])
    place = [str(part) for part in first["loc"]]
    key = ".".join(place)
    if first["type"] == "extra_forbidden":
        close = difflib.get_close_matches(place[-1], _known_keys(place[:-1]), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        return f"unknown key {key}{hint}"
    if first["type"] == "missing":
        return f"missing key {key}"
    got = "" if isinstance(first["input"], dict) else f", got {first['input']!r}"
    return f"key {key}: {first['msg']}{got}"


def _known_keys(place: list[str]) -> list[str]:
    model: Any = Config
    for part in place:
        field = model.model_fields.get(part)
        kinds = () if field is None else (field.annotation, *get_args(field.annotation))
        models = [one for one in kinds if isinstance(one, type) and issubclass(one, BaseModel)]
        if not models:
            return []
        model = models[0]
    return list(model.model_fields)
