"""The virtual scanner: real seconds pass while it acquires, and it has a clock of its own.

The stages are wherever they truly are meanwhile. What it has reconstructed goes to the outbox, and
whatever it acquires is written down with its truth.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pydicom.dataset import Dataset

from simulator.config import ScannerSettings, VirtualRoom, VirtualRoomError
from simulator.dicom_writer import AcquisitionStamp, Series, Study, write_mr_image
from simulator.enhanced_writer import write_enhanced_mr_image
from simulator.faults import corrupt, distorted, jumped_clock_s, phase_of, strike, switched_on
from simulator.mr_slice import AcquiredSlice, StagePath, acquire
from simulator.outbox import Outbox
from simulator.truth_client import TruthAddress, TruthError, ask_path, ask_where
from simulator.truth_file import TruthFile

Note = Callable[[str], None]

_HELD_BACK_AT_MOST_S = 2.5
_DUPLICATE_AFTER_S = 0.1


class AcquisitionRequest(BaseModel):
    """What the service's page asks the operator to acquire; other fields are for people."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    request_id: str
    hold_id: int | None = None
    count: int = Field(default=1, ge=1, le=1000)
    slice_position_mm: float | None = Field(default=None, allow_inf_nan=False)
    case_uid: str = ""


@dataclass(frozen=True, eq=False)
class Scan:
    """One acquisition as it was: interval on our clock, what it shows, what befell it."""

    request: AcquisitionRequest | None
    index: int
    started_s: float
    ended_s: float
    slice: AcquiredSlice
    faults: frozenset[str]


class VirtualScanner:
    """Owns the scanner's clock, its numbering, its examination and its outbox."""

    def __init__(self, room: VirtualRoom, truth: TruthFile, outbox: Outbox, note: Note) -> None:
        if room.scanner is None:
            raise VirtualRoomError("virtual.scanner: missing table")
        self._room = room
        self._settings: ScannerSettings = room.scanner
        self._truth = truth
        self._outbox = outbox
        self._note = note
        # Acquisitions after a restart do not repeat the noise of those before.
        noise, dice = np.random.SeedSequence([room.seed, truth.earlier_lines]).spawn(2)
        self._noise = np.random.default_rng(noise)
        self._dice = np.random.default_rng(dice)
        self._address = TruthAddress(
            self._settings.motors_truth_host, self._settings.motors_truth_port
        )
        self._switched_on_s = time.time()
        self._jump_s = 0.0
        self._study = Study.new(self.clock_s(self._switched_on_s))
        self._case_uid = ""
        # a scanner that was restarted goes on counting: each acquisition has left a line, and more
        self._acquisitions = self._series = truth.earlier_lines
        self._last_stage_mm: dict[str, float] | None = None
        self._held_back: list[Dataset] = []
        self._held_back_since_s = 0.0

    def clock_s(self, our_time_s: float) -> float:
        """What the scanner's clock shows at an instant of ours."""
        drift_s = 1e-6 * self._settings.clock_drift_ppm * (our_time_s - self._switched_on_s)
        return our_time_s + self._settings.clock_offset_s + drift_s + self._jump_s

    def serve(self, request: AcquisitionRequest, stop: threading.Event) -> None:
        """Acquire the slices that were asked for, one series; raises TruthError."""
        self._examine(request.case_uid)
        series = self._new_series("fl2d_cor_guide", ("M", "ND", "NORM"))
        for index in range(request.count):
            if index:
                stop.wait(self._settings.gap_s)
            scan = self._scan(request, index, stop)
            if stop.is_set():
                return
            self._send(scan, series)

    def _examine(self, case_uid: str) -> None:
        """Each case is an examination of a patient of its own."""
        if not case_uid or case_uid == self._case_uid:
            return
        self._case_uid = case_uid
        table = str(self._room.placement.origin_mm)
        started_s = self.clock_s(time.time())
        self._study = Study.of_examination(case_uid, table, started_s)

    def scan_if_moving(self, stop: threading.Event) -> bool:
        """With the fault: acquire unasked if the robot is just moving; whether it did so."""
        name = "motion_during_scan"
        switched_on = name in self._switched_on()
        if not switched_on and name not in self._room.faults:
            return False
        if not ask_where(self._address).moving or not (switched_on or self._strikes(name)):
            return False
        scan = self._scan(None, 0, stop, frozenset({"motion_during_scan"}))
        self._send(scan, self._new_series("fl2d_cor_guide", ("M", "ND", "NORM")))
        return True

    def release_held_back(self) -> None:
        """Send what was to come after the next slice if there was no next slice for long."""
        if self._held_back and time.monotonic() - self._held_back_since_s > _HELD_BACK_AT_MOST_S:
            self._push_held_back(time.monotonic())

    def _scan(
        self,
        request: AcquisitionRequest | None,
        index: int,
        stop: threading.Event,
        faults: frozenset[str] | None = None,
    ) -> Scan:
        if faults is None:
            befallen = strike(self._room.faults, self._room.fault_probability, self._dice)
            faults = (befallen | self._switched_on()) - {"motion_during_scan"}
        if "clock_jump" in faults and self._jump_s == 0:
            self._jump_s = jumped_clock_s(self._dice)
            self._truth.write("clock_jump", by_s=self._jump_s)
        started_s, began_s = time.time(), time.monotonic()
        stop.wait(self._settings.acquisition_s)
        ended_s = started_s + time.monotonic() - began_s
        axial = "wrong_orientation" in faults
        acquired = acquire(
            self._room,
            self._path(started_s, ended_s),
            self._noise,
            slice_position_mm=request.slice_position_mm if request and not axial else None,
            orientation="axial" if axial else None,
            interval_s=(started_s, ended_s),
        )
        return Scan(request, index, started_s, ended_s, acquired, faults)

    def _path(self, started_s: float, ended_s: float) -> StagePath:
        """What the stages did meanwhile. Without power they stand where they stood."""
        try:
            path = ask_path(self._address, started_s, ended_s)
        except TruthError as error:
            if self._last_stage_mm is None:
                raise
            self._note(f"{error}; the stages are assumed to be where they were")
            return StagePath.standing(self._last_stage_mm)
        self._last_stage_mm = path.at(ended_s)
        return path

    def _send(self, scan: Scan, series: Series) -> None:
        """Reconstruct: after a while the slice is in the outbox, with whatever goes wrong on it."""
        self._acquisitions += 1
        ready_s = time.monotonic() + self._settings.reconstruction_s
        dataset = self._image(scan, series, scan.slice.magnitude)
        if "corrupted" in scan.faults:
            corrupt(dataset, self._centre_px(scan), self._dice)
        self._record(scan, series, dataset)
        extras = self._extra_images(scan) if "extra_series" in scan.faults else []
        # Vendors send them before or after the slice itself.
        after = int(self._dice.integers(0, len(extras) + 1))
        for extra in extras[:after]:
            self._outbox.push(extra, ready_s)
        self._push(scan, dataset, ready_s)
        for extra in extras[after:]:
            self._outbox.push(extra, ready_s)

    def _push(self, scan: Scan, dataset: Dataset, ready_s: float) -> None:
        if "missing" in scan.faults:
            pass
        elif "out_of_order" in scan.faults:
            self._held_back.append(dataset)
            self._held_back_since_s = time.monotonic()
            return
        else:
            due_s = ready_s + (self._dice.uniform(2, 4) if "late" in scan.faults else 0.0)
            self._outbox.push(dataset, due_s)
            if "duplicate" in scan.faults:
                self._outbox.push(dataset, due_s + _DUPLICATE_AFTER_S)
        self._push_held_back(ready_s)

    def _push_held_back(self, after_s: float) -> None:
        for dataset in self._held_back:
            self._outbox.push(dataset, after_s + 1e-3)
        self._held_back.clear()

    def _extra_images(self, scan: Scan) -> list[Dataset]:
        """What vendors send along without being asked."""
        localizer_room = self._room.model_copy(update={"protocol": _localizer_protocol(self._room)})
        planes = self._new_series("localizer", ("M", "ND", "LOCALIZER"))
        images = []
        for index, plane in enumerate(("coronal", "axial", "sagittal")):
            seen = acquire(localizer_room, scan.slice.stage_mm, self._noise, orientation=plane)
            extra = Scan(scan.request, index, scan.started_s, scan.ended_s, seen, scan.faults)
            images.append(self._image(extra, planes, seen.magnitude, localizer_room))
        phase = self._new_series("fl2d_cor_guide", ("P", "ND"))
        images.append(self._image(scan, phase, phase_of(scan.slice.signal)))
        twin = self._new_series("fl2d_cor_guide", ("M", "DIS2D", "NORM"))
        images.append(self._image(scan, twin, distorted(scan.slice.magnitude)))
        for image in images:
            image_type = "\\".join(image.ImageType)
            uid = str(image.SOPInstanceUID)
            self._truth.write("extra", sop_instance_uid=uid, image_type=image_type)
        return images

    def _image(
        self,
        scan: Scan,
        series: Series,
        pixels: np.ndarray[Any, np.dtype[np.float64]],
        room: VirtualRoom | None = None,
    ) -> Dataset:
        stamp = AcquisitionStamp(
            started_s=self.clock_s(scan.started_s),
            duration_s=scan.ended_s - scan.started_s,
            acquisition_number=self._acquisitions,
            instance_number=scan.index + 1,
            reconstructed_s=self.clock_s(scan.ended_s) + self._settings.reconstruction_s,
        )
        enhanced = self._settings.sop_class == "enhanced"
        write = write_enhanced_mr_image if enhanced else write_mr_image
        return write(
            pixels,
            scan.slice.geometry,
            protocol=(room or self._room).protocol,
            scanner=self._settings,
            study=self._study,
            series=series,
            stamp=stamp,
        )

    def _new_series(self, description: str, image_type: tuple[str, ...]) -> Series:
        self._series += 1
        return Series.new(self._series, description, image_type, self.clock_s(time.time()))

    def _switched_on(self) -> frozenset[str]:
        """The faults that somebody switched on while the room runs."""
        return switched_on(self._settings.faults_file)

    def _strikes(self, fault: str) -> bool:
        return bool(strike([fault], self._room.fault_probability, self._dice))

    def _centre_px(self, scan: Scan) -> tuple[float, float]:
        row, col = scan.slice.centres_px[self._room.fiducials[0].name]
        return float(row), float(col)

    def _record(self, scan: Scan, series: Series, dataset: Dataset) -> None:
        self._truth.write(
            "acquisition",
            request_id=scan.request.request_id if scan.request else None,
            hold_id=scan.request.hold_id if scan.request else None,
            index=scan.index,
            sop_instance_uid=str(dataset.SOPInstanceUID),
            series_uid=series.series_uid,
            acquisition_number=self._acquisitions,
            started_s=scan.started_s,
            ended_s=scan.ended_s,
            scanner_clock_s=self.clock_s(scan.started_s),
            stage_mm=scan.slice.stage_mm,
            travel_mm=scan.slice.travel_mm,
            fiducials={
                name: {
                    "patient_mm": scan.slice.fiducials_mm[name],
                    "centre_px": scan.slice.centres_px[name],
                    "in_slice": name in scan.slice.in_slice,
                }
                for name in scan.slice.fiducials_mm
            },
            faults=sorted(scan.faults),
        )


def _localizer_protocol(room: VirtualRoom) -> Any:
    return room.protocol.model_copy(update={"spacing_mm": (2.5, 2.5), "thickness_mm": 8.0})
