"""What goes wrong in a real room, switchable by name. Pure: the dice come in as an argument."""

from collections.abc import Iterable
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from scipy.ndimage import map_coordinates

Floats = NDArray[np.float64]

FAULTS = MappingProxyType(
    {
        "late": "the slice arrives 2 to 4 s after its reconstruction",
        "duplicate": "the same slice is sent twice, byte for byte",
        "out_of_order": "the slice is held back until after the next one has been sent",
        "missing": "the slice is acquired but never sent",
        "corrupted": "the pixel data are truncated, or a block of them is overwritten",
        "wrong_orientation": "the operator acquires an axial slice instead",
        "clock_jump": "the scanner's clock jumps once, by 5 s to 1 h, forward or back",
        "extra_series": "a localizer, a phase image and a distortion-corrected copy come with it",
        "motion_during_scan": "an unrequested acquisition runs while the robot moves",
    }
)


def switched_on(path: str) -> frozenset[str]:
    """The faults that a file names, one a line; none if there is no such file."""
    if not path:
        return frozenset()
    try:
        names = Path(path).read_text(encoding="ascii", errors="replace").split()
    except FileNotFoundError:
        return frozenset()
    return frozenset(names) & frozenset(FAULTS)


def strike(names: Iterable[str], probability: float, rng: np.random.Generator) -> frozenset[str]:
    """The faults that befall one acquisition: each of `names` by its own throw."""
    return frozenset(name for name in sorted(names) if rng.random() < probability)


def jumped_clock_s(rng: np.random.Generator) -> float:
    """By how much the scanner's clock jumps: 5 s to 1 h, either way, all scales alike."""
    size_s = float(np.exp(rng.uniform(np.log(5.0), np.log(3600.0))))
    return size_s if rng.random() < 0.5 else -size_s


def corrupt(dataset: Dataset, centre_px: tuple[float, float], rng: np.random.Generator) -> None:
    """Spoil the pixel data in place: cut short, or overwritten around `centre_px` (row, col)."""
    if rng.random() < 0.5:
        kept = int(len(dataset.PixelData) * rng.uniform(0.2, 0.9)) // 2 * 2
        dataset.PixelData = dataset.PixelData[:kept]
        return
    stored = np.frombuffer(dataset.PixelData, "<u2").reshape(dataset.Rows, dataset.Columns).copy()
    top = max(0, round(centre_px[0]) - int(rng.integers(2, 12)))
    left = max(0, round(centre_px[1]) - int(rng.integers(2, 12)))
    block = stored[top : top + 16, left : left + 16]
    block[...] = rng.integers(0, 4096, block.shape)
    dataset.PixelData = stored.tobytes()


def phase_of(signal: NDArray[np.complex128]) -> Floats:
    """The phase image of a complex slice, radians in (-π, π], with a smooth B0 ramp."""
    rows, cols = signal.shape
    ramp = np.linspace(-1.0, 1.0, rows)[:, None] + np.linspace(0.0, 0.7, cols)[None, :]
    return np.angle(signal * np.exp(1j * ramp))


def distorted(magnitude: Floats, pixels: float = 0.6) -> Floats:
    """A distortion-corrected twin: the same slice, resampled, up to `pixels` px at the border."""
    rows, cols = (np.arange(n, dtype=float) for n in magnitude.shape)
    stretch = [
        1 + pixels / (n / 2) * ((axis / (n / 2) - 1) ** 2)
        for axis, n in ((rows, len(rows)), (cols, len(cols)))
    ]
    middle = [(n - 1) / 2 for n in magnitude.shape]
    source = np.meshgrid(
        middle[0] + (rows - middle[0]) * stretch[0],
        middle[1] + (cols - middle[1]) * stretch[1],
        indexing="ij",
    )
    return np.maximum(map_coordinates(magnitude, source, order=3, mode="nearest"), 0.0)
