"""`autospine locate` and `autospine reconstruct` on files, as a user calls them."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pydicom
import pytest
from real_slices import DICOM
from virtual_slices import write_slice

from simulator.config import VirtualRoom
from simulator.scene import true_fiducial_mm

AUTOSPINE = Path(sys.executable).parent / "autospine"
QUARTER_MM = {"a": (-0.25, -0.25), "b": (-0.25, 0.25), "c": (0.25, -0.25), "d": (0.25, 0.25)}


def autospine(*words: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [AUTOSPINE, *map(str, words)], capture_output=True, text=True, check=False, timeout=120
    )


def one_line_and_code_2(result: subprocess.CompletedProcess, *parts: str) -> None:
    assert result.returncode == 2, result
    assert len(result.stderr.strip().splitlines()) == 1
    for part in parts:
        assert part in result.stderr


@pytest.fixture(scope="module")
def shifted(tmp_path_factory):
    """Four virtual slices at quarter-pixel shifts of the stages, and the table of shifts."""
    folder = tmp_path_factory.mktemp("shifted")
    room = VirtualRoom()
    reference = true_fiducial_mm(room, {"xt": 0.0, "yt": 0.0})
    rows = []
    for number, (name, (x_mm, y_mm)) in enumerate(QUARTER_MM.items()):
        stage_mm = {"xt": x_mm, "yt": y_mm}
        write_slice(folder / f"{name}.dcm", room, stage_mm, seed=number)
        moved = true_fiducial_mm(room, stage_mm) - reference
        # coronal: rows grow towards the feet (-z), columns towards the left (+x), 1 mm pixels
        rows.append((f"{name}.dcm", -moved[2], moved[0]))
    table = folder.parent / "shifts.csv"
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([("file", "row_px", "col_px"), *rows])
    return folder, table, reference


def test_four_shifted_slices_give_the_true_position_in_the_patient(shifted):
    folder, table, truth = shifted
    result = autospine("locate", folder, "--shifts", table, "--radius-mm", "3,6", "--json")
    assert result.returncode == 0, result.stderr
    (found,) = json.loads(result.stdout)["fiducials"]
    miss = np.array(found["patient_mm"])[[0, 2]] - truth[[0, 2]]
    assert np.linalg.norm(miss) < 5 * max(found["sigma_row_px"], found["sigma_col_px"])
    assert found["sigma_row_px"] < 0.02
    assert len(found["files"]) == 4
    assert found["method"] == "ml"


def test_without_shifts_every_file_is_looked_at_and_drawn(shifted, tmp_path):
    folder, _, truth = shifted
    picture = tmp_path / "found.png"
    result = autospine("locate", folder, "--radius-mm", "3,6", "--json", "--png", picture)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)["fiducials"]
    names = [Path(one["files"][0]).name for one in found]
    assert names == sorted(names)
    near = [f for f in found if abs(f["patient_mm"][0] - truth[0]) < 1.0]
    assert {Path(f["files"][0]).name for f in near} == {"a.dcm", "b.dcm", "c.dcm", "d.dcm"}
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_reconstruction_is_a_derived_mr_image_on_the_finer_grid(shifted, tmp_path):
    folder, table, truth = shifted
    out = tmp_path / "sr.dcm"
    result = autospine("reconstruct", folder, "--shifts", table, "--out", out)
    assert result.returncode == 0, result.stderr
    image = pydicom.dcmread(out)
    source = pydicom.dcmread(folder / "a.dcm")
    assert list(image.ImageType)[:2] == ["DERIVED", "SECONDARY"]
    assert image.SeriesInstanceUID != source.SeriesInstanceUID
    assert image.FrameOfReferenceUID == source.FrameOfReferenceUID
    assert image.StudyInstanceUID == source.StudyInstanceUID
    assert len(image.SourceImageSequence) == 4
    assert [float(v) for v in image.PixelSpacing] == [0.5, 0.5]
    # the fiducial is where it was at the reference pose: half pixel and spacing are right
    picture = autospine("locate", out, "--radius-mm", "3,6", "--json")
    found = json.loads(picture.stdout)["fiducials"]
    misses = [np.hypot(f["patient_mm"][0] - truth[0], f["patient_mm"][2] - truth[2]) for f in found]
    assert min(misses) < 0.06


def test_shifts_on_one_line_are_refused(shifted, tmp_path):
    folder, _, _ = shifted
    table = tmp_path / "line.csv"
    rows = [f"{name}.dcm,{k / 4},{k / 4}" for k, name in enumerate(QUARTER_MM)]
    table.write_text("\n".join(["file,row_px,col_px", *rows]))
    out = tmp_path / "sr.dcm"
    one_line_and_code_2(
        autospine("reconstruct", folder, "--shifts", table, "--out", out), "singular"
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("file,row_px\na.dcm,0\n", "col_px"),
        ("file,row_px,col_px\na.dcm,0,zero\n", "zero"),
        ("file,row_px,col_px\na.dcm,0,nan\n", "nan"),
        ("file,row_px,col_px\na.dcm,0,0\n", "b.dcm"),
        ("file,row_px,col_px\na.dcm,0,0\na.dcm,1,1\n", "twice"),
        ("", "no rows"),
    ],
)
def test_a_wrong_shift_table_is_named(shifted, tmp_path, text, part):
    folder, _, _ = shifted
    table = tmp_path / "wrong.csv"
    table.write_text(text)
    one_line_and_code_2(autospine("locate", folder, "--shifts", table), part)


def test_a_file_that_does_not_exist_is_named(tmp_path):
    one_line_and_code_2(autospine("locate", tmp_path / "nothing.dcm"), "nothing.dcm", "no such")


def test_a_file_that_is_no_dicom_is_named(tmp_path):
    letter = tmp_path / "letter.dcm"
    letter.write_text("Dear colleague,\n" * 100)
    one_line_and_code_2(autospine("locate", letter), "letter.dcm", "not DICOM")


def change(path: Path, out: Path, **values: object) -> Path:
    image = pydicom.dcmread(path)
    for keyword, value in values.items():
        if value is None:
            delattr(image, keyword)
        else:
            setattr(image, keyword, value)
    image.save_as(out)
    return out


def test_a_slice_without_pixels_or_geometry_is_named(shifted, tmp_path):
    folder, _, _ = shifted
    source = folder / "a.dcm"
    bare = change(source, tmp_path / "bare.dcm", PixelData=None)
    one_line_and_code_2(autospine("locate", bare), "bare.dcm", "pixels")
    nowhere = change(source, tmp_path / "nowhere.dcm", ImagePositionPatient=None)
    one_line_and_code_2(autospine("locate", nowhere), "nowhere.dcm")


def test_a_slice_without_a_round_object_says_so(shifted, tmp_path):
    folder, _, _ = shifted
    image = pydicom.dcmread(folder / "a.dcm")
    stripes = np.tile(np.arange(image.Columns) % 40 * 20, (image.Rows, 1)).astype("<u2")
    flat = change(folder / "a.dcm", tmp_path / "stripes.dcm", PixelData=stripes.tobytes())
    result = autospine("locate", flat, "--radius-mm", "3,6", "--json")
    assert result.returncode == 3
    assert json.loads(result.stdout) == {"fiducials": []}
    assert "no round object" in result.stderr


def test_the_vials_of_the_real_coronal_phantom_are_found():
    series = DICOM / "hazen" / "nist_T2_site3_ge_plate4"
    result = autospine("locate", series, "--radius-mm", "3,12", "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)["fiducials"]
    files = {f["files"][0] for f in found}
    assert len(files) == len(list(series.iterdir()))
    for file in files:
        assert len([f for f in found if f["files"] == [file]]) >= 14
