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
from test_intake import Desk, enhanced

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


ON_SLICE = [-20 + 10, 10, 24 - 20]  # where presentation_state() has its target
NO_FRAME_NO_IMAGE = spatial_fiducials(("TARGET", TARGET), frame="")


def reference(uid: str = "1.2.826.0.9", **more) -> Dataset:
    return item(
        ReferencedSOPClassUID="1.2.840.10008.5.1.4.1.1.4", ReferencedSOPInstanceUID=uid, **more
    )


def fiducial_on_image(*images: Dataset, **more) -> FileDataset:
    """A point of Spatial Fiducials that has a column and a row, no place in space."""
    made = spatial_fiducials(("Target 1", TARGET), frame="")
    (point,) = made.FiducialSetSequence[0].FiducialSequence
    del point.ContourData
    at = item(GraphicData=[10.5, 20.5], ReferencedImageSequence=list(images))
    point.GraphicCoordinatesDataSequence = [at]
    for keyword, value in more.items():
        setattr(point, keyword, value)
    return made


def in_images_frame(*uids: str) -> FileDataset:
    """Coordinates in space, whose frame of reference is that of images."""
    made = spatial_fiducials(("TARGET", TARGET), frame="")
    del made.FiducialSetSequence[0].FrameOfReferenceUID
    made.FiducialSetSequence[0].ReferencedImageSequence = [reference(uid) for uid in uids]
    return made


def content(*items: Dataset) -> FileDataset:
    made = empty("1.2.840.10008.5.1.4.1.1.88.34", "SR")
    made.ContentSequence = list(items)
    return made


def coordinates(kind: str, data: list[float], *inner: Dataset, **more) -> Dataset:
    value_type = "SCOORD" if len(data) == 2 or kind == "CIRCLE" else "SCOORD3D"
    name = [item(CodeValue="1", CodingSchemeDesignator="99TEST", CodeMeaning="TARGET")]
    return item(
        RelationshipType="CONTAINS", ValueType=value_type, ConceptNameCodeSequence=name,
        GraphicType=kind, GraphicData=data, ContentSequence=list(inner), **more,
    )  # fmt: skip


def image_item(uid: str = "1.2.826.0.9") -> Dataset:
    return item(
        RelationshipType="SELECTED FROM", ValueType="IMAGE", ReferencedSOPSequence=[reference(uid)]
    )


def by_reference(*place: int) -> Dataset:
    return item(RelationshipType="SELECTED FROM", ReferencedContentItemIdentifier=list(place))


@pytest.mark.parametrize(
    ("made", "place"),
    [
        (fiducial_on_image(reference()), ON_SLICE),
        (fiducial_on_image(reference(ReferencedFrameNumber=1)), ON_SLICE),
        (in_images_frame("1.2.826.0.9"), TARGET),
        (content(coordinates("POINT", [10.5, 20.5], image_item())), ON_SLICE),
        (content(image_item(), coordinates("POINT", [10.5, 20.5], by_reference(1, 1))), ON_SLICE),
        (content(coordinates("MULTIPOINT", [10.5, 20.5], image_item())), ON_SLICE),
        (content(coordinates("MULTIPOINT", list(TARGET), image_item())), TARGET),
        (
            content(coordinates("POINT", list(TARGET), ReferencedFrameOfReferenceUID=FRAME)),
            TARGET,
        ),
    ],
    ids=[
        "fiducial on an image", "on its only frame", "frame of the images", "SCOORD",
        "SCOORD by reference", "SCOORD of one point", "SCOORD3D of one point", "SCOORD3D",
    ],
)  # fmt: skip
def test_every_way_to_say_one_point_is_read_in_the_cases_frame_of_reference(desk, made, place):
    body = noted(desk, made)
    assert body.get("target_mm") == pytest.approx(place), body
    assert body["frame_of_reference_uid"] == FRAME


@pytest.mark.parametrize("name", ["TARGET 1", "Target", "target_2", "Target-1", "TARGET POINT 1"])
def test_a_number_or_the_case_of_its_letters_do_not_hide_a_label(desk, name):
    assert noted(desk, spatial_fiducials((name, TARGET)))["target_mm"] == pytest.approx(TARGET)


@pytest.mark.parametrize("name", ["TARGETED BIOPSY", "no target", "entry 1 of 2", "TARGET 1234"])
def test_what_only_speaks_of_a_target_is_none(desk, name):
    assert noted(desk, spatial_fiducials((name, TARGET))) == {}


def in_display_units() -> FileDataset:
    made = presentation_state()
    del made.GraphicAnnotationSequence[1]
    made.GraphicAnnotationSequence[0].GraphicObjectSequence[0].GraphicAnnotationUnits = "DISPLAY"
    return made


def over_two_images() -> FileDataset:
    made = presentation_state()
    made.ReferencedSeriesSequence[0].ReferencedImageSequence.append(reference("1.2.826.0.10"))
    return made


def outside_of_the_image() -> FileDataset:
    made = fiducial_on_image(reference())
    (point,) = made.FiducialSetSequence[0].FiducialSequence
    point.GraphicCoordinatesDataSequence[0].GraphicData = [900.0, 20.5]
    return made


def text_away_from_the_point() -> FileDataset:
    """All drawings of an image in one item, as some viewers store them."""
    made = presentation_state()
    target, entry = made.GraphicAnnotationSequence
    target.GraphicLayer = "DRAWN"
    (text,) = entry.TextObjectSequence
    text.UnformattedTextValue = "TARGET"
    target.TextObjectSequence = [text]
    del made.GraphicAnnotationSequence[1]
    return made


def graphic(kind: str, data: list[float]) -> Dataset:
    return item(
        GraphicAnnotationUnits="PIXEL", GraphicDimensions=2, NumberOfGraphicPoints=len(data) // 2,
        GraphicData=data, GraphicType=kind,
    )  # fmt: skip


def text(word: str, at: list[float] | None = None) -> Dataset:
    if at is None:
        return item(UnformattedTextValue=word)
    return item(UnformattedTextValue=word, AnchorPoint=at, AnchorPointAnnotationUnits="PIXEL")


def drawn(*inside: Dataset, layer: str = "DRAWN") -> FileDataset:
    """Graphics and texts in one annotation."""
    made = presentation_state()
    texts = [one for one in inside if "UnformattedTextValue" in one]
    graphics = [one for one in inside if "GraphicType" in one]
    made.GraphicAnnotationSequence = [
        item(GraphicLayer=layer, GraphicObjectSequence=graphics, TextObjectSequence=texts)
    ]
    return made


CIRCLE = graphic("CIRCLE", [10.5, 20.5, 16.5, 20.5])  # around ON_SLICE, 6 pixels
OTHER_CIRCLE = graphic("CIRCLE", [12.5, 4.5, 12.5, 1.5])
ELSEWHERE = graphic("POINT", [30.5, 30.5])


@pytest.mark.parametrize(
    "made",
    [
        drawn(CIRCLE, text("TARGET")),
        drawn(CIRCLE, text("TARGET", [16.5, 21.5])),
        drawn(CIRCLE, layer="TARGET"),
        drawn(CIRCLE, text("TARGET", [14.5, 24.5]), OTHER_CIRCLE, text("ENTRY", [12.5, 3.5])),
        drawn(CIRCLE, graphic("POINT", [10.5, 20.5]), text("TARGET", [11.5, 20.5])),
        drawn(graphic("POINT", [10.5, 20.5]), OTHER_CIRCLE, layer="TARGET"),
        content(coordinates("CIRCLE", [10.5, 20.5, 16.5, 20.5], image_item())),
        content(
            coordinates("CIRCLE", [12.5, 4.5, 12.5, 1.5], image_item()),
            coordinates("POINT", [10.5, 20.5], image_item()),
        ),
    ],
    ids=[
        "beside a word", "word at its rim", "in a layer", "two of them", "around a point",
        "a point first", "in a report", "in a report a point first",
    ],
)  # fmt: skip
def test_a_circle_means_its_centre_and_a_point_outranks_it(desk, made):
    body = noted(desk, made)
    assert body.get("target_mm") == pytest.approx(ON_SLICE), body


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (drawn(CIRCLE, text("TARGET", [30.5, 30.5])), "text at one place and a CIRCLE at another"),
        (drawn(CIRCLE, OTHER_CIRCLE, text("TARGET")), "2 points are labelled TARGET"),
        (drawn(CIRCLE, text("TARGET"), text("ENTRY")), "TARGET is a text that points at nothing"),
        (
            drawn(ELSEWHERE, text("TARGET", [9.5, 9.5]), text("ENTRY", [30.5, 30.5])),
            "its TARGET has",
        ),
        (
            drawn(graphic("ELLIPSE", [8, 20, 12, 20, 10, 18, 10, 22]), text("TARGET", [8.5, 20.5])),
            "text at one place and a ELLIPSE at another",
        ),
        (drawn(graphic("POLYLINE", [1, 1, 9, 9]), layer="TARGET"), "is a POLYLINE, not a POINT or"),
    ],
)
def test_a_drawing_that_may_mean_this_or_that_is_refused(desk, made, why):
    body = noted(desk, made)
    assert why in body.get("why", ""), body
    assert "target_mm" not in body


def report_of_loops() -> FileDataset:
    """Every item below refers to the whole again."""
    inner = [by_reference(1) for _ in range(40)]
    return content(coordinates("POINT", list(TARGET), *inner))


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (NO_FRAME_NO_IMAGE, "TARGET has no frame of reference and names no image"),
        (in_images_frame("1.2.826.0.9", "9.9.9"), "on an image that is not in this case"),
        (content(coordinates("POINT", list(TARGET))), "TARGET has no frame of reference"),
        (in_display_units(), "TARGET is given in DISPLAY units"),
        (over_two_images(), "TARGET is drawn on 2 images"),
        (fiducial_on_image(reference(), reference("9.9")), "TARGET is drawn on 2 images"),
        (fiducial_on_image(reference(ReferencedFrameNumber=[1, 2])), "TARGET is drawn on 2 frames"),
        (fiducial_on_image(reference(), ShapeType="LINE"), "TARGET is a LINE, not a POINT"),
        (content(coordinates("MULTIPOINT", [*TARGET, *ENTRY])), "TARGET is a MULTIPOINT of 6"),
        (content(coordinates("POINT", [1.0, 2.0])), "TARGET is drawn on no image"),
        (content(coordinates("POINT", [1.0, 2.0], by_reference(1, 7))), "drawn on no image"),
        (outside_of_the_image(), "TARGET lies outside its image"),
        (text_away_from_the_point(), "TARGET has its text at one place and a POINT at another"),
        (report_of_loops(), "it is damaged"),
    ],
)
def test_a_point_of_which_nobody_can_tell_where_it_is_is_refused_with_the_reason(desk, made, why):
    body = noted(desk, made)
    assert why in body.get("why", ""), body
    assert "target_mm" not in body


def test_a_point_on_a_slice_that_does_not_belong_to_the_case_is_refused(desk):
    other = mr_data_set("1.2.826.0.77", began_s=time.time() - 1)
    other.FrameOfReferenceUID = "1.2.826.0.55"
    (row,) = desk.receive(other)
    assert row.reason_code == "other_frame_of_reference"
    assert "does not belong to this case" in noted(desk, presentation_state("1.2.826.0.77"))["why"]


def test_of_a_slice_without_a_frame_of_reference_it_is_said_which_one_it_was(desk):
    unnamed = mr_data_set("1.2.826.0.79", began_s=time.time() - 1)
    del unnamed.FrameOfReferenceUID
    (row,) = desk.receive(unnamed)
    assert row.state == "assigned"
    body = noted(desk, presentation_state("1.2.826.0.79"))
    assert (body["frame_of_reference_uid"], body["slice_ids"]) == ("", [row.slice_id])


def test_a_point_on_an_image_of_several_frames_names_the_frame(desk):
    rows = desk.receive(enhanced(3, time.time() - 1))
    assert [row.frame for row in rows] == [0, 1, 2]
    body = noted(desk, presentation_state("1.2.826.0.5"))
    assert "an image of several frames and names none of them" in body["why"]


def test_a_point_on_a_mosaic_has_no_place(desk):
    mosaic = mr_data_set("1.2.826.0.78", began_s=time.time() - 1)
    mosaic.ImageType = ["ORIGINAL", "PRIMARY", "M", "MOSAIC"]
    (row,) = desk.receive(mosaic)
    assert row.reason_code == "mosaic"
    assert "lies on a mosaic" in noted(desk, presentation_state("1.2.826.0.78"))["why"]


def test_a_word_beside_a_point_names_it_and_a_word_alone_needs_an_anchor(desk):
    made = presentation_state()
    target, entry = made.GraphicAnnotationSequence
    target.GraphicLayer = "DRAWN"
    target.TextObjectSequence = [item(UnformattedTextValue="TARGET 1")]
    del entry.TextObjectSequence[0].AnchorPoint
    body = noted(desk, made)
    assert body["why"] == "its ENTRY is a text that points at nothing"
    del made.GraphicAnnotationSequence[1]
    made.SOPInstanceUID = made.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    assert noted(desk, made)["target_mm"] == pytest.approx(ON_SLICE)


@pytest.mark.parametrize("place", [["a", "b", "c"], [1.0, 2.0], [1e308, 0, 0]])
def test_a_damaged_plan_is_kept_and_set_aside_like_any_other_file(desk, place):
    made = spatial_fiducials(("TARGET", TARGET))
    made.FiducialSetSequence[0].FiducialSequence[0].ContourData = [1.0, 2.0, 3.0]
    data = desk.encoded(made).replace(
        b"1.0\\2.0\\3.0", "\\".join(map(str, place)).encode()[:11].ljust(11)
    )
    rows = desk.receive(data, sop_class_uid=FIDUCIALS)
    assert [row.state for row in rows] == ["quarantined"]
