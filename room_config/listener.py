"""`[listener]`: the C-STORE service and the assignment of slices."""

from pydantic import Field

from room_config.section import Section


class ListenerConfig(Section):
    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=11112, ge=0, le=65535, description="0: any free port.")
    ae_title: str = Field(default="AUTOSPINE", min_length=1, max_length=16)
    guard_s: float = Field(
        default=0.05,
        ge=0,
        description="A hold is shrunk by this at both ends before a slice may belong to it.",
    )
