"""A DICOM file -> one frozen `Slice` a frame. Everything needed is read here, once, early.

pydicom decodes lazily, so that a damaged value could surface anywhere later; here every element
that we ever use is touched, and what is wrong has a name before the slice goes any further.
"""

import warnings
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pydicom import dcmread
from pydicom.datadict import tag_for_keyword
from pydicom.dataset import Dataset, FileDataset
from pydicom.errors import InvalidDicomError
from pydicom.tag import Tag

from dicom_slice import quirks
from dicom_slice.bounds import check_bounds
from dicom_slice.elements import Elements, FrameElements, frame_elements
from dicom_slice.geometry import SliceGeometry, rounded_directions
from dicom_slice.patient import Identity, patient_digest
from dicom_slice.quirks import Kind
from dicom_slice.reasons import Reason, UnusableError
from dicom_slice.times import (
    AcquisitionInterval,
    ImplausibleTimeError,
    TimeFrame,
    acquisition_interval,
)

_LARGEST_SIDE_PX = 8192
_MOST_FRAMES = 1_000
_NO_TIME_FRAME = TimeFrame()


@dataclass(frozen=True)
class Rescale:
    """stored -> physical: slope x stored + intercept, then divided by `private_divisor`."""

    slope: float = 1.0
    intercept: float = 0.0
    private_divisor: float = 1.0


@dataclass(frozen=True)
class Slice:
    """One frame's header. `frame` is the index in its file, 0 first.

    interval None: no usable acquisition time; `time_problem` says why where there was one.
    geometry None: `geometry_problem` says why. No patient's name or number is kept.
    """

    sop_instance_uid: str
    sop_class_uid: str
    frame: int
    n_frames: int
    shape: tuple[int, int]
    geometry: SliceGeometry | None
    geometry_problem: str
    interval: AcquisitionInterval | None
    time_problem: str
    kind: Kind
    is_mosaic: bool
    is_localizer: bool
    distortion_corrected: bool | None
    image_type: tuple[str, ...]
    rescale: Rescale
    photometric: str
    samples_per_pixel: int
    has_pixels: bool
    series_instance_uid: str
    study_instance_uid: str
    frame_of_reference_uid: str
    series_number: int | None
    acquisition_number: int | None
    instance_number: int | None
    series_description: str
    slice_thickness_mm: float | None
    imaging_frequency_mhz: float | None
    pixel_bandwidth_hz: float | None
    phase_encoding_direction: str  # "ROW", "COL" or "" (unknown), as DICOM words it
    echo_time_ms: float | None
    scanner: str
    clock_synchronized: bool | None
    transfer_syntax_uid: str
    warnings: tuple[str, ...] = field(default=())
    patient_digest: str = ""  # tells patients apart, names nobody; empty: not known

    @property
    def acquisition_key(self) -> tuple[int, int]:
        """Grows from one acquisition of a study to the next; (-1, -1) where nothing is numbered."""
        series = -1 if self.series_number is None else self.series_number
        return (series, -1 if self.acquisition_number is None else self.acquisition_number)

    @property
    def identity(self) -> Identity:
        """Whom it shows, without who that is."""
        return Identity(self.patient_digest, self.study_instance_uid, self.frame_of_reference_uid)


def read_header(path: Path, times: TimeFrame = _NO_TIME_FRAME) -> list[Slice]:
    """Return one `Slice` a frame, frames in their order.

    Raises UnusableError with a reason where the file is no DICOM image of MR at all; what is wrong
    with single frames (mosaic, no geometry, no time...) stands in the slices.
    """
    data_set, noted = read_data_set(path)
    return slices_of(data_set, times, noted)


def read_data_set(path: Path) -> tuple[FileDataset, list[str]]:
    """The data set without its pixels, and the warnings that reading it gave."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data_set = dcmread_checked(path, stop_before_pixels=True)
    return data_set, [str(warning.message).splitlines()[0] for warning in caught]


def dcmread_checked(path: Path, **options: Any) -> FileDataset:
    """pydicom's dcmread; every way in which a file can be broken becomes an UnusableError."""
    if not path.is_file():
        raise UnusableError(Reason.NOT_DICOM, f"{path}: no such file")
    try:
        check_bounds(path)
        data_set = dcmread(path, force=not _is_part10(path), **options)
    except UnusableError:
        raise
    except (InvalidDicomError, EOFError) as error:
        raise UnusableError(Reason.NOT_DICOM, f"{path}: not DICOM ({error})") from error
    except OSError as error:
        raise UnusableError(Reason.UNREADABLE, f"{path}: cannot be read ({error})") from error
    except Exception as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UnusableError(Reason.UNREADABLE, f"{path}: damaged DICOM ({text})") from error
    if "SOPClassUID" not in data_set and "Rows" not in data_set and "Modality" not in data_set:
        raise UnusableError(Reason.NOT_DICOM, f"{path}: not DICOM{_what_else(path)}")
    return data_set


def _is_part10(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _what_else(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(2)
    if start == b"\x1f\x8b":
        return " (a gzip archive; unpack it first)"
    return " (an empty file)" if not start else ""


def slices_of(
    data_set: Dataset, times: TimeFrame = _NO_TIME_FRAME, noted: list[str] | None = None
) -> list[Slice]:
    """As `read_header`, from a data set in memory."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            slices = _slices_of(data_set, times, noted or [])
        except UnusableError:
            raise
        except Exception as error:  # whatever pydicom raises for a damaged element
            text = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UnusableError(Reason.UNREADABLE, f"damaged header ({text})") from error
    late = tuple(dict.fromkeys(str(warning.message).splitlines()[0] for warning in caught))
    if not late:
        return slices
    return [_with_warnings(slice_, late) for slice_ in slices]


def _with_warnings(slice_: Slice, late: tuple[str, ...]) -> Slice:
    values = {name: getattr(slice_, name) for name in slice_.__dataclass_fields__}
    return Slice(**{**values, "warnings": (*slice_.warnings, *late)})


def _slices_of(data_set: Dataset, times: TimeFrame, noted: list[str]) -> list[Slice]:
    top = Elements(data_set, list(noted))
    sop_class, modality = top.text("SOPClassUID"), top.text("Modality").upper()
    _check_is_mr(sop_class, modality)
    rows, cols = top.integer("Rows"), top.integer("Columns")
    if not rows or not cols:
        raise UnusableError(Reason.NO_PIXELS, "no pixels: Rows and Columns are missing")
    n_frames = top.integer("NumberOfFrames") or 1
    if not (0 < rows <= _LARGEST_SIDE_PX and 0 < cols <= _LARGEST_SIDE_PX):
        raise UnusableError(Reason.TOO_LARGE, f"implausible size: {rows} x {cols} pixels")
    if not 0 < n_frames <= _MOST_FRAMES:
        text = f"{n_frames} frames, 1 to {_MOST_FRAMES} are accepted"
        raise UnusableError(Reason.TOO_LARGE, text)
    return [_slice(top, frame, n_frames, (rows, cols), times) for frame in range(n_frames)]


def _check_is_mr(sop_class: str, modality: str) -> None:
    if sop_class in quirks.MR_CLASSES or (not sop_class and modality == "MR"):
        return
    if quirks.is_camera(sop_class, modality):
        return
    if sop_class.startswith("1.2.840.10008.5.1.4.1.1.7"):
        raise UnusableError(Reason.SCREEN_SAVE, "a secondary capture (screen save), not MR data")
    what = modality or sop_class or "an object without a modality"
    raise UnusableError(Reason.NOT_MR, f"not an MR image but {what}")


def _slice(
    top: Elements, index: int, n_frames: int, shape: tuple[int, int], times: TimeFrame
) -> Slice:
    frame = frame_elements(top, index)
    image_type = _image_type(frame)
    geometry, geometry_problem = _geometry(frame, shape)
    interval, time_problem = _interval(frame, times)
    description = top.text("SeriesDescription")
    return Slice(
        sop_instance_uid=top.text("SOPInstanceUID"),
        sop_class_uid=top.text("SOPClassUID"),
        frame=index,
        n_frames=n_frames,
        shape=shape,
        geometry=geometry,
        geometry_problem=geometry_problem,
        interval=interval,
        time_problem=time_problem,
        kind=_kind(frame, image_type),
        is_mosaic=quirks.is_mosaic(top, image_type),
        is_localizer=quirks.is_localizer(image_type, description),
        distortion_corrected=quirks.is_distortion_corrected(image_type),
        image_type=image_type,
        rescale=rescale_of(frame),
        photometric=top.text("PhotometricInterpretation"),
        samples_per_pixel=top.integer("SamplesPerPixel") or 1,
        has_pixels=bool(top.integer("BitsAllocated")),
        series_instance_uid=top.text("SeriesInstanceUID"),
        study_instance_uid=top.text("StudyInstanceUID"),
        frame_of_reference_uid=top.text("FrameOfReferenceUID"),
        series_number=top.integer("SeriesNumber"),
        acquisition_number=_acquisition_number(frame),
        instance_number=top.integer("InstanceNumber"),
        series_description=description,
        slice_thickness_mm=frame.find("PixelMeasuresSequence", _number("SliceThickness")),
        imaging_frequency_mhz=quirks.imaging_frequency_mhz(frame),
        pixel_bandwidth_hz=frame.find("MRImagingModifierSequence", _number("PixelBandwidth")),
        phase_encoding_direction=_phase_encoding(frame),
        echo_time_ms=frame.find("MREchoSequence", _number("EffectiveEchoTime"))
        or top.number("EchoTime"),
        scanner=" ".join(
            filter(None, map(top.text, ("Manufacturer", "StationName", "DeviceSerialNumber")))
        ),
        clock_synchronized={"Y": True, "N": False}.get(top.text("AcquisitionTimeSynchronized")),
        transfer_syntax_uid=_transfer_syntax(top.data_set),
        warnings=tuple(dict.fromkeys(top.warnings)),
        patient_digest=patient_digest(top),
    )


def _kind(frame: FrameElements, image_type: tuple[str, ...]) -> Kind:
    top = frame.top
    if quirks.is_camera(top.text("SOPClassUID"), top.text("Modality").upper()):
        return Kind.CAMERA
    return quirks.kind_of(frame, image_type)


def _number(keyword: str) -> Any:
    return lambda item: item.number(keyword)


def _image_type(frame: FrameElements) -> tuple[str, ...]:
    """FrameType of the frame where it has one (enhanced objects call the whole MIXED)."""
    found = frame.find("MRImageFrameTypeSequence", lambda item: item.texts("FrameType"))
    return found or frame.top.texts("ImageType")


_PLACES = {
    "ImagePositionPatient": ("PlanePositionSequence", 3),
    "ImageOrientationPatient": ("PlaneOrientationSequence", 6),
    "PixelSpacing": ("PixelMeasuresSequence", 2),
}


def _geometry(frame: FrameElements, shape: tuple[int, int]) -> tuple[SliceGeometry | None, str]:
    values, shown = {}, {}
    for name, (sequence, size) in _PLACES.items():
        values[name] = frame.find(sequence, partial(Elements.numbers, key=name)) or ()
        shown[name] = frame.find(sequence, partial(Elements.shown, key=name)) or ""
        if shown[name] and len(values[name]) != size:
            return None, _bad_value(name, shown[name], f"should be {size} numbers")
    missing = [name for name, value in values.items() if not value]
    if missing:
        return None, f"no {', '.join(missing)}"
    position, directions, spacing = values.values()
    try:
        orthonormal = rounded_directions(directions, shown["ImageOrientationPatient"])
        if orthonormal != directions:
            frame.top.warnings.append(
                f"ImageOrientationPatient is rounded: {shown['ImageOrientationPatient']}"
            )
        return SliceGeometry.from_header(position, orthonormal, spacing, shape), ""
    except ValueError as error:
        return None, f"{error} ({', '.join(f'{k} {v}' for k, v in shown.items())})"


def _bad_value(name: str, shown: str, what: str) -> str:
    tag = Tag(tag_for_keyword(name) or 0)
    return f"{name} ({tag.group:04X},{tag.element:04X}) {what}, is {shown!r}"


def _interval(frame: FrameElements, times: TimeFrame) -> tuple[AcquisitionInterval | None, str]:
    try:
        return acquisition_interval(frame, times), ""
    except ImplausibleTimeError as error:
        return None, str(error)


def rescale_of(frame: FrameElements) -> Rescale:
    slope = frame.find("PixelValueTransformationSequence", _number("RescaleSlope"))
    intercept = frame.find("PixelValueTransformationSequence", _number("RescaleIntercept"))
    if slope is not None and slope == 0:
        frame.top.warnings.append("RescaleSlope 0 was taken as 1")
        slope = None
    slope = 1.0 if slope is None else slope
    scale = quirks.philips_scale_slope(frame)
    divisor = 1.0 if scale is None else slope * scale
    return Rescale(slope, 0.0 if intercept is None else intercept, divisor)


def _acquisition_number(frame: FrameElements) -> int | None:
    found = frame.find("FrameContentSequence", lambda item: item.integer("FrameAcquisitionNumber"))
    return frame.top.integer("AcquisitionNumber") if found is None else found


def _phase_encoding(frame: FrameElements) -> str:
    text = frame.find(
        "MRFOVGeometrySequence", lambda item: item.text("InPlanePhaseEncodingDirection")
    )
    return {"ROW": "ROW", "COL": "COL", "COLUMN": "COL"}.get((text or "").upper(), "")


def _transfer_syntax(data_set: Dataset) -> str:
    meta = getattr(data_set, "file_meta", None)
    return str(meta.get("TransferSyntaxUID", "")) if meta is not None else ""
