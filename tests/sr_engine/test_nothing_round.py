"""Files that must yield no round object yield none, by the command that a user gives.

Human slices, mosaics, phantoms from the side, thresholded and scrambled noise, phase images, other
modalities, damaged files: everything that the collection marks as without a round object.
"""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dicom_slice.read import read_frames
from dicom_slice.reasons import UnusableError
from sr_engine.detect import detect
from sr_engine.errors import EngineError, ParameterError
from sr_engine.localize import localize
from sr_engine.reconstruction.resolution import radius_seen_px
from sr_engine.simulate import render_disc, rician

AUTOSPINE = Path(sys.executable).parent / "autospine"
DATA = Path(__file__).parents[2].parent / "shared" / "dicom"
real = pytest.mark.skipif(not (DATA / "manifest.csv").is_file(), reason="no real slices beside us")

FEW = (
    "hazen/localiser/ACR_PRELOCALISER.dcm",
    "hazen/snr_ge_sag/IM-0003-0001.dcm",
    "dcm_qa_xa30i/noise_only/1001001.dcm",
    "dcm_qa_xa30i/scout_mpr/scout_mpr_sag.dcm",
    "dcm_qa_frag/fragmented/5001041.dcm",
    "dcm_qa_canon_61/canon_classic/10000_261.dcm",
    "dcm_qa_uih/vframe/00000001.dcm",
    "dcm_qa_fmap/prisma_phase_s18/e2_18_ph.dcm",
    "dicom2nifti/hdr/anisotropic.dcm",
    "pydicom/odd/CT_small.dcm",
)
# The third frame of that localiser cuts a cylinder across: round indeed, and far above 20 mm.
CYLINDER, CYLINDER_LEAST_PX = "ACR_PRELOCALISER.dcm", 20.0


def paths_without_a_round_object() -> list[Path]:
    with (DATA / "manifest.csv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["round_object"] in ("no", "phase")]
    return [DATA / row["path"] for row in rows]


def found_by_the_command(paths: list[Path], *options: str) -> list[tuple[str, float]]:
    """(file, radius in px) of what `autospine locate` finds."""
    result = subprocess.run(
        [AUTOSPINE, "locate", *paths, "--json", *options],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode in (0, 3), result.stderr[-2000:]
    assert "Traceback" not in result.stderr
    return [(f["files"][0], f["radius_px"]) for f in json.loads(result.stdout)["fiducials"]]


def but_the_cylinder(found: list[tuple[str, float]]) -> list[tuple[str, float]]:
    return [f for f in found if not (f[0].endswith(CYLINDER) and f[1] > CYLINDER_LEAST_PX)]


@real
def test_the_command_finds_nothing_round_in_files_of_every_kind_without_it() -> None:
    assert found_by_the_command([DATA / path for path in FEW]) == []


@real
def test_noise_has_nothing_round_even_over_a_very_wide_range_of_radii() -> None:
    paths = sorted((DATA / "dcm_qa_xa30i/noise_only").glob("*.dcm"))
    assert len(paths) == 2
    assert found_by_the_command(paths, "--radius-mm", "0.5,150") == []


@pytest.mark.soak
@real
@pytest.mark.parametrize("radii", ["2,20", "0.5,150", "1,60", "4,12", "2,8"])
def test_the_command_finds_nothing_round_in_any_file_without_it(radii: str) -> None:
    paths = paths_without_a_round_object()
    assert len(paths) >= 58
    found = found_by_the_command(paths, "--radius-mm", radii)
    assert but_the_cylinder(found) == []
    if radii == "2,20":
        assert found == []


@pytest.mark.soak
@real
def test_a_measurement_without_a_start_refuses_every_frame_without_a_round_object() -> None:
    refused = 0
    for path in paths_without_a_round_object():
        try:
            frames = read_frames(path)
        except UnusableError:
            refused += 1
            continue
        for _, pixels in frames:
            with pytest.raises(EngineError):
                localize(pixels, radius_px=(1.5, 12.0))
            refused += 1
    assert refused >= 58


def test_a_spot_below_the_resolution_is_not_offered_and_a_small_disc_is() -> None:
    rng = np.random.default_rng(1)
    for radius, offered in ((0.6, False), (1.0, False), (2.0, True), (2.5, True)):
        for centre in ((30.2, 41.7), (30.5, 41.1), (29.9, 40.4)):
            frame = rician(render_disc((64, 80), centre, radius), 0.03, rng)
            assert bool(detect(frame, (1, 6))) is offered
            assert radius_seen_px(frame, centre) == pytest.approx(radius, abs=0.4)


def test_radii_below_the_resolution_are_refused_by_name() -> None:
    frame = rician(render_disc((64, 80), (30, 40), 4), 0.03, np.random.default_rng(2))
    with pytest.raises(ParameterError, match=r"visible only from 1\.5 px"):
        detect(frame, (0.5, 1.2))


def test_clumps_of_a_thresholded_noise_are_not_objects() -> None:
    rng = np.random.default_rng(3)
    for share in (0.02, 0.1, 0.3):
        frame = (rng.random((120, 160)) < share).astype(float)
        assert detect(frame, (1, 20)) == []


def test_an_outline_that_is_no_circle_is_not_offered_however_clear() -> None:
    """Lobed and oval outlines, as tissue has them, beside the circle of the same area."""
    rng = np.random.default_rng(4)
    row, col = np.indices((96, 128))
    angle, distance = np.arctan2(row - 47.3, col - 60.8), np.hypot(row - 47.3, col - 60.8)
    for order, depth, offered in ((2, 0.0, True), (2, 0.2, False), (3, 0.14, False)):
        edge = 9 * (1 + depth * np.cos(order * angle))
        frame = np.hypot(
            np.clip(edge + 0.5 - distance, 0, 1), 0.02 * rng.standard_normal(row.shape)
        )
        assert bool(detect(frame, (3, 30))) is offered
