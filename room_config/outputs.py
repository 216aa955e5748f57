"""`[outputs]` and `[[outputs.destination]]`: which DICOM objects of ours are sent, and to whom."""

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from room_config.section import Section

OutputKind = Literal["image", "report", "presentation", "plan"]


class Destination(Section):
    """Somebody who stores DICOM objects: an archive, a planning workstation."""

    name: str = Field(
        min_length=1,
        max_length=32,
        pattern=r"^[A-Za-z0-9 ._-]+$",
        description="Its name on the page, in the log and in the outbox.",
    )
    host: str = Field(min_length=1, description="Name or address of the computer.")
    port: int = Field(ge=1, le=65535, description="Its DICOM port.")
    ae_title: str = Field(min_length=1, max_length=16, description="Its AE title.")
    calling_ae_title: str = Field(
        default="AUTOSPINE",
        min_length=1,
        max_length=16,
        description="The AE title that we present.",
    )
    kinds: tuple[OutputKind, ...] = Field(
        default=("image", "report", "presentation"),
        min_length=1,
        description="What it receives: `image` (derived MR image of every reconstruction), "
        "`report` "
        "(measurement report of every READY and every puncture), `presentation` (presentation "
        "state of every READY); and, where it is asked for, `plan` (target and entry point as "
        "Spatial Fiducials, whenever they change).",
    )
    tls_certificate: Path | None = Field(
        default=None, description="PEM file; with tls_key and tls_authority: mutual TLS."
    )
    tls_key: Path | None = Field(default=None, description="PEM file of the private key.")
    tls_authority: Path | None = Field(
        default=None,
        description="PEM file of the authority that signed the destination's certificate.",
    )
    tls_name: str = Field(
        default="", description="The name in the destination's certificate; empty: `host`."
    )

    @model_validator(mode="after")
    def _tls_is_whole(self) -> "Destination":
        given = [self.tls_certificate, self.tls_key, self.tls_authority]
        if any(given) and not all(given):
            raise ValueError("tls_certificate, tls_key and tls_authority belong together")
        return self


class OutputsConfig(Section):
    timeout_s: float = Field(
        default=30.0,
        gt=0,
        description="Time allowed to reach a destination, and for each of its responses.",
    )
    retry_s: float = Field(
        default=2.0, gt=0, description="First wait before sending again; doubled each time."
    )
    longest_retry_s: float = Field(
        default=120.0, gt=0, description="Longest wait. Refused objects wait this long."
    )
    alarm_after_s: float = Field(
        default=60.0,
        ge=0,
        description="A destination unreachable for this long raises an alarm.",
    )
    destination: list[Destination] = Field(
        default=[],
        description="Who receives what, one [[outputs.destination]] table each. Without any, "
        "nothing is sent or prepared for sending.",
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "OutputsConfig":
        names = [destination.name for destination in self.destination]
        if len(set(names)) != len(names):
            raise ValueError("two destinations have the same name")
        if not self.retry_s <= self.longest_retry_s:
            raise ValueError("retry_s must not be above longest_retry_s")
        return self
