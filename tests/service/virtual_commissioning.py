"""A commissioning of the virtual scanner in made-up time: real slices, with the truth known."""

import random
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydicom.dataset import Dataset
from virtual_slices import SCANNER

from dicom_slice.header import slices_of
from dicom_slice.times import TimeFrame
from service.commissioning.evidence import Press, Reception, ScannedSeries, one_series
from simulator.config import SliceProtocol, VirtualRoom
from simulator.dicom_writer import AcquisitionStamp, Series, Study, write_mr_image
from simulator.mr_slice import acquire


@dataclass(frozen=True)
class Truth:
    """offset_s: our clock minus the scanner's; delay_s: of the next slice."""

    offset_s: float
    delay_s: Callable[[], float]
    window: str = "flat"
    polarity: int = 1


class VirtualTechnologist:
    """Scans one series after the other, and presses a little late when it starts and ends."""

    def __init__(self, truth: Truth, dice: random.Random, length_s: float = 1.5) -> None:
        self.truth, self.dice, self.length_s = truth, dice, length_s
        self.now_s = time.time() - 10_000.0
        self.number = 0
        self.study = Study.new(self.now_s)
        self.noise = np.random.default_rng(dice.randrange(2**32))

    def scan(self, n_slices: int, *, reversed_readout: bool = False) -> ScannedSeries:
        sign = -self.truth.polarity if reversed_readout else self.truth.polarity
        room, series = self.begin(sign)
        self.now_s += 20.0
        started = Press("start", self.now_s + self.dice.uniform(-0.2, 0.7))
        receptions = []
        for index in range(n_slices):
            receptions.append(self.one(room, series, index))
            self.now_s += self.length_s + 0.05
        ended = Press("end", self.now_s - 0.05 + self.dice.uniform(-0.2, 0.7))
        return one_series(receptions, started, ended, reversed_readout=reversed_readout)

    def begin(self, readout_sign: int) -> tuple[VirtualRoom, Series]:
        protocol = SliceProtocol(
            window=self.truth.window, readout_polarity=readout_sign, chemical_shift_ppm=3.4
        )
        self.number += 1
        series = Series.new(self.number, "fl2d_cor_guide", ("M", "ND", "NORM"), self.now_s)
        return VirtualRoom(protocol=protocol), series

    def one(self, room: VirtualRoom, series: Series, index: int) -> Reception:
        image = self.image(room, series, index)
        received_s = self.now_s + self.length_s + self.truth.delay_s()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            (header,) = slices_of(image, TimeFrame(None, received_s))
        return Reception(header, image.pixel_array.astype(float), received_s)

    def image(self, room: VirtualRoom, series: Series, index: int) -> Dataset:
        """A slice whose acquisition begins now."""
        by_scanner_s = self.now_s - self.truth.offset_s
        made = acquire(room, {"xt": 0.0, "yt": 0.0}, self.noise)
        stamp = AcquisitionStamp(
            by_scanner_s, self.length_s, self.number, index + 1, by_scanner_s + self.length_s + 0.1
        )
        return write_mr_image(
            np.abs(made.signal),
            made.geometry,
            protocol=room.protocol,
            scanner=SCANNER,
            study=self.study,
            series=series,
            stamp=stamp,
        )

    def session(self) -> list[ScannedSeries]:
        """Five series of the usual kind, and one with the readout's sign changed."""
        usual = [self.scan(4) for _ in range(5)]
        return [*usual, self.scan(4, reversed_readout=True)]
