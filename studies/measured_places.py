"""Where the punctures of a bench study are: typed from a microscope, or photos of the sheets."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from sr_engine.detect import Candidate
from sr_engine.errors import EngineError
from sr_engine.locate import PSF_OBJECTS, Located, likeliest_psf, refine

Places = NDArray[np.float64]  # (n, 2) mm, x and y on the sheet
COLUMNS = ("strategy", "puncture", "x_mm", "y_mm")
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
HOLE_MM = (0.1, 0.8)


def write_form(path: Path, strategies: Sequence[str], punctures: int) -> None:
    """A CSV with empty places, for whoever measures."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows((s, n, "", "") for s in strategies for n in range(1, punctures + 1))


def read_places(
    source: Path,
    strategies: Sequence[str],
    punctures: int,
    px_per_mm: float | None,
    hole_mm: tuple[float, float] = HOLE_MM,
) -> dict[str, Places]:
    """By strategy, from a CSV or from a folder of photos named after the strategies.

    px_per_mm: of the photos; hole_mm: least and largest radius of a hole. ValueError, OSError.
    """
    if not source.is_dir():
        return _of_csv(source, strategies, punctures)
    if px_per_mm is None:
        raise ValueError(f"{source}: the scale of the photos is not known: give --px-per-mm")
    return {
        name: holes_of(_photo(source, name), px_per_mm, punctures, hole_mm) for name in strategies
    }


def _of_csv(path: Path, strategies: Sequence[str], punctures: int) -> dict[str, Places]:
    places = {name: np.full((punctures, 2), np.nan) for name in strategies}
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file)
        if set(COLUMNS) - set(rows.fieldnames or ()):
            raise ValueError(f"{path}: needs the columns {', '.join(COLUMNS)}")
        for row in rows:
            where = f"{path}, line {rows.line_num}"
            try:
                number, x, y = int(row["puncture"]), float(row["x_mm"]), float(row["y_mm"])
            except (ValueError, TypeError):
                raise ValueError(f"{where}: puncture, x_mm and y_mm must be numbers") from None
            if row["strategy"] not in places or not 1 <= number <= punctures:
                raise ValueError(f"{where}: no puncture {number} of {row['strategy']} was made")
            if not np.isfinite([x, y]).all():
                raise ValueError(f"{where}: x_mm and y_mm must be finite")
            if np.isfinite(places[row["strategy"]][number - 1]).any():
                raise ValueError(f"{where}: puncture {number} of {row['strategy']} appears twice")
            places[row["strategy"]][number - 1] = x, y
    for name, found in places.items():
        missing = np.flatnonzero(np.isnan(found[:, 0])) + 1
        if len(missing):
            raise ValueError(f"{path}: {name} has no place of puncture {missing[0]}")
    return places


def _photo(folder: Path, strategy: str) -> Path:
    found = [folder / f"{strategy}{suffix}" for suffix in _SUFFIXES]
    for path in found:
        if path.is_file():
            return path
    raise ValueError(f"{folder}: no photo of the sheet of {strategy} ({strategy}.png, .jpg …)")


def holes_of(
    photo: Path, px_per_mm: float, count: int, hole_mm: tuple[float, float] = HOLE_MM
) -> Places:
    """The dark round holes of a photo of a sheet, (count, 2) mm; ValueError where the count is
    another one."""
    try:
        with Image.open(photo) as image:
            grey = np.asarray(image.convert("L"), dtype=np.float64)
    except OSError as error:
        raise ValueError(f"{photo}: not a readable picture ({error})") from error
    seen = _dark_spots(grey, (hole_mm[0] * px_per_mm, hole_mm[1] * px_per_mm))
    holes: list[Located] = []
    with contextlib.suppress(EngineError):  # nothing to be told from: the count says so
        psf = likeliest_psf(grey, seen[:PSF_OBJECTS])
        for one in seen:
            with contextlib.suppress(EngineError):  # not round after all
                holes.append(refine(grey, one, psf))
    if len(holes) != count:
        raise ValueError(
            f"{photo}: holes found: {len(holes)}, punctures made: {count}; crop it to the sheet, "
            "set --hole-mm, or measure overlapping holes by hand and give a CSV"
        )
    rows_cols = np.array([one.centre_px for one in holes])
    return np.asarray(rows_cols[:, ::-1] / px_per_mm)


def _dark_spots(grey: NDArray[np.float64], radii_px: tuple[float, float]) -> list[Candidate]:
    """What is darker than half way to the paper, and as long as it is wide."""
    paper, dark = np.percentile(grey, 60), grey.min()
    labels, _ = ndimage.label(grey < (paper + dark) / 2)
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        spot = labels[box] == number
        radius = float(np.sqrt(spot.sum() / np.pi))
        long, wide = max(spot.shape), min(spot.shape)
        if radii_px[0] <= radius <= radii_px[1] and long - wide <= 1 + 0.15 * long:
            row, col = ndimage.center_of_mass(spot)
            centre = (float(row) + box[0].start, float(col) + box[1].start)
            found.append(Candidate(centre, radius, 1.0, 1.0, 1.0, float(paper - dark)))
    return found
