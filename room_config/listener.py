"""`[listener]`: the C-STORE service and the assignment of slices."""

from pathlib import Path

from pydantic import AwareDatetime, Field, model_validator

from room_config.section import Section


class ListenerConfig(Section):
    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=11112, ge=0, le=65535, description="0: any free port.")
    ae_title: str = Field(default="AUTOSPINE", min_length=1, max_length=16)
    require_called_ae_title: bool = Field(
        default=True, description="True: refuse associations that call a different AE title."
    )
    calling_ae_titles: tuple[str, ...] = Field(
        default=(), description="AE titles that may send; empty: any."
    )
    peer_networks: tuple[str, ...] = Field(
        default=(), description="Addresses or CIDR networks that may send; empty: any."
    )
    any_storage_class: bool = Field(
        default=True,
        description="True: store every kind of object and set aside what is not an MR image; "
        "false: refuse it at negotiation.",
    )
    max_associations: int = Field(default=16, ge=1, le=256)
    acse_timeout_s: float = Field(
        default=10.0, gt=0, description="Time allowed to open an association."
    )
    dimse_timeout_s: float = Field(
        default=30.0, gt=0, description="Time allowed between parts of a message."
    )
    network_timeout_s: float = Field(
        default=900.0,
        gt=0,
        description="An association idle for this long between messages is ended; must exceed "
        "the pauses of scanners that keep an association open.",
    )
    max_object_mib: int = Field(default=512, ge=1, description="Largest object that is stored.")
    min_free_mib: int = Field(
        default=1024,
        ge=0,
        description="Below this much free disk space slices are refused (0xA700); the alarm "
        "comes at twice that.",
    )
    tls_certificate: Path | None = Field(
        default=None, description="PEM file; with tls_key and tls_authority: mutual TLS."
    )
    tls_key: Path | None = Field(default=None, description="PEM file of the private key.")
    tls_authority: Path | None = Field(
        default=None, description="PEM file of the authority that signs the senders' certificates."
    )
    watch_dir: Path | None = Field(
        default=None,
        description="A folder (share) to which the scanner console writes slices, as a second "
        "input. It is only read.",
    )
    scanner_time_zone: str = Field(
        default="",
        description="IANA time zone of scanners that do not state theirs; empty: this computer's.",
    )
    guard_s: float = Field(
        default=0.05,
        ge=0,
        description="A hold is shortened by this at both ends before a slice may belong to it.",
    )
    prompt_delay_s: float | None = Field(
        default=None,
        gt=0,
        description="No slice arrives later than this after the end of its acquisition, as "
        "measured at this site (`autospine commission`). Absent: not measured, and nothing "
        "is assumed.",
    )
    least_delay_s: float = Field(
        default=0.0,
        ge=0,
        description="No slice arrives sooner than this after the end of its acquisition, as "
        "measured together with prompt_delay_s.",
    )
    longest_acquisition_s: float = Field(
        default=30.0,
        gt=0,
        description="Longest acquisition of a slice that does not state its duration; such a "
        "slice is used only after the robot has stood still for that long.",
    )
    late_limit_s: float = Field(
        default=300.0,
        gt=0,
        description="No slice arrives later than this after its acquisition; one that appears to "
        "is set aside: its clock may have jumped.",
    )
    clock_offset_s: float | None = Field(
        default=None, description="A comparison of the clocks: ours minus the scanner's."
    )
    clock_uncertainty_s: float = Field(
        default=1.0, ge=0, description="Uncertainty of clock_offset_s."
    )
    clock_compared_at: AwareDatetime | None = Field(
        default=None,
        description="When clock_offset_s was measured, with its offset from UTC; absent: when "
        "this file was last written.",
    )
    comparison_valid_min: float = Field(
        default=60.0,
        gt=0,
        description="How long a comparison of the clocks is valid; after that slices are pending "
        "until the clocks are compared again. A scanner that states that its clock is "
        "synchronized is exempt.",
    )
    clock_may_be_set: bool = Field(
        default=True,
        description="True: the scanner's clock may be set without the room being told. Where "
        "prompt_delay_s was not measured, the clocks must then be compared at each hold, or each "
        "acquisition confirmed. False: the clock is never set, and a comparison is valid for "
        "comparison_valid_min.",
    )
    arrival_mode: bool = Field(
        default=False,
        description="True: acquisition times are unusable here; the operator confirms each "
        "acquisition, and every result is marked.",
    )
    allow_derived: bool = Field(default=False, description="True: use derived images too.")
    camera_slices: bool = Field(
        default=False,
        description="True: slices of a bench camera (`autospine camera`) are used, too.",
    )
    metrics_port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="Port for /metrics on localhost; absent: not served.",
    )
    commitment_reports_to: dict[str, str] = Field(
        default={},
        description='AE title = "host:port" of consoles that request Storage Commitment and want '
        "the report on a separate association.",
    )
    retention_days: float = Field(
        default=0.0, ge=0, description="Delete set-aside files after this many days; 0: keep all."
    )

    @model_validator(mode="after")
    def _delays_are_in_order(self) -> "ListenerConfig":
        if self.prompt_delay_s is None and self.least_delay_s:
            raise ValueError("least_delay_s is measured with prompt_delay_s: give both")
        if self.prompt_delay_s is not None and not self.least_delay_s <= self.prompt_delay_s:
            raise ValueError("least_delay_s must not exceed prompt_delay_s")
        return self

    @model_validator(mode="after")
    def _reports_have_addresses(self) -> "ListenerConfig":
        for title, place in self.commitment_reports_to.items():
            host, _, port = place.rpartition(":")
            if not host or not port.isdecimal() or not 0 < int(port) < 65536:
                raise ValueError(f"commitment_reports_to {title}: {place!r} is not host:port")
        return self

    @model_validator(mode="after")
    def _tls_is_whole(self) -> "ListenerConfig":
        given = [self.tls_certificate, self.tls_key, self.tls_authority]
        if any(given) and not all(given):
            raise ValueError("tls_certificate, tls_key and tls_authority belong together")
        return self
