"""The reconstruction of a recorded measurement as a derived MR image."""

from __future__ import annotations

from pydicom.dataset import Dataset

from dicom_slice.geometry import SliceGeometry
from service.dicom_out.content import ReportContent
from service.dicom_out.derived import SERIES_SHARED, derived_image
from service.dicom_out.errors import OutputError
from service.dicom_out.identity import output_uid, series_uid, stamp
from service.dicom_out.source import tidy_patient
from service.room.images import load_reconstruction
from sr_engine.frames import whole
from sr_engine.reconstruction.reconstruct import Reconstruction
from sr_engine.reconstruction.shiftset import condition_number, noise_factor


def has_image(finding: ReportContent) -> bool:
    return bool(finding.result.get("reconstruction"))


def image_of(finding: ReportContent) -> Dataset:
    """The derived MR image; raises OutputError where the measurement has no reconstruction."""
    number = finding.measurement.measurement_id
    if not has_image(finding):
        raise OutputError(f"measurement {number} has no reconstruction")
    made = _reconstruction(finding)
    dataset = derived_image(made, fine_geometry(finding, made.factor), finding.files)
    tidy_patient(dataset)
    name = f"measurement-{number}-image"
    dataset.SOPInstanceUID = output_uid(finding, name)
    dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    of_the_series = [str(dataset.get(keyword, "")) for keyword in SERIES_SHARED]
    words = (str(made.factor), *of_the_series)
    dataset.SeriesInstanceUID = series_uid(finding, "image", dataset, *words)
    dataset.InstanceNumber = number
    stamp(dataset, finding, "image", f"AutoSPINe super-resolution x{made.factor} (research)")
    return dataset


def fine_geometry(finding: ReportContent, factor: int) -> SliceGeometry:
    """Of the reconstruction: it covers what its slices cover."""
    return finding.geometry.finer_grid(factor)


def _reconstruction(finding: ReportContent) -> Reconstruction:
    """As the worker made it, from the image and the shifts that the record keeps."""
    image = load_reconstruction(finding.case_dir, finding.result)
    shape = finding.geometry.shape
    factor = int(image.shape[0]) // shape[0]
    shifts_px = finding.shifts_px
    return Reconstruction(
        image=image,
        factor=factor,
        method="fourier",
        region=whole(shape),
        n_frames=len(finding.slices),
        condition_number=condition_number(shifts_px, factor),
        noise_factor=noise_factor(shifts_px, factor),
    )
