"""Addresses of callers, and the networks from which they may come."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


def address_of(text: str) -> Address:
    """Return a caller's address; an IPv4 caller of a dual-stack socket is an IPv4 caller.

    Such a socket (host `::`) calls 192.0.2.7 ::ffff:192.0.2.7. Raises ValueError.
    """
    address = ipaddress.ip_address(text)
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return mapped or address


def with_mapped(networks: Iterable[str]) -> list[str]:
    """Return the networks, and each IPv4 one also as a dual-stack socket writes it."""
    known = [ipaddress.ip_network(text, strict=False) for text in networks]
    mapped = [
        f"::ffff:{one.network_address}/{96 + one.prefixlen}" for one in known if one.version == 4
    ]
    return [*map(str, known), *mapped]
