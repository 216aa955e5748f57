"""The `[virtual]` table of a room's TOML file: strict, frozen, units in the names.

Frames: `robot` is fixed to the stages (x, y the axes of travel, z out of the stage planes, mm);
`patient` is DICOM's LPS (mm). Signals are relative: 1 is the oil of the fiducial.
"""

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from room_config.section import AeTitle, Positive
from simulator.faults import FAULTS

Vector = tuple[float, float, float]
Port = Annotated[int, Field(ge=1, le=65535)]


class VirtualRoomError(ValueError):
    """The `[virtual]` table cannot be used; the message names the key."""


class _Table(BaseModel):
    # The text below a field is its description, in the documentation as well.
    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


class Placement(_Table):
    """How the robot stands on the table, and how true its stages are."""

    origin_mm: Vector = (5.3, 58.0, -17.6)
    """Patient position (LPS) of the robot's origin."""
    rotation_deg: Annotated[float, Field(gt=-180, le=180)] = 1.5
    """About the robot's z. At 0, robot x is patient left and robot y is patient inferior."""
    tilt_deg: tuple[float, float] = (0.3, -0.2)
    """Rotations about the patient's left and superior axes: the stages are not quite coronal."""
    scale: tuple[Positive, Positive] = (1.003, 0.998)
    """True millimetres per millimetre of the stage's own scale, x and y."""
    skew_deg: Annotated[float, Field(gt=-45, lt=45)] = 0.15
    """How far the angle between the two axes of travel is from 90°."""
    top_plane_mm: float = 0.0
    """Height (robot z) of the ball joint of the top stage."""
    bottom_plane_mm: float = -60.0
    """Height (robot z) of the ball joint of the bottom stage."""

    @model_validator(mode="after")
    def _planes_are_apart(self) -> "Placement":
        if not self.top_plane_mm > self.bottom_plane_mm:
            raise ValueError("top_plane_mm must lie above bottom_plane_mm")
        return self


class Fiducial(_Table):
    """Vitamin E in a polymer shell: a sphere, or an oval one that a cannula goes through."""

    name: Annotated[str, Field(min_length=1)] = "upper"
    """Its name in the truth file."""
    mount: Literal["top_stage", "guide"] = "top_stage"
    """`top_stage`: rides on it (2 DOF); `guide`: on the cannula between the ball joints (4 DOF)."""
    offset_mm: Vector = (0.0, 0.0, 0.0)
    """top_stage only: from the top ball joint, robot frame."""
    along_guide_mm: float = 0.0
    """guide only: distance from the lower ball joint, in which the cannula is fixed."""
    radius_mm: Positive = 4.0
    """Of the oil."""
    shell_mm: Annotated[float, Field(ge=0)] = 1.5
    """Thickness of the shell."""
    signal: Positive = 1.0
    """Of the oil."""
    shell_signal: Annotated[float, Field(ge=0)] = 0.0
    """Of the shell: printed polymer gives none."""
    oval: Annotated[float, Field(ge=1, le=1.5)] = 1.0
    """Longer over shorter diameter of a coronal section; 1: a sphere."""
    oval_deg: Annotated[float, Field(ge=0, lt=180)] = 30.0
    """Direction of the longer one, from the image's rows towards its columns."""
    cannula_mm: Annotated[float, Field(ge=0)] = 0.0
    """Diameter of the void that a cannula through the fiducial, along the slice normal, leaves; 0:
    none."""

    @model_validator(mode="after")
    def _cannula_fits(self) -> "Fiducial":
        if not self.cannula_mm < 2 * self.radius_mm / self.oval**0.5:
            raise ValueError("cannula_mm leaves nothing of the fiducial")
        return self


FiducialKind = Literal["cannulated", "sphere"]
CANNULATED = {"oval": 1.06, "cannula_mm": 4.0}
"""What a printed fiducial that sits on a needle guide of brass is like, beside a plain sphere."""


class StaticObject(_Table):
    """Something that lies on the table and does not move with the robot (water, not oil)."""

    kind: Literal["box", "cylinder", "sphere"]
    """Its shape."""
    centre_mm: Vector
    """Patient position (LPS)."""
    size_mm: tuple[Positive, Positive, Positive] | None = None
    """box only: full edges along the patient's x, y, z."""
    radius_mm: Positive | None = None
    """sphere and cylinder only."""
    length_mm: Positive | None = None
    """cylinder only."""
    axis: Literal["x", "y", "z"] = "y"
    """cylinder only: the patient axis along which it lies."""
    signal: Annotated[float, Field(ge=0)] = 0.6
    """Of its water."""

    @model_validator(mode="after")
    def _has_its_dimensions(self) -> "StaticObject":
        wanted = {
            "box": {"size_mm"},
            "sphere": {"radius_mm"},
            "cylinder": {"radius_mm", "length_mm"},
        }
        for key in ("size_mm", "radius_mm", "length_mm"):
            if (key in wanted[self.kind]) != (getattr(self, key) is not None):
                raise ValueError(
                    f"a {self.kind} {'needs' if key in wanted[self.kind] else 'has no'} {key}"
                )
        return self


BACKGROUND: tuple[StaticObject, ...] = (
    # A water phantom below the robot, and two tubes beside it.
    StaticObject(kind="box", centre_mm=(5.0, 58.0, -71.5), size_mm=(96.0, 60.0, 17.0), signal=0.55),
    StaticObject(
        kind="cylinder", centre_mm=(-44.0, 58.0, 33.0), radius_mm=8.5, length_mm=80.0, signal=0.7
    ),
    StaticObject(
        kind="cylinder", centre_mm=(52.0, 58.0, 30.0), radius_mm=1.8, length_mm=80.0, signal=0.5
    ),
)


class SliceProtocol(_Table):
    """What the scanner's operator has set: field of view, contrast, filters, noise."""

    orientation: Literal["coronal", "axial", "sagittal"] = "coronal"
    """Plane of the slices."""
    shape: tuple[Annotated[int, Field(ge=16, le=1024)], Annotated[int, Field(ge=16, le=1024)]] = (
        128,
        128,
    )
    """Rows, columns."""
    spacing_mm: tuple[Positive, Positive] = (1.0, 1.0)
    """Between rows, between columns."""
    thickness_mm: Positive = 3.0
    """Of the slice; its profile is rectangular."""
    fov_centre_mm: Vector = (5.0, 58.0, -18.0)
    """Patient position of the middle of the field of view of the slice at its default position."""
    phase_encoding: Literal["ROW", "COL"] = "COL"
    """DICOM's word: COL encodes the phase along the columns and reads out along the rows."""
    window: Literal["flat", "hamming", "fermi", "elliptical"] = "flat"
    """The filter in k-space."""
    snr: Positive = 30.0
    """Signal 1 over the noise of one channel (real or imaginary) before the filter."""
    shading_per_mm: tuple[float, float] = (0.0006, -0.0009)
    """Relative slope of the receive sensitivity along rows and columns, from the middle."""
    shading_per_mm2: float = -6.0e-6
    """Relative curvature of the receive sensitivity."""
    stored_per_signal: Positive = 1000.0
    """Stored pixel value of signal 1."""
    field_t: Positive = 3.0
    """Main field."""
    imaging_frequency_mhz: Positive = 123.2
    """Larmor frequency of water."""
    bandwidth_hz_px: Positive = 260.0
    """Receive bandwidth of one pixel."""
    readout_polarity: Literal[-1, 1] = 1
    """Sign of the readout gradient: to which side oil is displaced."""
    chemical_shift_ppm: Annotated[float, Field(ge=0)] = 0.0
    """Oil against water: 3.4 in a real room; 0 leaves the fiducial where it is."""
    echo_time_ms: Positive = 0.9
    """As stated in the header."""
    flip_angle_deg: Positive = 12.0
    """As stated in the header."""


class ScannerSettings(_Table):
    """The scanner as a DICOM node with a clock and an operator of its own."""

    service_url: Annotated[str, Field(pattern=r"^https?://[^\s/]+")]
    """Address of the service, which says what to acquire next."""
    token_file: str = ""
    """File with the token that the service asks for; relative to the configuration. The environment
    variable AUTOSPINE_TOKEN overrides it. Empty: the service asks for none."""
    listener_host: str = "127.0.0.1"
    """Where slices are sent."""
    listener_port: Port
    """DICOM port of the listener."""
    listener_ae_title: AeTitle = "AUTOSPINE"
    """Called AE title."""
    ae_title: AeTitle = "VIRTUALMR"
    """Calling AE title, and the station's name."""
    motors_truth_host: str = "127.0.0.1"
    """Where the emulated motors report the true stage positions."""
    motors_truth_port: Port
    """Its port."""
    truth_file: str
    """JSON lines, appended: the truth of each acquisition. Relative to the configuration."""
    faults_file: str = ""
    """File with the names of faults that affect every acquisition while listed, one per line; read
    again each time. Relative to the configuration. Empty: only the room's `faults`."""
    acquisition_s: Positive = 0.25
    """Duration of an acquisition."""
    gap_s: Annotated[float, Field(ge=0)] = 0.02
    """Between two slices of one request."""
    reconstruction_s: Annotated[float, Field(ge=0)] = 0.15
    """From the end of an acquisition until its slice is sent."""
    poll_s: Positive = 0.05
    """How often the operator checks what to acquire."""
    retry_s: Positive = 0.5
    """Wait after a failed delivery before the next attempt."""
    retries: Annotated[int, Field(ge=0)] = 120
    """Attempts after the first."""
    clock_offset_s: float = 37.2
    """The scanner's clock minus ours."""
    clock_drift_ppm: float = 0.0
    """How much faster the scanner's clock runs than ours."""
    utc_offset_min: Annotated[int, Field(ge=-14 * 60, le=14 * 60)] = 0
    """The scanner writes local time, this many minutes ahead of UTC."""
    write_timezone: bool = True
    """Whether the header says so (TimezoneOffsetFromUTC)."""
    time_attributes: Literal["datetime", "date_and_time", "both"] = "both"
    """AcquisitionDateTime, AcquisitionDate with AcquisitionTime, or both; classic images only."""
    sop_class: Literal["classic", "enhanced"] = "classic"
    """MR Image or Enhanced MR Image."""
    manufacturer: str = "AutoSPINe Virtual MR"
    """As stated in the header."""
    model_name: str = "Virtual 3T"
    """As stated in the header."""


class VirtualRoom(_Table):
    """Everything that the virtual room is made of."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of noise and faults."""
    placement: Placement = Placement()
    """Where the robot stands."""
    fiducials: Annotated[tuple[Fiducial, ...], Field(min_length=1)] = (Fiducial(),)
    """One for two degrees of freedom, two on the guide for four."""
    background: tuple[StaticObject, ...] = BACKGROUND
    """What else lies in the field of view; by default a water phantom and two tubes."""
    protocol: SliceProtocol = SliceProtocol()
    """How slices are acquired."""
    scanner: ScannerSettings | None = None
    """The scanner as a process; not needed for studies."""
    faults: tuple[str, ...] = ()
    """Names of the faults."""
    fault_probability: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Probability that each of them affects an acquisition."""
    motors: dict[str, Any] = {}
    """Not read here: the emulated motor controllers check their own table."""

    @model_validator(mode="after")
    def _names_are_known_and_unique(self) -> "VirtualRoom":
        for name in self.faults:
            if name not in FAULTS:
                raise ValueError(f"unknown fault {name!r}; known: {', '.join(FAULTS)}")
        names = [fiducial.name for fiducial in self.fiducials]
        if len(set(names)) != len(names):
            raise ValueError("two fiducials have the same name")
        return self


def parse_virtual_room(table: Mapping[str, Any]) -> VirtualRoom:
    """The checked virtual room of a raw `[virtual]` table.

    Raises VirtualRoomError with one line that names every key at fault.
    """
    try:
        # By way of JSON: there, an array is a tuple, and nothing else is converted.
        return VirtualRoom.model_validate_json(json.dumps(table))
    except ValidationError as error:
        raise VirtualRoomError(_one_line(error)) from None
    except TypeError as error:
        raise VirtualRoomError(f"virtual: {error}") from None


def _one_line(error: ValidationError) -> str:
    parts = []
    for fault in error.errors(include_url=False):
        key = ".".join(["virtual", *(str(part) for part in fault["loc"])])
        parts.append(f"{key}: {fault['msg'].removeprefix('Value error, ')}")
    return "; ".join(parts)
