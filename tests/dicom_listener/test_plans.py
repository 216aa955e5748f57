"""Plans of workstations: points by label from three kinds of objects, in the right frame."""

import math
import time
from pathlib import Path

import numpy as np
import pytest
from highdicom.sr import (
    CodedConcept,
    Comprehensive3DSR,
    CoordinatesForMeasurement3D,
    Measurement,
    MeasurementReport,
    MeasurementsAndQualitativeEvaluations,
    ObservationContext,
    ObserverContext,
    PersonObserverIdentifyingAttributes,
    TrackingIdentifier,
)
from made_slices import begin_hold, mr_data_set
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.sr.codedict import codes
from pydicom.uid import ExplicitVRLittleEndian, generate_uid
from test_intake import Desk

FRAME = "1.2.826.0.1.4"
TARGET, ENTRY = (3.5, 12.25, -4.0), (4.0, -40.0, 8.0)
PRESENTATION = "1.2.840.10008.5.1.4.1.1.11.1"
FIDUCIALS = "1.2.840.10008.5.1.4.1.1.66.2"


@pytest.fixture
def desk(tmp_path: Path):
    desk = Desk(tmp_path)
    begin_hold(desk.record, time.time() - 5.0, expected=3)
    (row,) = desk.receive(mr_data_set("1.2.826.0.9", began_s=time.time() - 1))
    assert row.state == "assigned"
    yield desk
    desk.intake.close()
    desk.record.close()


def item(**elements) -> Dataset:
    made = Dataset()
    for keyword, value in elements.items():
        setattr(made, keyword, value)
    return made


def empty(sop_class: str, modality: str) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = sop_class
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    made = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    made.SOPClassUID, made.SOPInstanceUID = sop_class, meta.MediaStorageSOPInstanceUID
    made.Modality, made.Manufacturer = modality, "Planning Station"
    made.PatientID, made.PatientName = "secret-4711", "Doe^Jane"
    made.StudyInstanceUID, made.SeriesInstanceUID = "1.2.826.0.1.2", generate_uid()
    return made


def spatial_fiducials(*named: tuple[str, tuple[float, ...]], frame: str = FRAME) -> FileDataset:
    made = empty(FIDUCIALS, "FID")
    made.ContentLabel = "PLAN"
    points = [
        item(FiducialIdentifier=name, ShapeType="POINT", ContourData=list(place))
        for name, place in named
    ]
    made.FiducialSetSequence = [item(FrameOfReferenceUID=frame, FiducialSequence=points)]
    return made


def presentation_state(image_uid: str = "1.2.826.0.9") -> FileDataset:
    """The target as a point of a layer, the entry as a text at its anchor; (column, row)."""
    made = empty(PRESENTATION, "PR")
    made.ContentLabel = "PLAN"
    image = item(
        ReferencedSOPClassUID="1.2.840.10008.5.1.4.1.1.4", ReferencedSOPInstanceUID=image_uid
    )
    made.ReferencedSeriesSequence = [item(ReferencedImageSequence=[image])]
    point = item(
        GraphicAnnotationUnits="PIXEL", GraphicDimensions=2, NumberOfGraphicPoints=1,
        GraphicData=[10.5, 20.5], GraphicType="POINT",
    )  # fmt: skip
    text = item(
        UnformattedTextValue="Entry point", AnchorPoint=[12.5, 4.5],
        AnchorPointAnnotationUnits="PIXEL",
    )  # fmt: skip
    made.GraphicAnnotationSequence = [
        item(GraphicLayer="TARGET", GraphicObjectSequence=[point]),
        item(GraphicLayer="NOTES", TextObjectSequence=[text]),
    ]
    return made


def report(desk: Desk, *named: tuple[str, tuple[float, ...]]) -> Dataset:
    """TID 1500 by highdicom: a group a point, named by its tracking identifier."""
    image = mr_data_set("1.2.826.0.9")
    image.AccessionNumber = image.StudyID = image.PatientBirthDate = image.PatientSex = ""
    image.StudyDate = image.StudyTime = image.ReferringPhysicianName = ""
    groups = [
        MeasurementsAndQualitativeEvaluations(
            tracking_identifier=TrackingIdentifier(uid=generate_uid(), identifier=name),
            measurements=[
                Measurement(
                    name=CodedConcept("depth", "99TEST", "Depth"),
                    value=1.0,
                    unit=codes.UCUM.Millimeter,
                    referenced_coordinates=[
                        CoordinatesForMeasurement3D("POINT", np.array([place]), FRAME)
                    ],
                )
            ],
        )
        for name, place in named
    ]
    observer = ObserverContext(
        observer_type=codes.DCM.Person,
        observer_identifying_attributes=PersonObserverIdentifyingAttributes(name="Planner^A"),
    )
    content = MeasurementReport(
        observation_context=ObservationContext(observer_person_context=observer),
        procedure_reported=codes.SCT.ImagingGuidance,
        imaging_measurements=groups,
        title=codes.DCM.ImagingMeasurementReport,
        referenced_images=[image],
    )
    return Comprehensive3DSR(
        evidence=[image], content=content[0], series_instance_uid=generate_uid(),
        series_number=7, sop_instance_uid=generate_uid(), instance_number=1,
        manufacturer="Planning Station",
    )  # fmt: skip


def noted(desk: Desk, data: Dataset) -> dict:
    desk.receive(data, sop_class_uid=str(data.SOPClassUID))
    events = desk.record.events_of_kind("plan_received")
    return dict(events[-1].body) if events else {}


def test_spatial_fiducials_are_taken_by_name_in_their_frame_of_reference(desk):
    body = noted(desk, spatial_fiducials(("ENTRY", ENTRY), ("F1", (0, 0, 0)), ("TARGET", TARGET)))
    assert body["target_mm"] == pytest.approx(TARGET)
    assert body["entry_mm"] == pytest.approx(ENTRY)
    assert body["frame_of_reference_uid"] == FRAME
    assert (body["sender"], body["via"]) == ("SCANNER 127.0.0.1", "DICOM Spatial Fiducials")


def test_a_presentation_state_is_placed_by_the_slice_that_it_is_drawn_on(desk):
    """Pixel (row 20, column 10): 10 mm to the left of the first one's centre, 20 mm down."""
    body = noted(desk, presentation_state())
    assert body["target_mm"] == pytest.approx([-20 + 10, 10, 24 - 20])
    assert body["entry_mm"] == pytest.approx([-20 + 12, 10, 24 - 4])
    assert body["frame_of_reference_uid"] == FRAME


def test_a_measurement_report_names_its_points_by_tracking_identifier(desk):
    body = noted(desk, report(desk, ("Entry", ENTRY), ("Target", TARGET)))
    assert body["target_mm"] == pytest.approx(TARGET, abs=1e-4)
    assert body["entry_mm"] == pytest.approx(ENTRY, abs=1e-4)
    assert body["frame_of_reference_uid"] == FRAME


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (presentation_state("9.9.9"), "on an image that is not in this case"),
        (spatial_fiducials(("TARGET", TARGET), ("Target", ENTRY)), "2 points are labelled TARGET"),
        (spatial_fiducials(("TARGET", (1.0, math.nan, 3.0))), "TARGET is not three finite numbers"),
        (spatial_fiducials(("ENTRY", (math.inf, 2.0, 3.0))), "ENTRY is not three finite numbers"),
    ],
)
def test_why_a_plan_cannot_be_placed_is_said(desk, made, why):
    assert why in noted(desk, made)["why"]


def test_what_has_no_label_or_is_our_own_is_no_plan(desk):
    own = spatial_fiducials(("TARGET", TARGET))
    own.Manufacturer = "AutoSPINe Navigator"
    for made in (spatial_fiducials(("F1", TARGET)), own, empty(PRESENTATION, "PR")):
        assert noted(desk, made) == {}


@pytest.mark.parametrize("place", [["a", "b", "c"], [1.0, 2.0], [1e308, 0, 0]])
def test_a_damaged_plan_is_kept_and_set_aside_like_any_other_file(desk, place):
    made = spatial_fiducials(("TARGET", TARGET))
    made.FiducialSetSequence[0].FiducialSequence[0].ContourData = [1.0, 2.0, 3.0]
    data = desk.encoded(made).replace(
        b"1.0\\2.0\\3.0", "\\".join(map(str, place)).encode()[:11].ljust(11)
    )
    rows = desk.receive(data, sop_class_uid=FIDUCIALS)
    assert [row.state for row in rows] == ["quarantined"]
