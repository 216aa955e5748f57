"""`[service]`: the page, the API, the procedure."""

import ipaddress
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import SplitResult, urlsplit

from pydantic import Field, field_validator, model_validator

from room_config.section import Section

Strategy = Literal["base", "bicubic", "sr", "hybrid", "adaptive"]
STRATEGIES: tuple[str, ...] = get_args(Strategy)


_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})


def is_loopback(address: SplitResult) -> bool:
    return address.hostname in _LOOPBACK


def checked_public_url(text: str) -> str:
    """Return the address with a slash at the end of its path; ValueError if it is none."""
    parts = urlsplit(text)
    _ = parts.port  # ValueError of its own if it is no number
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError(f"{text!r} is not an address like https://navigator.example.org/")
    if parts.query or parts.fragment or parts.username:
        raise ValueError(f"{text!r} must be scheme, host, port and path only")
    return f"{parts.scheme}://{parts.netloc}{parts.path.rstrip('/')}/"


class AccessToken(Section):
    """Somebody who may use the service. `autospine token NAME` makes one."""

    name: str = Field(
        min_length=1,
        max_length=64,
        pattern=r"^[^\x00-\x1f\x7f]+$",
        description="Name; recorded with every action.",
    )
    role: Literal["viewer", "operator"] = Field(
        description="A viewer may look and press STOP; an operator may do everything."
    )
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="Hash of the token, hexadecimal.")
    expires: date | None = Field(
        default=None, description="Last day (UTC) on which the token is valid; absent: no expiry."
    )

    def has_expired(self, wall_s: float) -> bool:
        if self.expires is None:
            return False
        return datetime.fromtimestamp(wall_s, UTC).date() > self.expires


class GuideConfig(Section):
    """A robot with two stages and two fiducials on the guide: four degrees of freedom.

    Positions are along the slice normal (patient y of coronal slices), distances along the guide.
    """

    axes: list[str] = Field(
        default=["xt", "yt", "xb", "yb"],
        min_length=4,
        max_length=4,
        description="The top stage's two axes, then the bottom stage's two.",
    )
    upper_plane_mm: float = Field(
        description="Where the plane of the upper ball joint crosses the slice normal."
    )
    lower_plane_mm: float = Field(
        description="Where the plane of the lower ball joint, in which the cannula is fixed, "
        "crosses the slice normal."
    )
    upper_fiducial_mm: float = Field(
        gt=0,
        description="Distance of the upper fiducial along the guide from the lower ball joint.",
    )
    lower_fiducial_mm: float = Field(
        gt=0,
        description="Distance of the lower fiducial along the guide from the lower ball joint.",
    )
    upper_slice_mm: float = Field(
        description="Position along its normal of the slice that shows the upper fiducial."
    )
    lower_slice_mm: float = Field(
        description="Position along its normal of the slice that shows the lower fiducial."
    )
    needle_reach_mm: float = Field(
        default=120.0,
        gt=0,
        description="A target farther below the lower ball joint than this is refused.",
    )
    calibration_move_mm: float = Field(
        default=6.0, description="Length of the four calibration moves; the sign is the direction."
    )
    tolerance_mm: float = Field(
        default=0.25, gt=0, description="READY when the error of the needle tip is below this."
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "GuideConfig":
        if len(set(self.axes)) != len(self.axes):
            raise ValueError("axes: four different axes are needed")
        if self.upper_plane_mm == self.lower_plane_mm:
            raise ValueError("upper_plane_mm and lower_plane_mm must differ")
        if not self.upper_fiducial_mm > self.lower_fiducial_mm:
            raise ValueError("upper_fiducial_mm must be above lower_fiducial_mm")
        if self.upper_slice_mm == self.lower_slice_mm:
            raise ValueError("upper_slice_mm and lower_slice_mm must differ")
        upwards = self.upper_plane_mm > self.lower_plane_mm
        if (self.upper_slice_mm > self.lower_slice_mm) != upwards:
            raise ValueError(
                "upper_slice_mm must be on the same side of lower_slice_mm as upper_plane_mm is "
                "of lower_plane_mm"
            )
        return self


class ServiceConfig(Section):
    host: str = Field(default="127.0.0.1", description="Address of the page and the API.")
    port: int = Field(default=8080, ge=0, le=65535, description="0: any free port.")
    bridge_link: str = Field(
        min_length=1, description="Serial device or pyserial URL on which the bridge answers."
    )
    token: list[AccessToken] = Field(
        default=[],
        description="Who may use the service, one [[service.token]] table each. Without any, it "
        "listens on loopback only and everyone there is an operator.",
    )
    session_hours: float = Field(
        default=12.0, gt=0, le=168, description="A login on the page lasts this long."
    )
    lock_out_after: int = Field(
        default=5, ge=2, description="This many wrong tokens from one address lock it out."
    )
    lock_out_s: float = Field(default=60.0, gt=0, description="A lock-out lasts this long.")
    tls_certificate: Path | None = Field(
        default=None, description="PEM file; with tls_key the page is served over HTTPS."
    )
    tls_key: Path | None = Field(default=None, description="PEM file of the private key.")
    public_url: str = Field(
        default="",
        description="The address of the page behind a reverse proxy, such as "
        "https://navigator.example.org/room1/; empty: host and port are opened directly.",
    )
    camera_preview_url: str = Field(
        default="",
        pattern=r"^(https?://\S+)?$",
        description="At a bench: the live view of `autospine camera`; the page links to it.",
    )
    trusted_proxies: list[str] = Field(
        default=["127.0.0.1", "::1"],
        description="Addresses and networks of the proxies whose X-Forwarded-For is trusted.",
    )
    heartbeat_s: float = Field(default=0.2, gt=0, le=1)
    axes: list[str] = Field(
        default=["xt", "yt"],
        min_length=2,
        max_length=2,
        description="The stage axes that carry the fiducial: the one driven first, then the other.",
    )
    calibration_move_mm: float = Field(
        default=15.0, description="Length of the two calibration moves; the sign is the direction."
    )
    strategy: Strategy = "adaptive"
    tolerance_mm: float = Field(
        default=0.06, gt=0, description="READY when the error is below this."
    )
    confidence: float = Field(
        default=0.95, gt=0.5, lt=1, description="Probability with which the error must be below."
    )
    tolerance_range_mm: tuple[float, float] = Field(
        default=(0.03, 0.5),
        description="Range in which the page can set the tolerance of a case.",
    )
    confidence_range: tuple[float, float] = Field(
        default=(0.8, 0.999),
        description="Range in which the page can set the confidence of a case.",
    )
    most_slices: int = Field(
        default=6,
        ge=1,
        le=32,
        description="Most slices taken at one position to reach the confidence.",
    )
    most_slices_limit: int = Field(
        default=16, ge=1, le=32, description="Upper limit for that number on the page."
    )
    max_iterations: int = Field(default=8, ge=1, description="Most moves in one approach.")
    shift_set: Literal["single", "quarter", "half", "lattice5", "paper"] = Field(
        default="quarter",
        description="Commanded shifts of one measurement when several are needed.",
    )
    confirm_moves: bool = Field(
        default=True, description="True: each approach move waits for the operator's CONFIRM MOVE."
    )
    prediction_gate_sigma: float = Field(
        default=5.0,
        gt=0,
        description="Refuse to continue when a move misses its prediction by more than this.",
    )
    ready_valid_s: float = Field(
        default=300.0,
        gt=0,
        description="How long a measurement, and READY with it, stays valid: no sensor detects a "
        "push on a stage without an encoder. After that it must be measured again.",
    )
    settle_s: float = Field(
        default=3.5,
        ge=0,
        description="Wait after a move before slices are requested; must exceed the uncertainty "
        "of the scanner's clock, or slices cannot be proved to belong to the hold.",
    )
    rescan_after_s: float = Field(
        default=60.0,
        gt=0,
        description="Request the slices again when none has arrived for this long.",
    )
    repeatability_um: float = Field(
        default=14.0, gt=0, description="Standard deviation of one axis after one move."
    )
    step_scale_error: float = Field(
        default=0.015,
        gt=0,
        lt=1,
        description="Relative scatter of a move's length from one move to the next.",
    )

    guide: GuideConfig | None = Field(
        default=None,
        description="The [service.guide] table of a robot with two stages; absent: one stage, one "
        "fiducial.",
    )

    @field_validator("public_url")
    @classmethod
    def _is_web_address(cls, value: str) -> str:
        return value and checked_public_url(value)

    @field_validator("trusted_proxies")
    @classmethod
    def _are_networks(cls, value: list[str]) -> list[str]:
        for text in value:
            ipaddress.ip_network(text, strict=False)
        return value

    @model_validator(mode="after")
    def _access_is_whole(self) -> "ServiceConfig":
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together")
        if self.public_url and not self.token and not is_loopback(urlsplit(self.public_url)):
            raise ValueError(
                "public_url makes the page reachable by others: add [[service.token]] tables "
                "(`autospine token NAME` makes one)"
            )
        for name in ("tolerance_range_mm", "confidence_range"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(
                    f"{name}: the first number must be above 0 and not above the second"
                )
        if not 0.5 < self.confidence_range[0] <= self.confidence_range[1] < 1:
            raise ValueError("confidence_range: both must lie between 0.5 and 1")
        names = [token.name for token in self.token]
        if len(set(names)) != len(names):
            raise ValueError("two tokens have the same name")
        return self
