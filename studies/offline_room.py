"""The virtual room without processes, network or clocks: carries out the steps of a procedure.

Stages, slices and the engine are those of the whole room; only what connects them is left out, and
nobody waits. Procedures run in it as fast as the machine goes, and the truth is at hand.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from case_record.rows import SliceRow
from dicom_slice.geometry import SliceGeometry
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP
from service.procedure.observe import ABORT
from service.procedure.plan import PLAN_VOID, why_void
from service.procedure.plane import ImagePlane
from service.procedure.steps import (
    Acquire,
    Acquired,
    Answered,
    AskOperator,
    Measure,
    Measured,
    Moved,
    MoveTo,
    Outcome,
    ProcedureSteps,
    Step,
)
from service.room.measuring import measure_request, measured_from_result
from simulator.camera import Camera, photograph
from simulator.config import VirtualRoom
from simulator.mr_slice import acquire, slice_geometry
from simulator.scene import true_fiducial_mm
from simulator.stage_physics import PiezoLegsStage, StageParameters
from sr_engine.errors import EngineError
from sr_engine.psf import Psf
from sr_engine.request import localize_request
from sr_engine.result import describe_result
from sr_engine.views import Frames, Templates, View

Array = NDArray[np.float64]
Result = TypeVar("Result")
_DRIVE_HZ = 1000.0
_CORRECTIONS, _CLOSE_UM = 6, 1.5


@dataclass(frozen=True, eq=False)
class SeenSlice:
    """What one acquisition gives: magnitude pixels (rows, cols) and where they lie."""

    pixels: Array
    geometry: SliceGeometry
    row: SliceRow


class Imaging(Protocol):
    """A scanner or a camera: looks at the room, and knows where the fiducial truly is.

    frame_s: what one image costs; psf: its point spread, None for the engine's
    default; model_sigma_px: how far that may mislead the maximum-likelihood fit, per axis.
    """

    @property
    def frame_s(self) -> float: ...

    @property
    def psf(self) -> Psf | None: ...

    @property
    def model_sigma_px(self) -> float: ...

    def look(
        self,
        stage_mm: Mapping[str, float],
        rng: np.random.Generator,
        slice_position_mm: float | None = None,
    ) -> tuple[Array, SliceGeometry]: ...

    def true_plane_mm(self, stage_mm: Mapping[str, float]) -> Array:
        """The fiducial's true position (2,) in the image plane, mm along rows and columns."""
        ...


@dataclass(frozen=True)
class MrImaging:
    """The virtual scanner; `frame_s` is what one slice costs."""

    room: VirtualRoom
    frame_s: float = 150.0
    psf: Psf | None = None
    model_sigma_px: float = 0.0

    def look(
        self,
        stage_mm: Mapping[str, float],
        rng: np.random.Generator,
        slice_position_mm: float | None = None,
    ) -> tuple[Array, SliceGeometry]:
        taken = acquire(self.room, stage_mm, rng, slice_position_mm=slice_position_mm)
        return taken.magnitude, taken.geometry

    def true_plane_mm(self, stage_mm: Mapping[str, float]) -> Array:
        return _true_plane_mm(self.room, stage_mm)


@dataclass(frozen=True)
class CameraImaging:
    """The benchtop camera over the same stages."""

    room: VirtualRoom
    camera: Camera = field(default_factory=Camera)
    frame_s: float = 27.6
    # what comes nearest to the camera's pixel and the interpolation together, and what it misses
    # (at SNR 10 to 30; the reported covariance is then honest)
    psf: Psf | None = field(default_factory=lambda: Psf("gaussian", (0.3,)))
    model_sigma_px: float = 0.010

    def look(
        self,
        stage_mm: Mapping[str, float],
        rng: np.random.Generator,
        slice_position_mm: float | None = None,
    ) -> tuple[Array, SliceGeometry]:
        return photograph(self.room, stage_mm, self.camera, rng)

    def true_plane_mm(self, stage_mm: Mapping[str, float]) -> Array:
        return _true_plane_mm(self.room, stage_mm)


def _true_plane_mm(room: VirtualRoom, stage_mm: Mapping[str, float]) -> Array:
    plane = plane_of(slice_geometry(room.protocol))
    return plane.from_patient(true_fiducial_mm(room, stage_mm).tolist())


class OfflineRoom:
    """Without encoders, as in the default room, a readback is the count of the steps sent; with
    them, what they read.

    region_px: (r0, c0, r1, c1), where the fiducial is looked for while its place is not known;
    answer: what the operator says to a question; confirms by default, and never rescans.
    """

    def __init__(
        self,
        imaging: Imaging,
        stages: StageParameters,
        seed: int,
        *,
        axes: tuple[str, ...] = ("xt", "yt"),
        radius_mm: tuple[float, float] = (2.5, 6.5),
        region_px: tuple[float, float, float, float] | None = None,
        answer: Callable[[AskOperator], str] | None = None,
    ) -> None:
        self.imaging = imaging
        self.stages = {
            axis: PiezoLegsStage(stages, 0.0, random.Random(f"{seed}/{axis}")) for axis in axes
        }
        self.setpoints_um = dict.fromkeys(axes, 0)
        # what the bridge is configured with, whatever the motors really are
        self.nominal_step_um = dict.fromkeys(axes, stages.step_um)
        self.nominal_mounting = dict.fromkeys(axes, stages.mounting)
        self.stop_next_moves = 0
        self.moves: list[dict[str, int]] = []
        self.frames = 0
        self.scan_s = 0.0
        self._rng = np.random.default_rng(seed)
        self._radius_mm = radius_mm
        self._region_px = region_px
        self._answer = answer or _agree
        self._slices: dict[int, list[SeenSlice]] = {1: []}
        self._measurements = 0
        self._views: dict[int, View] = {}
        self._templates = Templates()

    @property
    def stage_mm(self) -> dict[str, float]:
        """True positions of the stages."""
        return {axis: stage.position_um / 1000.0 for axis, stage in self.stages.items()}

    @property
    def true_plane_mm(self) -> Array:
        return self.imaging.true_plane_mm(self.stage_mm)

    def run(self, procedure: ProcedureSteps[Result]) -> Result:
        """Carry a procedure to its end; what it raises comes through."""
        try:
            step = next(procedure)
            while True:
                step = procedure.send(self.execute(step))
        except StopIteration as finished:
            result: Result = finished.value
            return result

    def execute(self, step: Step, command_id: str = "") -> Outcome:
        if isinstance(step, MoveTo):
            return self._move(step)
        if isinstance(step, Acquire):
            return self._acquire(step)
        if isinstance(step, Measure):
            return self._measure(step)
        return Answered(self._answer(step), "operator")

    def _move(self, step: MoveTo) -> Moved:
        if step.from_um is not None:
            void = why_void(step.from_um, step.rests_on, self.setpoints_um, self._measurements)
            if void:
                hold_id = max(self._slices)
                return Moved("REFUSED", PLAN_VOID, void, hold_id, dict(self.setpoints_um))
        self.moves.append(dict(step.setpoints_um))
        reached = 1.0
        if self.stop_next_moves:
            self.stop_next_moves -= 1
            reached = 0.5
        for axis, setpoint_um in step.setpoints_um.items():
            change_um = round(reached * (setpoint_um - self.setpoints_um[axis]))
            steps = change_um * self.nominal_mounting[axis] / self.nominal_step_um[axis]
            drive(self.stages[axis], steps)
            self.setpoints_um[axis] += change_um
            if self.stages[axis].parameters.has_encoder and reached == 1.0:
                self.setpoints_um[axis] = self._close_loop(axis, setpoint_um)
        hold_id = max(self._slices) + 1
        self._slices[hold_id] = []
        if reached < 1.0:
            return Moved("STOPPED", "stopped", "STOP", hold_id, dict(self.setpoints_um))
        return Moved("DONE", "", "", hold_id, dict(self.setpoints_um))

    def _close_loop(self, axis: str, setpoint_um: int) -> int:
        """Correct by what the encoder says; what it reads at the end."""
        stage, mounting = self.stages[axis], self.nominal_mounting[axis]
        read_um = 0.0
        for _ in range(_CORRECTIONS):
            read_um = mounting * (stage.read_encoder_um() or 0.0)
            if abs(setpoint_um - read_um) <= _CLOSE_UM:
                break
            drive(stage, (setpoint_um - read_um) * mounting / self.nominal_step_um[axis])
        else:
            read_um = mounting * (stage.read_encoder_um() or 0.0)
        return round(read_um)

    def _acquire(self, step: Acquire) -> Acquired:
        if step.fresh:
            self._slices[max(self._slices) + 1] = []
        hold_id = max(self._slices)
        slices = self._slices[hold_id]
        while len(_at_position(slices, step.slice_position_mm)) < step.count:
            pixels, geometry = self.imaging.look(self.stage_mm, self._rng, step.slice_position_mm)
            slices.append(SeenSlice(pixels, geometry, self._row(hold_id)))
        return Acquired(hold_id, step.count)

    def _row(self, hold_id: int) -> SliceRow:
        """What the record would hold of the next slice; time is the scanner's alone."""
        begin_s = self.scan_s
        self.frames += 1
        self.scan_s += self.imaging.frame_s
        return SliceRow(
            sop_instance_uid=f"2.25.{self.frames}",
            frame=0,
            sha256="",
            path="",
            state="assigned",
            hold_id=hold_id,
            reason_code="",
            reason="",
            received_s=self.scan_s,
            received_monotonic_s=self.scan_s,
            acquired_from_s=begin_s,
            acquired_to_s=self.scan_s,
            time_source="simulated",
            header={},
            slice_id=self.frames,
        )

    def _measure(self, step: Measure) -> Measured:
        self._measurements += 1
        taken = [
            (one, hold.shift_mm)
            for hold in step.holds
            for one in _at_position(self._slices[hold.hold_id], step.slice_position_mm)
        ]
        geometry = taken[0][0].geometry
        frames = Frames(
            np.array([one.pixels for one, _ in taken]),
            np.array([shift_mm for _, shift_mm in taken]) / np.array(geometry.spacing_mm),
            geometry,
            tuple(one.row for one, _ in taken),
        )
        views = [self._views[number] for number in step.template]
        try:
            request = measure_request(step, self._radius_mm, self._region_px)
            found = localize_request(
                frames, step.method, request, self.imaging.psf, views, self._templates
            )
        except EngineError as error:
            return Measured(self._measurements, error.reason, str(error))
        self._views[self._measurements] = View(self._measurements, frames, found.by.centre_px)
        if found.by.method == "ml":
            doubt = np.eye(2) * self.imaging.model_sigma_px**2
            by = replace(found.by, covariance_px2=found.by.covariance_px2 + doubt)
            found = replace(found, by=by)
        return measured_from_result(self._measurements, describe_result(frames, found))


def drive(stage: PiezoLegsStage, steps: float) -> None:
    """One open-loop run of so many waveform steps; the sign is the motor's direction."""
    microsteps = round(steps * MICROSTEPS_PER_STEP)
    if microsteps == 0:
        return
    stage.unpark()
    stage.begin_run()
    stage.drive(microsteps, _DRIVE_HZ)
    stage.park()


def plane_of(geometry: SliceGeometry) -> ImagePlane:
    return ImagePlane(geometry.row_direction, geometry.col_direction, geometry.spacing_mm)


def _at_position(slices: list[SeenSlice], position_mm: float | None) -> list[SeenSlice]:
    """Those whose middle lies there along their normal; None: all."""
    if position_mm is None:
        return slices
    return [
        one
        for one in slices
        if abs(float(one.geometry.normal @ one.geometry.position_mm) - position_mm) <= 0.5
    ]


def _agree(question: AskOperator) -> str:
    return ABORT if ABORT in question.choices else question.choices[0]
