"""`autospine locate` with --template, --roi, --radius-mm: on files, as scripts call it."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from frames_to_dicom import dataset_of, write_frames
from test_files_commands import autospine, one_line_and_code_2

from sr_engine.simulate import render_disc, rician

OUTSIDE = Path(__file__).parents[1] / "data/outside_physics/ring_5_2_gre_brass_3T.npz"


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    folder = tmp_path_factory.mktemp("ring")
    with np.load(OUTSIDE) as data:
        return (*write_frames(data["frames"][:15], data["centre_px"][:15], folder / "f"), folder)


def test_every_file_is_localized_by_the_template_of_the_table(
    ring: tuple[Path, Path, Path],
) -> None:
    table, frames, _ = ring
    result = autospine("locate", frames, "--template", table, "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)["fiducials"]
    assert [Path(one["files"][0]).name for one in found] == [f"{n:03d}.dcm" for n in range(9, 15)]
    with np.load(OUTSIDE) as data:
        errors = np.array([(one["row"], one["col"]) for one in found]) - data["centre_px"][9:15]
    sigmas = np.array([(one["sigma_row_px"], one["sigma_col_px"]) for one in found])
    assert np.all(np.abs(errors - errors.mean(axis=0)) < 4 * sigmas)
    assert {one["method"] for one in found} == {"template"}
    systematic = [(one["systematic_row_px"], one["systematic_col_px"]) for one in found]
    assert np.all(np.abs(errors) < 4 * np.hypot(sigmas, systematic))


def test_a_file_of_the_table_that_is_not_beside_it_is_named(
    ring: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    table = tmp_path / "table.csv"
    table.write_text("file,row_px,col_px\ngone.dcm,0,0\n")
    result = autospine("locate", ring[1], "--template", table)
    one_line_and_code_2(result, "gone.dcm", "not in the same folder")


def test_wrong_displacements_make_no_template(ring: tuple[Path, Path, Path]) -> None:
    rows = list(csv.reader(ring[0].read_text().splitlines()))
    rows[5][2] = str(float(rows[5][2]) + 1.0)
    wrong = ring[0].with_name("wrong.csv")
    with wrong.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    result = autospine("locate", ring[1], "--template", wrong, "--json")
    assert result.returncode == 3
    assert json.loads(result.stdout) == {"fiducials": []}
    assert "frame 4" in result.stderr


def test_a_disc_of_another_size_is_not_reported_as_one_of_the_range(tmp_path: Path) -> None:
    frame = rician(render_disc((96, 112), (40.2, 50.3), 8.5), 0.02, np.random.default_rng(1))
    dataset_of(frame * 2000).save_as(tmp_path / "large.dcm", enforce_file_format=True)
    result = autospine("locate", tmp_path, "--radius-mm", "2.5,6", "--json")
    found = json.loads(result.stdout)["fiducials"]
    assert not [one for one in found if np.hypot(one["row"] - 40.2, one["col"] - 50.3) < 3]


def test_the_region_counts_with_shifts_too(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    table = tmp_path / "shifts.csv"
    table.write_text("file,row_px,col_px\na.dcm,0,0\nb.dcm,0.5,0.25\n")
    for name, (row, col) in (("a.dcm", (0, 0)), ("b.dcm", (0.5, 0.25))):
        frame = render_disc((96, 112), (30.2 + row, 30.3 + col), 5.0)
        frame = frame + render_disc((96, 112), (65.4 + row, 80.1 + col), 5.0)
        file = tmp_path / name
        dataset_of(rician(frame, 0.03, rng) * 2000).save_as(file, enforce_file_format=True)
    words = ("--shifts", table, "--radius-mm", "3,7", "--json")
    files = (tmp_path / "a.dcm", tmp_path / "b.dcm")
    (found,) = json.loads(autospine("locate", *files, *words, "--roi", "55,70,75,90").stdout)[
        "fiducials"
    ]
    assert np.hypot(found["row"] - 65.4, found["col"] - 80.1) < 0.05
