"""Four degrees of freedom through the real processes: the needle's tip against the truth."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from case_record.record import CaseRecord
from service.procedure.registry import GUIDE_APPROACH, GUIDE_CALIBRATION
from simulator.config import parse_virtual_room
from simulator.scene import true_guide

AUTOSPINE = Path(sys.executable).parent / "autospine"
LOWER_PLANE_MM, TARGET_DEPTH_MM = -2.0, 80.0
PUNCTURES = 3
IN_PLANE = [0, 2]  # of patient x, y, z in coronal slices; the image's rows run against z


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A case of four axes, and what the demo printed of it."""
    folder = tmp_path_factory.mktemp("four") / "case"
    words = ["demo", "--guide", "--exit", "--json", "--punctures", str(PUNCTURES), "--seed", "4"]
    ended = subprocess.run(
        [AUTOSPINE, *words, "--case", folder], capture_output=True, text=True, timeout=280
    )
    assert ended.returncode == 0, ended.stderr
    return folder, json.loads(ended.stdout)


@pytest.fixture
def record(case):
    with CaseRecord(case[0]) as record:
        yield record


def true_tip_mm(record, folder, depth_mm, at_s):
    """Where the tip truly was in the last slice before an instant, patient mm."""
    room = parse_virtual_room(tomllib.loads((folder / "room.toml").read_text())["virtual"])
    lines = (folder / "virtual" / "acquisitions.jsonl").read_text().splitlines()
    scans = [one for one in map(json.loads, lines) if one.get("kind") == "acquisition"]
    last = max((s for s in scans if s["ended_s"] < at_s), key=lambda s: s["ended_s"])
    return true_guide(room, last["stage_mm"]).at(-depth_mm)


def arrivals(record):
    rows = [row for row in record.procedures() if row.name == GUIDE_APPROACH]
    assert [row.state for row in rows] == ["done"] * PUNCTURES
    return rows


def test_a_case_of_four_axes_comes_to_ready_by_the_orders_of_the_api_alone(case, record):
    _, printed = case
    assert printed["unintended_motions"] == 0
    assert len(printed["punctures"]) == PUNCTURES
    assert all(one["true_error_mm"] < 0.4 for one in printed["punctures"])
    assert record.last_procedure(GUIDE_CALIBRATION, "done") is not None
    assert record.verify_events() > 40
    assert {axis for move in record.moves() for axis in move.setpoints_um} == {
        *("xt", "yt", "xb", "yb")
    }


def test_the_tip_80_mm_below_the_lower_plane_is_where_its_covariance_says(case, record):
    folder, printed = case
    for row, puncture in zip(arrivals(record), printed["punctures"], strict=True):
        found = row.result
        tip, covariance = np.array(found["tip_mm"]), np.array(found["tip_covariance_mm2"])
        assert tip[1] == pytest.approx(LOWER_PLANE_MM - TARGET_DEPTH_MM, abs=0.05)
        true = true_tip_mm(record, folder, found["tip_below_joint_mm"], row.ended_s)
        miss = (true - tip)[IN_PLANE][::-1] * [-1.0, 1.0]  # as (row, col)
        assert miss @ np.linalg.solve(covariance, miss) < chi2.isf(1e-4, 2)
        assert 0.01 < found["sigma_mm"] < 0.1
        assert puncture["sigma_mm"] == pytest.approx(found["sigma_mm"])
        targets = {event.event_id: event.body for event in record.events_of_kind("target_set")}
        target = np.array(targets[row.arguments["target"]]["patient_mm"])
        error = (target - tip)[IN_PLANE][::-1] * [-1.0, 1.0]
        assert error == pytest.approx(np.array(found["tip_error_mm"]), abs=0.01)
        assert found["probability"] >= 0.95


def test_the_case_is_replayed_reported_and_exported_like_any_other(case, tmp_path):
    folder, _ = case
    again = subprocess.run(
        [AUTOSPINE, "replay", folder, "--json"], capture_output=True, text=True, timeout=280
    )
    assert again.returncode == 0, again.stderr
    replayed = json.loads(again.stdout)
    assert all(row["agrees"] for row in replayed["procedures"])
    assert all(row["difference_mm"] == 0.0 for row in replayed["measurements"])
    page, packed = tmp_path / "page.html", tmp_path / "case.zip"
    for words in (["report", folder, "--out", page], ["export", folder, "--out", packed]):
        ended = subprocess.run([AUTOSPINE, *words], capture_output=True, text=True, timeout=280)
        assert ended.returncode == 0, ended.stderr
    text = page.read_text()
    assert "Where the needle points" in text
    assert "guide approach" in text
    assert packed.stat().st_size > 10_000
