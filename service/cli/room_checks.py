"""What a room would refuse at its start, found without starting it."""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Iterator
from pathlib import Path

from dicom_listener.scp import tls_context
from robot_bridge.daemon.config import BridgeConfig, bridge_config_from_table
from robot_bridge.daemon.config import ConfigError as BridgeConfigError
from room_config.load import Config, ConfigError, load_config

LOOPBACK = ("127.0.0.1", "::1", "localhost")
_MM = 1000


def checked_room(file: Path) -> tuple[Config, BridgeConfig | None]:
    """A room's file with nothing in it that would be refused later, and its bridge if it has one.

    Raises ConfigError with all that is wrong in one line.
    """
    room, bridge = load_config(file), None
    if room.bridge:
        try:
            bridge = bridge_config_from_table(room.bridge, str(file))
        except BridgeConfigError as error:
            raise ConfigError(str(error)) from None
    found = [*open_to_others(room), *_networks(room), *_certificates(room), *_waits(room)]
    found += _camera(room)
    found += _axes(room, bridge) if bridge is not None else ()
    if found:
        raise ConfigError(f"{file}: {'; '.join(found)}")
    return room, bridge


def open_to_others(room: Config) -> Iterator[str]:
    if room.service.host not in LOOPBACK and not room.service.token:
        yield (
            f"key service.host: {room.service.host} is not loopback: add [[service.token]] tables "
            "(`autospine token NAME` makes one), or listen on 127.0.0.1"
        )


def _networks(room: Config) -> Iterator[str]:
    for text in room.listener.peer_networks:
        try:
            ipaddress.ip_network(text, strict=False)
        except ValueError as error:
            yield f"key listener.peer_networks: {error}"


def _certificates(room: Config) -> Iterator[str]:
    service, listener = room.service, room.listener
    if service.tls_certificate is not None:
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
                service.tls_certificate, service.tls_key
            )
        except OSError as error:  # ssl.SSLError is one
            files = f"{service.tls_certificate}, {service.tls_key}"
            yield f"service.tls_certificate, service.tls_key: {files}: {error.strerror or error}"
    if listener.tls_certificate and listener.tls_key and listener.tls_authority:
        try:
            tls_context(listener.tls_certificate, listener.tls_key, listener.tls_authority)
        except OSError as error:
            yield f"listener.tls_*: certificates cannot be used ({error})"


def _waits(room: Config) -> Iterator[str]:
    listener = room.listener
    known = listener.clock_offset_s is not None
    least_s = listener.guard_s + (listener.clock_uncertainty_s if known else 0.0)
    if not room.service.settle_s >= least_s:
        yield (
            f"key service.settle_s: {room.service.settle_s:g} s is less than the guard plus the "
            f"clock uncertainty ({least_s:g} s): no slice could be proved "
            "to belong to its hold"
        )


def _camera(room: Config) -> Iterator[str]:
    """What the listener would do with the slices of a camera, the only ones of a bench."""
    if room.camera is None:
        return
    title, allowed = room.camera.ae_title, room.listener.calling_ae_titles
    if allowed and title not in allowed:
        yield f"key listener.calling_ae_titles: the camera's {title!r} (camera.ae_title) is missing"
    if not room.listener.camera_slices:
        yield "key listener.camera_slices: must be true, or the camera's slices are set aside"


def _axes(room: Config, bridge: BridgeConfig) -> Iterator[str]:
    service = room.service
    axes = {axis.name: axis for axis in bridge.axes}
    named = [("service.axes", service.axes, service.calibration_move_mm)]
    if service.guide is not None:
        named.append(("service.guide.axes", service.guide.axes, service.guide.calibration_move_mm))
    for key, names, move_mm in named:
        for name in names:
            if name not in axes:
                yield f"key {key}: the bridge has no axis {name!r}; it has {', '.join(axes)}"
                continue
            low_mm, high_mm = axes[name].travel_min_um / _MM, axes[name].travel_max_um / _MM
            if not abs(move_mm) <= high_mm - low_mm:
                yield (
                    f"key {key.rsplit('.', 1)[0]}.calibration_move_mm: {move_mm:g} mm do not fit "
                    f"in the travel of {name} ({low_mm:g} to {high_mm:g} mm)"
                )
