"""`[service]`: the page, the API, the procedure."""

from typing import Literal

from pydantic import Field

from room_config.section import Section

Strategy = Literal["base", "bicubic", "sr", "hybrid", "adaptive"]


class ServiceConfig(Section):
    host: str = Field(default="127.0.0.1", description="Address of the page and the API.")
    port: int = Field(default=8080, ge=0, le=65535, description="0: any free port.")
    bridge_link: str = Field(
        min_length=1, description="Serial device or pyserial URL on which the bridge answers."
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
    max_iterations: int = Field(default=8, ge=1, description="Moves of one approach at the most.")
    shift_set: Literal["single", "quarter", "half", "lattice5", "paper"] = Field(
        default="quarter",
        description="Commanded shifts of one measurement when several are needed.",
    )
    confirm_moves: bool = Field(
        default=True, description="True: each approach move waits for the operator's CONFIRM MOVE."
    )
    prediction_gate_sigma: float = Field(
        default=5.0, gt=0, description="Refuse to go on when a move misses its prediction by more."
    )
    settle_s: float = Field(
        default=3.5,
        ge=0,
        description="Wait so long after a move before slices are asked for; must exceed the "
        "uncertainty of the scanner's clock, else slices cannot be proved to belong here.",
    )
    rescan_after_s: float = Field(
        default=60.0, gt=0, description="Ask for the slices again when none came for so long."
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
