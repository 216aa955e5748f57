"""Writes docs/vendors.md from real MR files: `python docs/make_vendors.py [FOLDER]`.

FOLDER holds the files and their `manifest.csv`; by default the set that lies beside the project.
"""

from __future__ import annotations

import csv
import sys
from collections import Counter, defaultdict
from pathlib import Path

from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.header import Slice, read_header
from dicom_slice.pixels import check_pixels
from dicom_slice.reasons import UnusableError

HERE = Path(__file__).parent
_BESIDE = HERE.parents[1] / "shared" / "dicom"
_RULES = SliceRules(coronal_tolerance_deg=None)
_WORDS_SHOWN = 2
_HEAD = """# Vendors

What becomes of real files of many scanners: of each set the frames that are used, those that are
set aside and in which words, and where the acquisition's time and length come from. Orientation is
left aside here: a room uses coronal slices alone. This page is written by
`python docs/make_vendors.py` from {n_files} files in {n_sets} sets (public data; sources and
licences stand in their `manifest.csv`).

| set | scanner | files | frames used | set aside | time from | length from |
| --- | --- | --- | --- | --- | --- | --- |
"""
_TAIL = """
*Length from*: `header` is AcquisitionDuration, FrameAcquisitionDuration or the vendor's own
element; `estimate` is RepetitionTime x phase-encoding steps x averages, which counts for no proof;
`none` means that the header does not say: such a slice may have lasted `longest_acquisition_s`.
"""


class FileSet:
    """What is counted of one folder of files."""

    def __init__(self) -> None:
        self.scanners: Counter[str] = Counter()
        self.files = self.used = 0
        self.aside: dict[str, Counter[str]] = defaultdict(Counter)
        self.times: Counter[str] = Counter()
        self.lengths: Counter[str] = Counter()

    def take(self, path: Path, scanner: str) -> None:
        self.files += 1
        self.scanners[scanner] += 1
        try:
            slices = read_header(path)
            broken = check_pixels(path, slices)
        except UnusableError as error:
            words = error.reason.text.replace(str(path), path.name)
            self.aside[str(error.reason.code)][words] += 1
            return
        for slice_ in slices:
            reason = why_not_usable(slice_, _RULES)
            if reason is None and slice_.frame in broken:
                reason = broken[slice_.frame].reason
            if reason is not None:
                self.aside[str(reason.code)][reason.text] += 1
                continue
            self.used += 1
            self.times[_time_of(slice_)] += 1
            self.lengths[_length_of(slice_)] += 1

    def row(self, name: str) -> str:
        aside = "; ".join(
            f"{sum(words.values())} `{code}`: " + " / ".join(list(words)[:_WORDS_SHOWN])
            for code, words in self.aside.items()
        )
        cells = [
            name,
            ", ".join(self.scanners),
            str(self.files),
            str(self.used),
            aside.replace("|", "\\|") or "none",
            ", ".join(self.times) or "-",
            ", ".join(self.lengths) or "-",
        ]
        return "| " + " | ".join(cells) + " |"


def _time_of(slice_: Slice) -> str:
    if slice_.interval is None:
        return f"none ({slice_.time_problem})" if slice_.time_problem else "none"
    return slice_.interval.source


def _length_of(slice_: Slice) -> str:
    if slice_.interval is None or slice_.interval.end_s is None:
        return "none"
    return "estimate" if slice_.interval.estimated else "header"


def render(folder: Path) -> str:
    """The page, from a folder of files with a `manifest.csv` (path, manufacturer, model)."""
    sets: dict[str, FileSet] = defaultdict(FileSet)
    with (folder / "manifest.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            name = "/".join(row["path"].split("/")[:-1])
            scanner = " ".join(filter(None, (row["manufacturer"], row["model"]))) or "not said"
            sets[name].take(folder / row["path"], scanner)
    n_files = sum(files.files for files in sets.values())
    rows = "\n".join(files.row(name) for name, files in sorted(sets.items()))
    return _HEAD.format(n_files=n_files, n_sets=len(sets)) + rows + "\n" + _TAIL


if __name__ == "__main__":
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else _BESIDE
    (HERE / "vendors.md").write_text(render(source), encoding="utf-8")
