"""All objects of a case with five punctures, by the programs that archives and stations use."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import highdicom
import httpx
import numpy as np
import pydicom
import pytest
from highdicom.sr import Comprehensive3DSR
from receivers import free_port, needs_program
from recorded_case import come_to_ready, make_case

from case_record.record import CaseRecord
from dicom_slice.plan import plan_in
from service.dicom_out.identity import MAKER
from service.dicom_out.make import Output, make_output, outputs_to_send, plans_to_send

# What the validators say of every case, and why it is so. docs/dicom_outputs.md has the same table.
EXPLAINED = {
    "Unrecognized defined term <99AUTOSPINE>": "private codes are designated so, by the standard",
    "Different information entities for attribute - Element=<AccessionNumber>": "the tool counts "
    "it to the series of images and to the study of reports; its values are equal",
    "Unrecognized defined term <M> for value 3 of attribute <Image Type>": "the scanner's own word",
    "Standard Extended SOP Class": "follows from the next one",
    "VR checker does not support this Specific Character Set": "of dsrdump 3.6.7 alone",
    "Reading unknown/unsupported SpecificCharacterSet": "as above",
    "(0x0018,0x9073) FD Acquisition Duration": "the scanner's own, in a classic image",
}


JAPANESE = ["", "ISO 2022 IR 87"]
PATIENT, PHYSICIAN, OPERATOR = (
    "Yamada^Tarou=山田^太郎=やまだ^たろう",
    "Sato^Ken=佐藤^健",
    "Łukasz 鈴木",
)


@pytest.fixture(scope="module")
def five_punctures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last by an operator whose name is in UTF-8 alone."""
    case_dir = make_case(tmp_path_factory.mktemp("five"))
    with CaseRecord(case_dir) as record:
        for who in ("Olga", "Olga", "鈴木 花子", "Olga", OPERATOR):
            body = {"procedure_id": come_to_ready(record), "insertion_depth_mm": 42.5}
            record.append_event("puncture", body, source="service", who=who)
    return case_dir


@pytest.fixture(scope="module", params=["as the simulator writes", "Japanese"])
def objects(request, five_punctures: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    case_dir = shutil.copytree(five_punctures, tmp_path_factory.mktemp("named") / "case")
    slices = sorted((case_dir / "inbox").iterdir())
    for path in slices if request.param == "Japanese" else ():
        source = pydicom.dcmread(path)
        source.SpecificCharacterSet, source.PatientName = JAPANESE, PATIENT
        source.ReferringPhysicianName = source.PerformingPhysicianName = PHYSICIAN
        source.StudyDescription, source.InstitutionName = "腰椎", "大学病院"
        source.save_as(path)
    with CaseRecord(case_dir) as record:
        wanted = [*outputs_to_send(record), *plans_to_send(record)]
        made = [make_output(record, output) for output in wanted]
        made.append(make_output(record, Output("measurement", 1, "report")))
        made.append(make_output(record, Output("measurement", 1, "presentation")))
    return [*slices, *made]


def unexplained(said: str) -> list[str]:
    lines = [
        line for line in said.splitlines() if line.startswith(("Error", "Warning", "E:", "W:"))
    ]
    return [line for line in lines if not any(known in line for known in EXPLAINED)]


@needs_program("dcentvfy")
def test_attributes_of_patient_study_series_and_frame_are_the_same_in_all_objects(objects):
    """Byte by byte within a character set, which is what the program compares; as read in all."""
    by_charset, said = defaultdict(list), set()
    for path in objects:
        read = pydicom.dcmread(path, stop_before_pixels=True)
        by_charset[str(read.SpecificCharacterSet)].append(path)
        names = ("PatientName", "ReferringPhysicianName", "StudyDescription")
        said.add(tuple(str(read.get(name)) for name in names))
    assert len(said) == 1
    for paths in by_charset.values():
        done = subprocess.run(
            ["dcentvfy", *paths], capture_output=True, text=True, errors="replace"
        )
        assert unexplained(done.stdout + done.stderr) == []


@needs_program("dciodvfy")
def test_every_object_has_what_its_modules_ask_for(objects):
    for path in objects:
        done = subprocess.run(["dciodvfy", path], capture_output=True, text=True, errors="replace")
        assert unexplained(done.stdout + done.stderr) == [], path.name


@needs_program("dcmpschk")
def test_dcmtk_and_highdicom_read_every_object(objects):
    for path in objects:
        dataset = pydicom.dcmread(path)
        is_report, is_state = dataset.Modality == "SR", dataset.Modality == "PR"
        for program in ["dcmdump", *["dsrdump"] * is_report, *["dcmpschk"] * is_state]:
            done = subprocess.run([program, path], capture_output=True)
            assert (done.returncode, re.findall(b"(?i)error", done.stderr)) == (0, []), done.stderr
            said = done.stderr.decode(errors="replace")
            assert program == "dcmpschk" or unexplained(said) == [], path.name
        if is_report:
            groups = Comprehensive3DSR.from_dataset(dataset).content.get_image_measurement_groups()
            assert len(groups) == 1
        if dataset.Modality == "MR":
            assert highdicom.imread(path).get_volume_geometry() is not None


def test_every_report_is_a_series_of_its_own_and_names_itself(objects):
    reports = [d for d in map(pydicom.dcmread, objects) if d.Modality == "SR"]
    assert len({d.SeriesInstanceUID for d in reports}) == len(reports) == 11
    assert len({d.SeriesNumber for d in reports}) == len(reports)
    assert len({d.SeriesDescription for d in reports}) == len(reports)


def test_our_plan_goes_back_as_it_was_decided_and_proposes_nothing_if_it_comes_again(objects):
    path = next(p for p in objects if p.stem.startswith("plan-"))
    case_dir = path.parents[1]
    with CaseRecord(case_dir, read_only=True) as record:
        event = record.events_of_kind("target_set")[0]
        frame = record.last_slice("assigned").header["frame_of_reference_uid"]
    assert plan_in(path, MAKER) is None
    read = plan_in(path, "somebody else")
    assert read is not None
    (target,) = [point for point in read.points if point.label == "TARGET"]
    assert target.patient_mm == pytest.approx(event.body["patient_mm"], abs=1e-6)
    assert target.frame_of_reference_uid == frame


def test_a_derived_image_keeps_what_its_sources_say_and_reads_the_same_without_a_rescale(objects):
    read = [pydicom.dcmread(path) for path in objects]
    source = next(d for d in read if d.Modality == "MR" and d.ImageType[0] == "ORIGINAL")
    for derived in (d for d in read if d.Modality == "MR" and d.ImageType[0] == "DERIVED"):
        for keyword in ("BodyPartExamined", "SpacingBetweenSlices", "PatientWeight"):
            assert derived[keyword].value == source[keyword].value
        assert "RescaleSlope" not in derived
        # the same grey values as the source's, to the noise: the sky is as dark, oil as bright
        low, high = np.percentile(derived.pixel_array, [50, 99])
        stored = source.pixel_array * float(source.get("RescaleSlope", 1)) + float(
            source.get("RescaleIntercept", 0)
        )
        assert [low, high] == pytest.approx(np.percentile(stored, [50, 99]), rel=0.2, abs=15)


@contextmanager
def running_orthanc(folder: Path) -> Iterator[str]:
    port, dicom_port = free_port(), free_port()
    (folder / "orthanc.json").write_text(
        json.dumps(
            {
                "StorageDirectory": str(folder / "store"),
                "IndexDirectory": str(folder / "store"),
                "HttpPort": port,
                "DicomPort": dicom_port,
                "RemoteAccessAllowed": False,
                "AuthenticationEnabled": False,
            }
        )
    )
    with (folder / "orthanc.log").open("wb") as log:
        process = subprocess.Popen(
            ["Orthanc", str(folder / "orthanc.json")], stdout=log, stderr=subprocess.STDOUT
        )
    url = f"http://127.0.0.1:{port}"
    try:
        deadline_s = time.monotonic() + 120
        while True:
            try:
                httpx.get(f"{url}/system").raise_for_status()
                break
            except httpx.HTTPError:
                assert process.poll() is None, (folder / "orthanc.log").read_text()
                assert time.monotonic() < deadline_s
                time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(60)


@pytest.mark.skipif(shutil.which("Orthanc") is None, reason="needs Orthanc")
def test_an_archive_shows_each_report_under_its_own_description(objects, tmp_path):
    with running_orthanc(tmp_path) as url:
        for path in objects:
            httpx.post(f"{url}/instances", content=path.read_bytes()).raise_for_status()
        series = httpx.get(f"{url}/series?expand").json()
    tags = [one["MainDicomTags"] for one in series if one["MainDicomTags"]["Modality"] == "SR"]
    shown = sorted(tag["SeriesDescription"] for tag in tags)
    assert len(set(shown)) == len(shown) == 11
    subject = re.compile(r"AutoSPINe (measurement|approach|puncture) \d+ ")
    assert all(subject.match(one) for one in shown), shown
