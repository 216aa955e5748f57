"""DICOM outputs say what the record says, are what the standard asks for, and are made once."""

import io
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from highdicom.sr import Comprehensive3DSR
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.sr.codedict import codes
from pydicom.uid import ExplicitVRLittleEndian
from receivers import needs_program
from recorded_case import OFFSET_MM, TOLERANCE_MM, come_to_ready, make_case, puncture

from case_record.record import CaseRecord, CaseRecordError
from case_record.seal_chain import TamperedError
from service.cli.export import write_export
from service.dicom_out.codes import CENTRE, CENTRE_ALONG, DEPTH, DISTANCE, PROBABILITY, TOLERANCE
from service.dicom_out.content import finding_of_arrival, finding_of_measurement
from service.dicom_out.errors import OutputError
from service.dicom_out.make import (
    Output,
    dataset_of,
    encoded,
    make_output,
    output_of,
    outputs_to_send,
)
from service.room.images import reconstruction_pixels

READY_REPORT = Output("approach", 1, "report")
READY_PRESENTATION = Output("approach", 1, "presentation")


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CaseRecord]:
    """Measurement 1, then an approach with measurement 2 that came to READY, then a puncture."""
    with CaseRecord(make_case(tmp_path_factory.mktemp("outputs"))) as record:
        puncture(record, come_to_ready(record))
        yield record


def made(record: CaseRecord, output: Output) -> Dataset:
    return pydicom.dcmread(make_output(record, output))


def puncture_report(record: CaseRecord) -> Dataset:
    (event,) = record.events_of_kind("puncture")
    return made(record, Output("puncture", event.event_id, "report"))


def group_of(report: Dataset) -> list[Dataset]:
    """The content items of the measurement group."""
    (measurements,) = [
        item
        for item in report.ContentSequence
        if item.ConceptNameCodeSequence[0].CodeMeaning == "Imaging Measurements"
    ]
    (group,) = measurements.ContentSequence
    return list(group.ContentSequence)


def numbers(report: Dataset, name: Any, *, derived: bool = False) -> list[float]:
    """Values of the measurement with this name; derived: its standard deviation."""
    found = []
    for item in group_of(report):
        coded = item.ConceptNameCodeSequence[0]
        inner = [c.ValueType for c in item.get("ContentSequence", ())]
        if (coded.CodeValue, "CODE" in inner) == (name.value, derived):
            found.append(float(item.MeasuredValueSequence[0].NumericValue))
    return found


def points_3d(report: Dataset, graphic_type: str) -> list[np.ndarray]:
    return [
        np.array(inner.GraphicData).reshape(-1, 3)
        for item in group_of(report)
        for inner in item.get("ContentSequence", ())
        if inner.get("GraphicType") == graphic_type
    ]


def graphics(state: Dataset, layer: str) -> list[tuple[str, np.ndarray]]:
    return [
        (item.GraphicType, np.array(item.GraphicData).reshape(-1, 2))
        for annotation in state.GraphicAnnotationSequence
        if annotation.GraphicLayer == layer
        for item in annotation.GraphicObjectSequence
    ]


def words_of(state: Dataset) -> str:
    return "\n".join(
        text.UnformattedTextValue
        for annotation in state.GraphicAnnotationSequence
        for text in annotation.get("TextObjectSequence", ())
    )


# What stands in them


def test_the_report_holds_the_centre_its_standard_deviation_and_the_radius(record):
    report = made(record, READY_REPORT)
    result = record.measurement(2).result
    centre_mm = [numbers(report, name)[0] for name in CENTRE]
    assert centre_mm == pytest.approx(result["patient_mm"], abs=1e-6)
    (point,) = {tuple(p[0]) for p in points_3d(report, "POINT")}
    assert point == pytest.approx(result["patient_mm"], abs=1e-4)
    sigmas_mm = [numbers(report, name, derived=True)[0] for name in CENTRE_ALONG]
    assert sigmas_mm == pytest.approx(np.sqrt(np.diag(result["covariance_mm2"])), abs=1e-6)
    (radius_mm,) = numbers(report, codes.SCT.Radius)
    (rim,) = points_3d(report, "ELLIPSE")
    assert np.linalg.norm(rim - result["patient_mm"], axis=1) == pytest.approx(radius_mm, abs=1e-4)
    assert radius_mm == pytest.approx(finding_of_measurement(record, 2).radius_mm, abs=1e-6)


def test_the_report_of_a_ready_holds_its_error_and_probability(record):
    report = made(record, READY_REPORT)
    assert numbers(report, DISTANCE["fiducial"]) == [0.0214]
    assert numbers(report, DISTANCE["fiducial"], derived=True) == [0.0123]
    assert numbers(report, PROBABILITY) == [0.9876]
    assert numbers(report, TOLERANCE) == [TOLERANCE_MM]
    assert numbers(report, DEPTH) == []


def test_the_report_of_a_puncture_says_how_deep_and_who(record):
    report = puncture_report(record)
    assert numbers(report, DEPTH) == [42.5]
    (comment,) = [item.TextValue for item in group_of(report) if item.ValueType == "TEXT"][-1:]
    assert "Research software, not a medical device" in comment
    assert "puncture" in comment
    assert "Olga" in comment


def test_the_report_of_a_measurement_has_the_distance_by_it_alone(record):
    report = made(record, Output("measurement", 2, "report"))
    found = finding_of_measurement(record, 2)
    expected = np.linalg.norm(found.must_be_plane_mm - found.result["plane_mm"])
    assert numbers(report, DISTANCE["fiducial"]) == pytest.approx([expected], abs=1e-6)
    assert numbers(report, PROBABILITY)[0] < 0.01, "the target is more than a millimetre away"


def test_a_measurement_without_a_target_has_no_distance_in_its_report(record):
    report = made(record, Output("measurement", 1, "report"))
    assert numbers(report, DISTANCE["fiducial"]) == []
    assert numbers(report, PROBABILITY) == []


def test_the_report_names_the_device_its_version_and_every_image_it_rests_on(record):
    report = made(record, READY_REPORT)
    observer = {
        item.ConceptNameCodeSequence[0].CodeMeaning: item.get("TextValue")
        for item in report.ContentSequence
        if item.RelationshipType == "HAS OBS CONTEXT"
    }
    assert observer["Device Observer Name"] == "AutoSPINe Navigator"
    assert observer["Device Observer Model Name"].endswith(report.SoftwareVersions)
    image = made(record, Output("measurement", 2, "image"))
    sources = [pydicom.dcmread(p) for p in finding_of_arrival(record, 1).files]
    referenced = {
        item.ReferencedSOPSequence[0].ReferencedSOPInstanceUID
        for item in group_of(report)
        if item.ValueType == "IMAGE"
    }
    assert referenced == {one.SOPInstanceUID for one in (*sources, image)}
    assert report.StudyInstanceUID == sources[0].StudyInstanceUID
    assert report.PatientID == sources[0].PatientID


def test_the_presentation_state_draws_fiducial_and_target_where_they_are(record):
    state = made(record, READY_PRESENTATION)
    image = made(record, Output("measurement", 2, "image"))
    (reference,) = state.ReferencedSeriesSequence[0].ReferencedImageSequence
    assert reference.ReferencedSOPInstanceUID == image.SOPInstanceUID
    # from the derived image's own geometry: (column, row) from the outer corner of its first pixel
    across, down = np.array(image.ImageOrientationPatient, dtype=float).reshape(2, 3)
    from_first_mm = np.subtract(record.measurement(2).result["patient_mm"],
                                np.array(image.ImagePositionPatient, dtype=float))  # fmt: skip
    spacing_mm = np.array(image.PixelSpacing, dtype=float)
    centre = np.array([from_first_mm @ across, from_first_mm @ down]) / spacing_mm[::-1] + 0.5
    circles = [points for kind, points in graphics(state, "FIDUCIAL") if kind == "CIRCLE"]
    assert circles[0][0] == pytest.approx(centre, abs=1e-3)
    radius_px = np.linalg.norm(circles[0][1] - circles[0][0])
    assert radius_px == pytest.approx(finding_of_measurement(record, 2).radius_mm / 0.5, abs=1e-3)
    crosses = [points for kind, points in graphics(state, "TARGET") if kind == "POLYLINE"]
    found = finding_of_arrival(record, 1)
    displacement = (found.must_be_plane_mm - found.result["plane_mm"]) / spacing_mm
    target = centre + displacement[::-1]
    assert len(crosses) == 2
    for points in crosses:
        assert points.mean(axis=0) == pytest.approx(target, abs=1e-3)
    plan = graphics(state, "PLAN")[0][1]
    assert plan == pytest.approx(np.array([centre, target]), abs=1e-3)
    assert displacement == pytest.approx(np.array(OFFSET_MM) / 0.5, abs=0.2)
    assert "Research software" in words_of(state)
    assert "P(below 60 um) = 0.988" in words_of(state)


def test_without_a_reconstruction_the_slice_is_drawn_over_and_no_image_is_referenced(tmp_path):
    with CaseRecord(make_case(tmp_path)) as record:
        row = record.measurement(1)
        found = finding_of_measurement(record, 1)
        bare = {k: v for k, v in row.result.items() if k != "reconstruction"}
        changed = type(found)(**{**vars(found), "result": bare})
        state = dataset_of(changed, Output("measurement", 1, "presentation"))
        report = dataset_of(changed, Output("measurement", 1, "report"))
        with pytest.raises(OutputError, match="measurement 1 has no reconstruction"):
            dataset_of(changed, Output("measurement", 1, "image"))
        (reference,) = state.ReferencedSeriesSequence[0].ReferencedImageSequence
        shown = record.slice(row.result["slice_id"])
    assert reference.ReferencedSOPInstanceUID == shown.sop_instance_uid
    row_px, col_px = row.result["centre_px"]
    assert graphics(state, "FIDUCIAL")[0][1][0] == pytest.approx(
        [col_px + 0.5, row_px + 0.5], abs=1e-3
    )
    assert len([item for item in group_of(report) if item.ValueType == "IMAGE"]) == 4


def test_a_target_outside_of_the_image_is_not_drawn_but_said(record):
    found = finding_of_arrival(record, 1)
    far = type(found)(**{**vars(found), "must_be_plane_mm": np.array([500.0, 0.0])})
    state = dataset_of(far, READY_PRESENTATION)
    layers = {annotation.GraphicLayer for annotation in state.GraphicAnnotationSequence}
    assert layers == {"FIDUCIAL", "NOTES"}
    assert "outside this image" in words_of(state)


# What the standard asks for


def test_every_output_has_what_its_modules_ask_for(record):
    # the tables know no conditions: what an SR content item must have hangs on its value type
    # by themselves
    beside = ("sr-document-content",)
    for output in outputs_to_send(record):
        found = violations(made(record, output))
        assert [w for w in found if not any(b in w for b in beside)] == [], output.name


def test_the_report_is_read_by_highdicom_as_a_measurement_report(record):
    report = Comprehensive3DSR.from_dataset(made(record, READY_REPORT))
    (group,) = report.content.get_image_measurement_groups()
    assert len(group.get_measurements()) > 10
    assert report.ContentTemplateSequence[0].TemplateIdentifier == "1500"


@needs_program("dsrdump")
def test_dcmtk_reads_the_reports_without_a_complaint(record):
    for output in outputs_to_send(record):
        if output.kind == "report":
            path = make_output(record, output)
            read = subprocess.run(["dsrdump", path], capture_output=True, text=True, check=True)
            assert "Comprehensive 3D SR Document" in read.stdout
            assert "E:" not in read.stderr, read.stderr


# How they are made


def test_an_output_made_anew_from_the_same_record_is_the_same_to_the_byte(record):
    for output in outputs_to_send(record):
        path = make_output(record, output)
        before = path.read_bytes()
        path.unlink()
        assert make_output(record, output).read_bytes() == before, output.name


def flip(path):
    content = bytearray(path.read_bytes())
    content[-20] ^= 1
    path.write_bytes(content)


def test_an_output_that_was_changed_is_not_handed_out_and_one_from_elsewhere_is_made_anew(record):
    path = make_output(record, READY_REPORT)
    made = path.read_bytes()
    flip(path)
    with pytest.raises(TamperedError, match="not the file that was made"):
        make_output(record, READY_REPORT)
    flip(path)
    other = Output("measurement", 1, "presentation")
    other.path(record.case_dir).write_bytes(made)  # laid there by whoever, under that name
    assert make_output(record, other).read_bytes() != made
    record.verify()


def test_a_reconstruction_or_a_slice_that_was_changed_is_found_out(record, tmp_path):
    output = next(o for o in outputs_to_send(record) if o.kind == "image")
    result = record.measurement(output.number).result
    image = record.case_dir / result["reconstruction"]
    output.path(record.case_dir).unlink(missing_ok=True)
    flip(image)
    with pytest.raises(TamperedError):
        reconstruction_pixels(record, output.number)
    with pytest.raises(TamperedError):
        make_output(record, output)
    with pytest.raises(TamperedError, match="not the image that was made"):
        write_export(record, tmp_path / "a.zip")
    flip(image)
    write_export(record, tmp_path / "a.zip")
    received = record.case_dir / record.slice(result["slice_id"]).path
    flip(received)
    with pytest.raises(TamperedError, match="not the file that was received"):
        write_export(record, tmp_path / "b.zip")
    assert not (tmp_path / "b.zip").exists()
    flip(received)


def test_an_output_that_is_there_is_not_made_again(record):
    path = make_output(record, READY_REPORT)
    made_ns = path.stat().st_mtime_ns
    assert make_output(record, READY_REPORT).stat().st_mtime_ns == made_ns
    assert not list(path.parent.glob("*.part"))


@pytest.fixture(scope="module")
def suzukis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case with a puncture by an operator of that name."""
    with CaseRecord(make_case(tmp_path_factory.mktemp("suzuki"))) as record:
        body = {"procedure_id": come_to_ready(record), "insertion_depth_mm": 40.0}
        record.append_event("puncture", body, source="service", who="鈴木 花子")
        return record.case_dir


@pytest.mark.parametrize(
    ("charset", "name"),
    [
        (["", "ISO 2022 IR 87"], "Yamada^Tarou=山田^太郎=やまだ^たろう"),
        (["ISO 2022 IR 13", "ISO 2022 IR 87"], "ﾔﾏﾀﾞ^ﾀﾛｳ=山田^太郎=やまだ^たろう"),
        ("ISO_IR 192", "Yamada^Tarou=山田^太郎=やまだ^たろう"),
        ("ISO_IR 100", "Müller^Jörg"),
        (None, "Miller^George"),
        ("ISO_IR 6", "Miller^George"),
        ("", "Miller^George"),
        (None, "Müller^Jörg"),
        ("ISO 2022 IR 100", "Müller^Jörg"),
        (["ISO_IR 13", "ISO 2022 IR 87"], "ﾔﾏﾀﾞ^ﾀﾛｳ=山田^太郎"),
        (["", "ISO 2022 IR 149"], "Hong^Gildong=洪^吉洞=홍^길동"),
        ("GB18030", "Wang^XiaoDong=王^小东"),
    ],
)
def test_names_are_written_as_they_are_whatever_the_alphabet(suzukis, tmp_path, charset, name):
    """The patient's, in that of the slices, and the operator's, which that may not have."""
    with CaseRecord(shutil.copytree(suzukis, tmp_path / "case")) as record:
        for row in record.slices(state="assigned"):
            source = pydicom.dcmread(record.case_dir / row.path)
            del source.SpecificCharacterSet
            if charset is not None:
                source.SpecificCharacterSet = charset
            source.PatientName = name
            source.StudyDescription = name.split("=")[-1]
            source.save_as(record.case_dir / row.path)
        (event,) = record.events_of_kind("puncture")
        outputs = [
            READY_PRESENTATION,
            Output("measurement", 1, "image"),
            Output("puncture", event.event_id, "report"),
        ]
        for output in outputs:
            path = make_output(record, output)
            read = pydicom.dcmread(path)
            assert str(read.PatientName) == name
            if shutil.which("dciodvfy"):
                said = subprocess.run(["dciodvfy", path], capture_output=True, text=True).stderr
                assert "haracter" not in said.replace("99AUTOSPINE", ""), said
        assert any("鈴木 花子" in item.get("TextValue", "") for item in group_of(read))


def test_names_that_were_set_as_text_are_written_as_they_are_too():
    """pydicom's own keep the bytes of their first encoding."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = (
        "1.2.840.10008.5.1.4.1.1.4",
        "1.2",
    )
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    dataset.SOPClassUID = meta.MediaStorageSOPClassUID
    dataset.SOPInstanceUID = meta.MediaStorageSOPInstanceUID
    dataset.SpecificCharacterSet = "ISO_IR 144"
    names = {"PatientName": "Иванов^Иван", "OperatorsName": "鈴木^花子"}
    for keyword, name in names.items():
        setattr(dataset, keyword, name)
    read = pydicom.dcmread(io.BytesIO(encoded(dataset)))
    assert {keyword: str(read[keyword].value) for keyword in names} == names


def test_all_uids_are_different_and_only_reports_have_a_series_of_their_own(record):
    objects = [made(record, output) for output in outputs_to_send(record)]
    assert len({one.SOPInstanceUID for one in objects}) == len(objects) == 5
    series = {(one.Modality, one.SeriesInstanceUID, one.SeriesNumber) for one in objects}
    assert {modality for modality, _, _ in series} == {"MR", "SR", "PR"}
    assert sorted(modality for modality, _, _ in series) == ["MR", "PR", "SR", "SR"]
    numbered = {(one.SeriesInstanceUID, one.InstanceNumber) for one in objects}
    assert len(numbered) == len(objects)


@pytest.mark.parametrize("name", ["", "approach-0-report", "../case-1-report", "event-1-report"])
def test_what_is_no_name_of_an_output_is_refused(name):
    with pytest.raises(OutputError, match="is not an output"):
        output_of(name)


def test_what_there_is_nothing_about_is_refused(record):
    with pytest.raises(CaseRecordError, match="no measurement 99"):
        make_output(record, Output("measurement", 99, "report"))
    with pytest.raises(CaseRecordError, match="procedure 99 did not reach READY"):
        make_output(record, Output("approach", 99, "report"))
    with pytest.raises(CaseRecordError, match="event 1 is not a puncture"):
        make_output(record, Output("puncture", 1, "report"))


def test_the_command_says_in_one_line_why_it_makes_none(record):
    words = [
        sys.executable,
        "-m",
        "service.dicom_out.make",
        str(record.case_dir),
        "approach-99-report",
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].endswith("procedure 99 did not reach READY")


def violations(dataset: Dataset) -> list[str]:
    sys.path.insert(0, str(Path(__file__).parents[1] / "simulator"))
    try:
        import dicom_standard
    finally:
        sys.path.pop(0)
    return dicom_standard.violations(dataset)


def test_an_export_takes_what_was_made_along(record: CaseRecord, tmp_path: Path) -> None:
    path = make_output(record, READY_REPORT)
    record.start_case("test", 1)
    write_export(record, tmp_path / "case.zip")
    with zipfile.ZipFile(tmp_path / "case.zip") as archive:
        assert archive.read(f"outputs/{path.name}") == path.read_bytes()
