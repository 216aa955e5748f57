"""The `[camera]` table: a camera at the bench in place of the scanner; units in the names."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from room_config.section import AeTitle, Positive, Section


class CameraConfig(Section):
    """A camera over the robot, in the place of a scanner."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    source: str
    """Number or path of a video device (0, /dev/video0), a video file, pictures (frames/*.png), or
    an http, https or rtsp address."""
    colour: Literal["redness", "greenness", "blueness", "grey", "dark"] = "redness"
    """Channel in which the circle is brighter than its surroundings: redness for red on white."""
    lens_file: str = ""
    """Made by `autospine camera --board`; corrects the lens and gives the scale. Relative to this
    file."""
    sensor_px_per_mm: Positive | None = None
    """Scale if there is no lens_file; the calibration moves reveal an error in it."""
    shape: tuple[Annotated[int, Field(ge=32, le=2048)], Annotated[int, Field(ge=32, le=2048)]] = (
        128,
        128,
    )
    """Rows and columns of a slice."""
    pixel_mm: Positive = 1.0
    """Size of a pixel of a slice."""
    centre_sensor_px: tuple[float, float] | None = None
    """Row and column in the picture that the middle of the slice shows; absent: its middle."""
    frames: Annotated[int, Field(ge=1, le=1000)] = 4
    """Pictures that are averaged into one slice."""
    latency_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    """Longest delay between the exposure of a picture and its arrival."""
    stall_s: Positive = 2.0
    """No picture for this long means that the camera has stalled."""
    most_overexposed: Annotated[float, Field(ge=0, le=1)] = 0.005
    """Largest fraction of the picture's pixels that may be overexposed."""
    service_url: Annotated[str, Field(pattern=r"^https?://[^\s/]+")] = "http://127.0.0.1:8080"
    """The service, which says what to acquire next."""
    token_file: str = ""
    """File with the token that the service asks for; AUTOSPINE_TOKEN overrides it."""
    listener_host: str = "127.0.0.1"
    """Where slices are sent; the port and AE title are those of `[listener]`."""
    ae_title: AeTitle = "BENCHCAMERA"
    """Calling AE title, and the station's name."""
    poll_s: Positive = 0.05
    """How often the service is polled."""
    retry_s: Positive = 0.5
    """Wait after a failed delivery before the next attempt."""
    retries: Annotated[int, Field(ge=0)] = 120
    """Attempts after the first."""
    preview_port: Annotated[int, Field(ge=0, le=65535)] | None = 8090
    """Loopback port of the live preview with focus and exposure; 0: any, absent: none."""
