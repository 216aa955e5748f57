"""`[openigtlink]`: the live scene for 3D Slicer and other navigation software."""

import ipaddress

from pydantic import Field, model_validator

from room_config.section import Section


class OpenIgtLinkConfig(Section):
    port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="Where receivers connect, usually 18944 (0: any free port); absent: off.",
    )
    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    peer_networks: tuple[str, ...] = Field(
        default=(),
        description="Addresses or CIDR networks that may connect. OpenIGTLink has no login: "
        "required unless host is loopback.",
    )
    inwards: bool = Field(
        default=False,
        description="Answer queries from peers, and propose their targets and entry points to "
        "the operator. STOP and EMERGENCY are obeyed from every peer even if this is off.",
    )
    max_receivers: int = Field(default=8, ge=1, le=64)

    @model_validator(mode="after")
    def _guarded(self) -> "OpenIgtLinkConfig":
        for network in self.peer_networks:
            ipaddress.ip_network(network)
        if self.port is not None and not self.peer_networks and not _is_loopback(self.host):
            raise ValueError(
                f"peer_networks must list who may connect, because host {self.host} is not loopback"
            )
        return self


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
