"""What goes wrong in a real room, switchable by name. Pure: the dice come in as an argument."""

from collections.abc import Iterable
from types import MappingProxyType

import numpy as np

FAULTS = MappingProxyType(
    {
        "late": "the slice arrives 2 to 4 s after its reconstruction",
        "duplicate": "the same slice is sent twice, byte for byte",
        "out_of_order": "the slice is held back until after the next one has been sent",
        "missing": "the slice is acquired and never sent",
        "corrupted": "the pixel data are cut short, or a block of them is overwritten",
        "wrong_orientation": "the operator acquires an axial slice instead",
        "clock_jump": "the scanner's clock jumps once, by 5 s to 1 h, forward or back",
        "extra_series": "a localizer, a phase image and a distortion-corrected twin come with it",
        "motion_during_scan": "an acquisition that nobody asked for runs while the robot moves",
    }
)


def strike(names: Iterable[str], probability: float, rng: np.random.Generator) -> frozenset[str]:
    """The faults that befall one acquisition: each of `names` by its own throw."""
    return frozenset(name for name in sorted(names) if rng.random() < probability)
