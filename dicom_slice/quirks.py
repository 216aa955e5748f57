"""What the vendors write in their own ways: the kind of an image, mosaics, private scales.

Every rule names the vendor and the element it rests on. Pure functions of the header.
"""

from enum import StrEnum

from dicom_slice.elements import Elements, FrameElements

MR_IMAGE = "1.2.840.10008.5.1.4.1.1.4"
ENHANCED_MR_IMAGE = "1.2.840.10008.5.1.4.1.1.4.1"
LEGACY_ENHANCED_MR_IMAGE = "1.2.840.10008.5.1.4.1.1.4.4"
SECONDARY_CAPTURE = "1.2.840.10008.5.1.4.1.1.7"
MR_CLASSES = (MR_IMAGE, ENHANCED_MR_IMAGE, LEGACY_ENHANCED_MR_IMAGE)

_GE_IMAGE_TYPE = (0x0043, 0x102F)
_GE_CREATOR_19, _GE_DURATION = (0x0019, 0x0010), (0x0019, 0x105A)
_SIEMENS_IMAGES_IN_MOSAIC = (0x0019, 0x100A)
_SIEMENS_CREATOR_19 = (0x0019, 0x0010)
_UIH_FRAMES = (0x0065, 0x1051)
_PHILIPS_FRAME = (0x2005, 0x140F)
_PHILIPS_SCALE_SLOPE = (0x2005, 0x100E)

_PHASE = {
    "P",
    "PHASE",
    "PHASE MAP",
    "PHASE_MAP",
    "P_FFE",
    "P_SE",
    "P_IR",
    "P_MIXED",
    "VELOCITY MAP",
}
_REAL = {"R", "REAL", "R_FFE", "R_SE", "R_IR"}
_IMAGINARY = {"I", "IMAGINARY", "I_FFE", "I_SE", "I_IR"}
_OTHER_MAPS = {"B0", "B0 MAP", "B1", "FIELD_MAP", "FIELDMAP", "FREQUENCY MAP", "UNSPECIFIED"}
_LOCALIZER_TITLES = ("localizer", "localiser", "locator", "scout", "survey", "3-plane", "3 plane")


_UNITS_APART = 30.0  # an estimate may be that far off, and seconds are still told from ms


class Kind(StrEnum):
    """What the pixels of a frame are."""

    MAGNITUDE = "magnitude"
    PHASE = "phase"
    REAL = "real"
    IMAGINARY = "imaginary"
    OTHER = "other"
    CAMERA = "camera"


def is_camera(sop_class: str, modality: str) -> bool:
    """A slice of the bench: a secondary capture that an external camera took (`bench`)."""
    return sop_class == SECONDARY_CAPTURE and modality == "XC"


def kind_of(frame: FrameElements, image_type: tuple[str, ...]) -> Kind:
    """Magnitude unless the header says otherwise."""
    if _kind_from_image_type(image_type) is Kind.OTHER:  # a B0 map calls its component REAL
        return Kind.OTHER
    component = frame.find(
        "MRImageFrameTypeSequence", lambda item: item.text("ComplexImageComponent")
    )
    if component:
        return {
            "MAGNITUDE": Kind.MAGNITUDE,
            "PHASE": Kind.PHASE,
            "REAL": Kind.REAL,
            "IMAGINARY": Kind.IMAGINARY,
        }.get(component.upper(), _kind_from_image_type(image_type))
    ge_kind = _ge_kind(frame.top)
    return ge_kind if ge_kind is not None else _kind_from_image_type(image_type)


def _kind_from_image_type(image_type: tuple[str, ...]) -> Kind:
    values = {value.upper() for value in image_type[2:]}
    for kind, names in (
        (Kind.OTHER, _OTHER_MAPS),
        (Kind.PHASE, _PHASE),
        (Kind.REAL, _REAL),
        (Kind.IMAGINARY, _IMAGINARY),
    ):
        if values & names:
            return kind
    return Kind.MAGNITUDE


def _ge_kind(top: Elements) -> Kind | None:
    """GE writes OTHER into ImageType and the kind into (0043,102F): 0 magnitude, 1 phase..."""
    if not top.text("Manufacturer").upper().startswith("GE"):
        return None
    value = top.integer(_GE_IMAGE_TYPE)
    kinds = {1: Kind.PHASE, 2: Kind.REAL, 3: Kind.IMAGINARY}
    return None if value is None else kinds.get(value, Kind.MAGNITUDE)


def ge_duration_s(top: Elements) -> float | None:
    """GE writes no AcquisitionDuration, but (0019,105A) in microseconds; None if absent."""
    if top.text(_GE_CREATOR_19) != "GEMS_ACQU_01":
        return None
    duration_us = top.number(_GE_DURATION)
    return duration_us / 1e6 if duration_us and duration_us > 0 else None


def whole_duration_s(top: Elements, estimated_s: float | None) -> float | None:
    """AcquisitionDuration, in seconds by the standard; UIH writes milliseconds.

    Beside what the sequence itself takes (estimated_s), a value of some other vendor that is a
    thousand times too long is in milliseconds, too, and one of UIH that fits as it is in seconds.
    """
    value = top.number("AcquisitionDuration")
    if value is None or not value > 0:
        return None
    in_ms = top.text("Manufacturer").upper().startswith("UIH")
    if estimated_s:
        fits_as_s, fits_as_ms = (
            1 / _UNITS_APART < v / estimated_s < _UNITS_APART for v in (value, value / 1000)
        )
        if fits_as_s != fits_as_ms:
            in_ms = fits_as_ms
    if not in_ms:
        return value
    top.warnings.append(f"AcquisitionDuration {value:g} was taken as milliseconds")
    return value / 1000


def is_mosaic(top: Elements, image_type: tuple[str, ...]) -> bool:
    """Several slices tiled into one: Siemens mosaics, and volumes that UIH saves as one object."""
    if {"MOSAIC", "VFRAME"} & {value.upper() for value in image_type}:
        return True
    if top.text("Manufacturer").upper() == "UIH" and top.raw(_UIH_FRAMES) is not None:
        return True
    if top.text(_SIEMENS_CREATOR_19) != "SIEMENS MR HEADER":
        return False
    tiles = top.raw(_SIEMENS_IMAGES_IN_MOSAIC)
    return tiles is not None and (top.integer(_SIEMENS_IMAGES_IN_MOSAIC) or 0) > 1


def is_localizer(image_type: tuple[str, ...], series_description: str) -> bool:
    if any(value.upper().startswith("LOCALI") for value in image_type):
        return True
    title = series_description.lower()
    return any(word in title for word in _LOCALIZER_TITLES)


def is_distortion_corrected(image_type: tuple[str, ...]) -> bool | None:
    """Siemens: DIS2D and DIS3D are corrected, ND is not. None: the header does not say."""
    values = {value.upper() for value in image_type}
    if {"DIS2D", "DIS3D"} & values:
        return True
    return False if "ND" in values else None


def philips_scale_slope(frame: FrameElements) -> float | None:
    """Scale slope of (2005,100E), in the frame's private group or at the top; None if absent.

    Philips stores floating-point values FP as stored = (FP x RS x SS - RI) / RS, so that
    FP = (stored x RS + RI) / (RS x SS).
    """
    if not frame.top.text("Manufacturer").upper().startswith("PHILIPS"):
        return None
    slope = frame.find(_PHILIPS_FRAME, lambda item: item.number(_PHILIPS_SCALE_SLOPE))
    return float(slope) if slope is not None and slope > 0 else None


def imaging_frequency_mhz(frame: FrameElements) -> float | None:
    """ImagingFrequency or TransmitterFrequency; UIH writes hertz where megahertz belong."""
    frequency = frame.find(
        "MRImagingModifierSequence", lambda item: item.number("TransmitterFrequency")
    ) or frame.top.number("ImagingFrequency")
    if not frequency or frequency <= 0:
        return None
    if frequency > 1e5:
        frame.top.warnings.append(f"ImagingFrequency {frequency:g} was taken as hertz")
        return float(frequency) / 1e6
    return float(frequency)
