"""`[imaging]`: what a usable slice looks like, and the fiducial in it."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from room_config.section import Section

Fraction = Annotated[float, Field(gt=0, le=1)]
_PARAMETERS = {"flat": 0, "hamming": 1, "fermi": 2, "elliptical": 0}


class PointSpreadConfig(Section):
    """`[imaging.point_spread]`: the filter that the scanner lays over k-space."""

    kind: Literal["flat", "hamming", "fermi", "elliptical"]
    parameters: tuple[float, ...] = Field(
        default=(),
        description="hamming: alpha; fermi: cutoff and width, in units of the highest frequency; "
        "empty: the usual values.",
    )
    acquired: tuple[Fraction, Fraction] = Field(
        default=(1.0, 1.0),
        description="Fraction of k-space (along rows, along columns) that is actually sampled, "
        "where the scanner zero-fills the rest.",
    )

    @model_validator(mode="after")
    def _complete(self) -> "PointSpreadConfig":
        wanted = _PARAMETERS[self.kind]
        if self.parameters and len(self.parameters) != wanted:
            raise ValueError(
                f"{self.kind} takes {wanted} parameter{'s' * (wanted != 1)}, got "
                f"{len(self.parameters)}"
            )
        return self


class ImagingConfig(Section):
    coronal_tolerance_deg: float = Field(
        default=10.0, gt=0, le=45, description="Largest angle between slice normal and ±y (LPS)."
    )
    distortion_corrected: bool | None = Field(
        default=None,
        description="Use only slices with (true) or without (false) the scanner's distortion "
        "correction; absent: as in the first slice used in a case.",
    )
    fiducial_radius_min_mm: float = Field(
        default=2.5, gt=0, description="Smallest radius at which the fiducial may appear."
    )
    fiducial_radius_max_mm: float = Field(
        default=6.5, gt=0, description="Largest radius at which the fiducial may appear."
    )
    start_region_px: tuple[float, float, float, float] | None = Field(
        default=None,
        description="Row and column bounds (r0, c0, r1, c1) of the search for the fiducial while "
        "its position is unknown; absent: the whole slice.",
    )
    position_gate_mm: float = Field(
        default=3.0,
        gt=0,
        description="A fiducial farther than this from its predicted position is refused.",
    )
    localization: Literal["template", "disc"] = Field(
        default="template",
        description="What is fitted to the fiducial once the calibration has shown it: its own "
        "image, whatever its shape, or a disc.",
    )
    point_spread: PointSpreadConfig | None = Field(
        default=None,
        description="The filter of the slices; absent: recognised for each series from the noise "
        "of its first slice.",
    )
    readout_polarity: Literal[-1, 0, 1] = Field(
        default=0,
        description="Where oil appears: 1 displaced towards higher pixel indices along the "
        "readout, -1 towards lower ones, 0 unknown; needed for targets in tissue.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> "ImagingConfig":
        if not self.fiducial_radius_min_mm < self.fiducial_radius_max_mm:
            raise ValueError("fiducial_radius_min_mm must be below fiducial_radius_max_mm")
        return self
