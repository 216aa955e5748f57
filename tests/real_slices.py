"""Real MR slices for the tests: the large set where it lies beside the project, else the small one.

The small set (`data/real_slices`, public files with their licences) is a part of the large one,
under the same names and with the same columns in `manifest.csv`.
"""

import csv
from functools import cache
from pathlib import Path

import pytest

SMALL_SET = Path(__file__).parent / "data" / "real_slices"
LARGE_SET = Path(__file__).parents[2] / "shared" / "dicom"
IS_LARGE_SET = (LARGE_SET / "manifest.csv").is_file()
DICOM = LARGE_SET if IS_LARGE_SET else SMALL_SET

needs_large_set = pytest.mark.skipif(
    not IS_LARGE_SET, reason=f"needs the large set of real slices ({LARGE_SET})"
)


@cache
def manifest() -> list[dict[str, str]]:
    with (DICOM / "manifest.csv").open(newline="") as file:
        return list(csv.DictReader(file))
