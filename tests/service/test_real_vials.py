"""`autospine locate` on every real coronal phantom series: the vials are found in the slices."""

import collections
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from real_slices import DICOM, manifest, needs_large_set

AUTOSPINE = Path(sys.executable).parent / "autospine"
VIALS = 14
SAME_OBJECT_PX = 2.0

pytestmark = [pytest.mark.soak, needs_large_set]


def series_with_vials() -> dict[str, list[str]]:
    paths = [r["path"] for r in manifest() if r["round_object"] == "yes"]
    series = collections.defaultdict(list)
    for path in paths:
        if "/nist_T" in path:
            series[path.rsplit("/", 1)[0]].append(path)
    return series


def objects_of_series(found: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Positions that are seen in at least half of the slices."""
    groups: list[list[np.ndarray]] = []
    for points in found.values():
        for point in points:
            near = [g for g in groups if np.hypot(*(np.median(g, axis=0) - point)) < SAME_OBJECT_PX]
            (near[0] if near else groups).append(point if near else [point])
    return [np.median(g, axis=0) for g in groups if len(g) >= len(found) / 2]


def test_all_vials_are_found_in_at_least_95_percent_of_the_slices():
    complete = total = 0
    for folder, files in series_with_vials().items():
        result = subprocess.run(
            [AUTOSPINE, "locate", DICOM / folder, "--radius-mm", "4,12", "--json"],
            capture_output=True,
            text=True,
            check=True,
        )
        found = {str(DICOM / file): np.empty((0, 2)) for file in files}
        for one in json.loads(result.stdout)["fiducials"]:
            file = one["files"][0]
            found[file] = np.vstack([found[file], [one["row"], one["col"]]])
        objects = objects_of_series(found)
        assert len(objects) >= VIALS
        for points in found.values():
            seen = sum(
                1
                for place in objects
                if len(points) and np.hypot(*(points - place).T).min() < SAME_OBJECT_PX
            )
            complete += seen >= VIALS
            total += 1
    assert total == 80
    assert complete >= 0.95 * total
