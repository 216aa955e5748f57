"""Which slices may be used at all, before any question of holds: reasons by name."""

from dataclasses import dataclass

from dicom_slice.header import Slice
from dicom_slice.quirks import Kind
from dicom_slice.reasons import Reason, SetAside

_NOT_MAGNITUDE = {
    Kind.PHASE: Reason.PHASE,
    Kind.REAL: Reason.REAL,
    Kind.IMAGINARY: Reason.IMAGINARY,
    Kind.OTHER: Reason.NOT_MAGNITUDE,
}


@dataclass(frozen=True)
class SliceRules:
    """What a room accepts. coronal_tolerance_deg None: any orientation.

    most_pixels: of one slice; the engine's time and memory grow with them.
    distortion_corrected: None accepts either; within a case they are never mixed (`assign`).
    """

    coronal_tolerance_deg: float | None = 10.0
    allow_real: bool = False
    allow_derived: bool = False
    allow_localizer: bool = False
    allow_camera: bool = False
    need_geometry: bool = True
    distortion_corrected: bool | None = None
    most_pixels: int | None = 2048**2


#: For files that a person named by hand: any orientation, derived and real images too.
BY_HAND = SliceRules(
    coronal_tolerance_deg=None,
    allow_real=True,
    allow_derived=True,
    allow_localizer=True,
    allow_camera=True,
    need_geometry=False,
    most_pixels=None,
)


def why_not_usable(slice_: Slice, rules: SliceRules) -> SetAside | None:
    """Return the first reason against the slice, or None where it may be used."""
    checks = (_wrong_pixels, _wrong_kind, _wrong_geometry)
    return next((reason for check in checks if (reason := check(slice_, rules))), None)


def _wrong_pixels(slice_: Slice, rules: SliceRules) -> SetAside | None:
    if slice_.samples_per_pixel != 1:
        return SetAside(Reason.COLOUR, f"{slice_.samples_per_pixel} samples per pixel: colour")
    if slice_.photometric.startswith("PALETTE"):
        return SetAside(Reason.COLOUR, "palette colour: the pixels are numbers of colours")
    rows, cols = slice_.shape
    if rules.most_pixels is not None and rows * cols > rules.most_pixels:
        text = f"{rows} x {cols} pixels, at most {rules.most_pixels} are used"
        return SetAside(Reason.TOO_LARGE, text)
    if not slice_.has_pixels:
        return SetAside(Reason.NO_PIXELS, "no pixels")
    return None


def _wrong_kind(slice_: Slice, rules: SliceRules) -> SetAside | None:
    image_type = "\\".join(slice_.image_type)
    if slice_.kind is Kind.CAMERA:
        if rules.allow_camera:
            return None
        text = "a camera's picture; [listener] camera_slices = true accepts them"
        return SetAside(Reason.NOT_MR, text)
    if slice_.is_mosaic:
        return SetAside(Reason.MOSAIC, f"a mosaic of several slices ({image_type})")
    if any(value.upper() == "SCREEN SAVE" for value in slice_.image_type):
        return SetAside(Reason.SCREEN_SAVE, f"a screen save ({image_type})")
    wanted = rules.distortion_corrected
    if wanted is not None and slice_.distortion_corrected != wanted:
        word = "with" if slice_.distortion_corrected else "without"
        return SetAside(Reason.DISTORTION_TWIN, f"{word} distortion correction ({image_type})")
    if slice_.is_localizer and not rules.allow_localizer:
        title = slice_.series_description or image_type
        return SetAside(Reason.LOCALIZER, f"a localizer ({title})")
    is_derived = bool(slice_.image_type) and slice_.image_type[0].upper() == "DERIVED"
    if is_derived and not rules.allow_derived:
        return SetAside(Reason.DERIVED, f"a derived image ({image_type})")
    if slice_.kind is Kind.MAGNITUDE or (slice_.kind is Kind.REAL and rules.allow_real):
        return None
    return SetAside(
        _NOT_MAGNITUDE[slice_.kind], f"{slice_.kind} instead of magnitude ({image_type})"
    )


def _wrong_geometry(slice_: Slice, rules: SliceRules) -> SetAside | None:
    if slice_.geometry is None:
        if not rules.need_geometry:
            return None
        is_absent = slice_.geometry_problem.startswith("no ")
        code = Reason.NO_GEOMETRY if is_absent else Reason.BAD_GEOMETRY
        return SetAside(code, slice_.geometry_problem)
    if rules.coronal_tolerance_deg is None:
        return None
    angle_deg = slice_.geometry.angle_to_coronal_deg
    if not angle_deg <= rules.coronal_tolerance_deg:
        return SetAside(
            Reason.WRONG_ORIENTATION,
            f"{angle_deg:.1f} degrees from coronal, {rules.coronal_tolerance_deg:g} are allowed",
        )
    return None
