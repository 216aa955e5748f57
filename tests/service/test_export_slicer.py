"""`autospine export CASE --slicer`: every file by its format's own reader, against the record."""

import json
import shutil
import sqlite3
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from recorded_case import come_to_ready, make_case, puncture

from case_record.record import FILE_NAME, CaseRecord
from dicom_slice.geometry import SliceGeometry
from room_config.shell import autospine
from service.cli.slicer_formats import itk_transform, nrrd
from service.procedure.registry import GUIDE_APPROACH
from service.room.images import reconstruction_pixels, slice_pixels

TIP, JOINT = (10.0, -20.0, 5.0), (10.0, 40.0, 85.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, CaseRecord]]:
    """The scene's folder, unpacked, and the record: a READY of one fiducial, one of a guide."""
    folder = tmp_path_factory.mktemp("scene")
    with CaseRecord(make_case(folder)) as record:
        puncture(record, come_to_ready(record))
        body = {"patient_mm": list(JOINT)}
        record.append_event("entry_set", body, source="service", who="Olga")
        number = record.begin_procedure(GUIDE_APPROACH, {})
        result = {"measurement_id": 2, "tip_mm": list(TIP), "joint_mm": list(JOINT)}
        record.end_procedure(number, "done", result)
        words = autospine("export", str(record.case_dir), "--slicer")
        subprocess.run(words, cwd=folder, check=True, capture_output=True)
        with zipfile.ZipFile(folder / "case.mrb") as archive:
            archive.extractall(folder / "opened")
        yield folder / "opened" / "case", record


def test_the_scene_names_every_file_once_and_every_reference_is_there(scene):
    folder, _ = scene
    nodes = list(ElementTree.parse(folder / "case.mrml").getroot())
    ids = [node.get("id") for node in nodes]
    assert len(set(ids)) == len(ids)
    named = [node.get("fileName") for node in nodes if node.get("fileName")]
    files = [path.relative_to(folder).as_posix() for path in (folder / "Data").iterdir()]
    assert sorted(named) == sorted(files)
    for node in nodes:
        for reference in (node.get("references") or "").split(";"):
            if reference:
                assert reference.partition(":")[2] in ids


def test_volumes_have_pixels_and_place_by_pynrrd_and_by_itk(scene):
    nrrd_reader = pytest.importorskip("nrrd", reason="pynrrd is not installed")
    itk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    folder, record = scene
    row = record.slice(record.measurement(2).result["slice_id"])
    geometry = SliceGeometry(**{k: tuple(v) for k, v in row.header["geometry"].items()})
    fine = reconstruction_pixels(record, 2)
    wanted = {
        f"slice-{row.slice_id}-of-2": (slice_pixels(record, row.slice_id), geometry),
        "super-resolution-2": (fine, geometry.finer_grid(2)),
    }
    for name, (pixels, at) in wanted.items():
        path = folder / "Data" / f"{name}.nrrd"
        values, header = nrrd_reader.read(str(path), index_order="C")
        assert np.allclose(values[0], pixels, rtol=1e-6)
        assert header["space"] == "left-posterior-superior"
        volume = itk.ReadImage(str(path))
        assert volume.GetSpacing()[2] == pytest.approx(row.header["slice_thickness_mm"])
        rows, cols = at.shape
        for index in ((0, 0), (rows - 1, 0), (rows - 3, cols - 2)):
            place = volume.TransformIndexToPhysicalPoint((index[1], index[0], 0))
            assert place == pytest.approx(at.patient_from_pixel(index), abs=1e-6)


def test_points_stand_where_the_record_has_them(scene):
    folder, record = scene
    read = json.loads((folder / "Data" / "fiducials.mrk.json").read_text())["markups"][0]
    assert (read["type"], read["coordinateSystem"]) == ("Fiducial", "LPS")
    places = [point["position"] for point in read["controlPoints"]]
    assert places == [list(row.result["patient_mm"]) for row in record.measurements("done")]
    planned = json.loads((folder / "Data" / "targets.mrk.json").read_text())["markups"][0]
    labels = [point["label"].split()[0] for point in planned["controlPoints"]]
    assert labels == ["target", "entry"]
    needle = json.loads((folder / "Data" / "ready-2.mrk.json").read_text())["markups"][0]
    assert needle["type"] == "Line"
    assert [point["position"] for point in needle["controlPoints"]] == [list(JOINT), list(TIP)]


def test_a_pose_read_by_itk_brings_the_patient_to_the_guide(scene):
    itk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    folder, record = scene
    one = itk.ReadTransform(str(folder / "Data" / "ready-1.tfm"))
    seen = record.measurement(2).result["patient_mm"]
    assert one.TransformPoint(list(seen)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    guide = itk.ReadTransform(str(folder / "Data" / "ready-2.tfm"))
    assert guide.TransformPoint(TIP) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert guide.TransformPoint(JOINT) == pytest.approx((0.0, 0.0, -100.0), abs=1e-6)


def test_the_same_case_gives_the_same_bytes(scene, tmp_path):
    folder, record = scene
    words = autospine(
        "export", str(record.case_dir), "--slicer", "--out", str(tmp_path / "case.mrb")
    )
    subprocess.run(words, check=True, capture_output=True)
    first = folder.parent.parent / "case.mrb"
    assert (tmp_path / "case.mrb").read_bytes() == first.read_bytes()


def test_a_file_that_is_there_is_not_replaced_and_a_folder_without_a_case_is_named(scene, tmp_path):
    _, record = scene
    (tmp_path / "case.mrb").write_text("mine")
    words = autospine("export", str(record.case_dir), "--slicer")
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert "already exists" in done.stderr
    none = subprocess.run(
        autospine("export", str(tmp_path / "no"), "--slicer"), capture_output=True, text=True
    )
    assert none.returncode == 2
    assert "Traceback" not in none.stderr


def test_a_record_that_is_damaged_inside_ends_with_one_line_that_says_what_to_do(scene, tmp_path):
    _, record = scene
    shutil.copytree(record.case_dir, tmp_path / "case")
    database = tmp_path / "case" / FILE_NAME
    with closing(sqlite3.connect(database)) as opened:
        opened.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        (page_bytes,) = opened.execute("PRAGMA page_size").fetchone()
        (root,) = opened.execute("SELECT rootpage FROM sqlite_master WHERE name = 'measurement'")
    content = bytearray(database.read_bytes())
    content[(root[0] - 1) * page_bytes : root[0] * page_bytes] = b"\xa5" * page_bytes
    database.write_bytes(content)
    words = autospine("export", str(tmp_path / "case"), "--slicer", "--out", str(tmp_path / "out"))
    done = subprocess.run(words, capture_output=True, text=True)
    (said,) = done.stderr.strip().splitlines()
    assert done.returncode == 2
    assert "the case record is damaged" in said
    assert "restore it" in said
    assert not list(tmp_path.glob("out*"))


def test_oblique_slices_keep_their_place(tmp_path):
    itk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    at = SliceGeometry((1.0, 2.0, 3.0), tuple(turn[0]), tuple(turn[1]), (0.7, 1.3), (5, 4))
    path = tmp_path / "oblique.nrrd"
    path.write_bytes(nrrd(np.arange(20.0).reshape(5, 4), at, 2.5))
    volume = itk.ReadImage(str(path))
    assert volume.GetPixel(3, 4, 0) == 19.0
    place = volume.TransformIndexToPhysicalPoint((3, 4, 0))
    assert place == pytest.approx(at.patient_from_pixel((4, 3)), abs=1e-6)
    pose = tmp_path / "pose.tfm"
    axes = turn.T * np.sign(np.linalg.det(turn))
    pose.write_bytes(itk_transform(axes, (1.0, 2.0, 3.0)))
    moved = itk.ReadTransform(str(pose)).TransformPoint((1.0, 2.0, 3.0) + axes[:, 2] * 7)
    assert moved == pytest.approx((0.0, 0.0, 7.0), abs=1e-6)
