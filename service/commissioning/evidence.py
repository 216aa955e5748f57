"""What a commissioning saw: slices as they came, and when the technologist pressed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dicom_slice.header import Slice
from dicom_slice.times import AcquisitionInterval


class CommissioningError(Exception):
    """The commissioning cannot go on or be judged; one line that says what to do."""

    exit_code = 3


@dataclass(frozen=True)
class Press:
    """The technologist pressed, by our clock: a series has just started, or has just ended."""

    kind: Literal["start", "end"]
    at_s: float


@dataclass(frozen=True, eq=False)
class Reception:
    """A usable slice, and when it came by our clock; pixels (rows, cols) of the magnitude."""

    header: Slice
    pixels: NDArray[np.float64]
    received_s: float

    @property
    def interval(self) -> AcquisitionInterval:
        """Raises CommissioningError where the header does not say when it was acquired."""
        interval = self.header.interval
        if interval is None:
            why = self.header.time_problem or "the header has no acquisition time"
            raise CommissioningError(f"slice {self.header.sop_instance_uid}: {why}")
        return interval


@dataclass(frozen=True, eq=False)
class ScannedSeries:
    """One series between its two presses. reversed_readout: with the readout's sign changed."""

    receptions: tuple[Reception, ...]
    started: Press
    ended: Press
    reversed_readout: bool = False

    @property
    def protocol(self) -> str:
        return self.receptions[0].header.series_description or "without a name"


def one_series(
    receptions: Sequence[Reception], started: Press, ended: Press, *, reversed_readout: bool = False
) -> ScannedSeries:
    """What came for one pair of presses.

    Raises CommissioningError where nothing came, or several series did.
    """
    if not receptions:
        raise CommissioningError("no slice arrived: does the scanner send to this computer?")
    numbers = {r.header.series_instance_uid for r in receptions}
    if len(numbers) > 1:
        raise CommissioningError(
            f"slices of {len(numbers)} series arrived between two key presses: start one at a time"
        )
    in_order = sorted(receptions, key=lambda r: r.interval.start_s)
    return ScannedSeries(tuple(in_order), started, ended, reversed_readout)
