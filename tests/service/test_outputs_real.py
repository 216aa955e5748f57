"""Reports and presentation states over slices of real scanners, classic and multi-frame."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pydicom
import pytest
from real_slices import DICOM, IS_LARGE_SET, manifest

from case_record.rows import Measurement, SliceRow
from dicom_listener.slice_rows import header_for_record
from dicom_slice.header import Slice, read_header
from dicom_slice.reasons import UnusableError
from service.dicom_out.content import Distance, ReportContent
from service.dicom_out.errors import OutputError
from service.dicom_out.make import Output, dataset_of

CENTRE_PX = (40.25, 51.5)
# a code for the de-identification, a patient's age that is none, a body part that is none of the
# standard's: they are handed on as they are
SOURCES_OWN_FAULTS = ("(0012,0064)", "(0010,1010)", "(0018,0015)")

# pydicom's, about values that scanners have written
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def slices_of_all_scanners() -> Iterator[tuple[Path, Slice]]:
    """The last frame of one file of each folder, where it says where it lies."""
    seen = set()
    paths = [DICOM / row["path"] for row in manifest()]
    for path in paths:
        if path.parent in seen:
            continue
        try:
            header = read_header(path)[-1]
        except UnusableError:
            continue
        if header.geometry is not None:
            seen.add(path.parent)
            yield path, header


def finding_in(path: Path, header: Slice) -> ReportContent:
    """As if a fiducial had been found at CENTRE_PX."""
    assert header.geometry is not None
    row = SliceRow(
        sop_instance_uid=header.sop_instance_uid,
        frame=header.frame,
        sha256="",
        path=str(path),
        state="assigned",
        hold_id=1,
        reason_code="",
        reason="",
        received_s=0.0,
        received_monotonic_s=0.0,
        acquired_from_s=0.0,
        acquired_to_s=0.0,
        time_source="",
        header=header_for_record(header),
        slice_id=1,
    )
    result = {
        "slice_id": 1,
        "slice_ids": [1],
        "centre_px": list(CENTRE_PX),
        "patient_mm": header.geometry.patient_from_pixel(CENTRE_PX).tolist(),
        "plane_mm": [1.0, 2.0],
        "covariance_mm2": [[1e-4, 0.0], [0.0, 1e-4]],
        "radius_px": 4.0,
        "snr": 10.0,
        "chi2_per_dof": 1.0,
        "n_frames": 1,
    }
    now_s = time.time()
    measurement = Measurement(1, "done", "ml", (1,), {}, now_s, now_s, result, "", "")
    return ReportContent(
        case_dir=DICOM,
        case_uid="a case",
        measurement=measurement,
        result=result,
        slices=(row,),
        files=(path,),
        must_be_plane_mm=np.array([1.5, 2.5]),
        distance=Distance("fiducial", 0.7, 0.01),
    )


@pytest.mark.parametrize("kind", ["report", "presentation"])
def test_outputs_over_real_slices_are_made_and_keep_to_the_standard(kind):
    sys.path.insert(0, str(Path(__file__).parents[1] / "simulator"))
    try:
        from dicom_standard import violations
    finally:
        sys.path.pop(0)
    made, frames = 0, set()
    for path, header in slices_of_all_scanners():
        finding = finding_in(path, header)
        output = Output("measurement", 1, kind)
        if kind == "report" and not header.frame_of_reference_uid:
            with pytest.raises(OutputError, match="has no FrameOfReferenceUID"):
                dataset_of(finding, output)
            continue
        dataset = dataset_of(finding, output)
        buffer = io.BytesIO()
        dataset.save_as(buffer, enforce_file_format=True)
        buffer.seek(0)
        read = pydicom.dcmread(buffer)
        assert read.StudyInstanceUID == header.study_instance_uid, path
        beside = ("sr-document-content", *SOURCES_OWN_FAULTS)
        assert [v for v in violations(read) if not any(b in v for b in beside)] == [], path
        if kind == "presentation":
            check_drawing(read, header)
        made += 1
        frames.add(header.n_frames > 1)
    assert made > (30 if IS_LARGE_SET else 10)
    assert frames == {True, False}, "classic and multi-frame"


def check_drawing(state: pydicom.Dataset, header: Slice) -> None:
    (reference,) = state.ReferencedSeriesSequence[0].ReferencedImageSequence
    assert reference.ReferencedSOPInstanceUID == header.sop_instance_uid
    annotation = state.GraphicAnnotationSequence[0]
    if header.n_frames > 1:
        (image,) = annotation.ReferencedImageSequence
        assert image.ReferencedFrameNumber == header.frame + 1
    circle = np.array(annotation.GraphicObjectSequence[0].GraphicData[:2])
    assert circle == pytest.approx([CENTRE_PX[1] + 0.5, CENTRE_PX[0] + 0.5], abs=1e-3)
