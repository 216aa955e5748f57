"""What was found, drawn over the slices, as one PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from dicom_slice.read import Frame
from sr_engine.localization import Localization
from sr_engine.locate import Located

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle

_MOST_PANELS = 16
_PANEL_INCHES = 4.5


def write_overlay(
    path: Path, shown: Sequence[tuple[Frame, Sequence[Localization | Located]]]
) -> None:
    """Write a PNG with a panel a slice (at most 16), each object with its centre and radius."""
    panels = shown[:_MOST_PANELS]
    columns = math.ceil(math.sqrt(len(panels)))
    rows = math.ceil(len(panels) / columns)
    figure, axes = plt.subplots(
        rows,
        columns,
        figsize=(columns * _PANEL_INCHES, rows * _PANEL_INCHES),
        squeeze=False,
        layout="constrained",
    )
    for place in axes.flat:
        place.set_axis_off()
    for place, ((header, pixels), found) in zip(axes.flat, panels, strict=False):
        low, high = np.percentile(pixels, (1, 99.5))
        place.imshow(pixels, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        for one in found:
            row, col = one.centre_px
            place.add_patch(Circle((col, row), one.radius_px, fill=False, color="#ffb000", lw=1))
            place.plot(col, row, "+", color="#00c8ff", ms=6)
        place.set_title(f"{header.series_description or 'slice'}: {len(found)} round", fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)
