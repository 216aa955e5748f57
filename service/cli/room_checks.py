"""What a room would refuse at its start, found without starting it."""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Iterator

from dicom_listener.scp import tls_context
from robot_bridge.daemon.config import BridgeConfig
from room_config.load import Config

LOOPBACK = ("127.0.0.1", "::1", "localhost")
_MM = 1000


def problems_of(room: Config, bridge: BridgeConfig | None) -> list[str]:
    """One line each, with the key; none: `up` and `bridge` accept the file."""
    found = [*open_to_others(room), *_networks(room), *_certificates(room), *_waits(room)]
    return [*found, *(_axes(room, bridge) if bridge is not None else ())]


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
            yield f"service.tls_certificate, service.tls_key: {error}"
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
