"""What receivers of OpenIGTLink are shown of the room: state in, messages by device name out.

| device | type | what |
| --- | --- | --- |
| AutoSPINe | STATUS | what is going on; not ready while the robot does not answer |
| Fiducials | POINT | the fiducials where they were measured last, in their size |
| Targets | POINT | target and entry, if they are set |
| NeedleGuide | TRANSFORM | needle tip and direction (its z axis) once two fiducials tell them |
| Slice | IMAGE | the newest slice |
| SuperResolution | IMAGE | the newest reconstruction |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from case_record.record import CaseRecord
from dicom_slice.geometry import SliceGeometry
from service.room.images import ImageMissingError, reconstruction_pixels, slice_pixels
from service.room.state import ArrivalState, ReconstructionState, RoomState, SliceState
from service.slicer.messages import (
    STATUS_NOT_READY,
    STATUS_OK,
    Point,
    image,
    points,
    status,
    transform,
)

Array = NDArray[np.float64]
Scene = dict[str, bytes]

_FIDUCIAL_RGB, _TARGET_RGB, _ENTRY_RGB = (255, 200, 0), (0, 255, 120), (0, 160, 255)


def scene_of(state: RoomState) -> Scene:
    """Everything but the images. A list that has become empty is sent as such."""
    scene = {
        "AutoSPINe": _status(state),
        "Fiducials": points("Fiducials", _measured_s(state), _fiducials(state)),
        "Targets": points("Targets", state.at_s, _targets(state)),
    }
    if state.arrival is not None and state.arrival.tip_mm is not None:
        scene["NeedleGuide"] = _needle(state.at_s, state.arrival)
    return scene


def stale_scene(state: RoomState) -> Scene:
    """Only that nobody knows what the room does now; its needle guide is nowhere known."""
    text = "The control loop does not say what the room is doing."
    return {"AutoSPINe": status("AutoSPINe", state.at_s, STATUS_NOT_READY, "STALE", text)}


class Images:
    """The images of a scene, each encoded once."""

    def __init__(self) -> None:
        self._shown: dict[str, tuple[int, bytes]] = {}

    def of(self, state: RoomState, record: CaseRecord) -> Scene:
        """Reads the record and files; what is not there any more is left out."""
        if state.slice is not None:
            shown = state.slice
            at_s = shown.acquired_to_s or shown.received_s
            self._show("Slice", shown.slice_id, at_s, shown, record)
        if state.reconstruction is not None:
            made = state.reconstruction
            self._show("SuperResolution", made.measurement_id, _measured_s(state), made, record)
        return {device: encoded for device, (_, encoded) in self._shown.items()}

    def _show(
        self,
        device: str,
        number: int,
        at_s: float,
        shown: SliceState | ReconstructionState,
        record: CaseRecord,
    ) -> None:
        if device in self._shown and self._shown[device][0] == number:
            return
        read = slice_pixels if isinstance(shown, SliceState) else reconstruction_pixels
        try:
            pixels = read(record, number)
        except ImageMissingError:
            return
        self._shown[device] = number, image(device, at_s, pixels, _geometry(shown))


def _status(state: RoomState) -> bytes:
    code = STATUS_OK if state.robot.linked else STATUS_NOT_READY
    name = "READY" if state.ready else state.procedure or state.robot.phase
    return status("AutoSPINe", state.at_s, code, name, state.prompt)


def _fiducials(state: RoomState) -> list[Point]:
    found = []
    last, other = state.measurement, state.other_fiducial
    if last is not None and last.patient_mm is not None:
        found.append(Point("fiducial", last.patient_mm, 2 * (last.radius_mm or 0.0), _FIDUCIAL_RGB))
    if other is not None:
        found.append(Point("other", other.patient_mm, 2 * other.radius_mm, _FIDUCIAL_RGB))
    return found


def _targets(state: RoomState) -> list[Point]:
    named = (
        ("target", state.target_patient_mm, _TARGET_RGB),
        ("entry", state.entry_patient_mm, _ENTRY_RGB),
    )
    return [Point(name, place, rgb=rgb) for name, place, rgb in named if place is not None]


def _needle(at_s: float, arrival: ArrivalState) -> bytes:
    """At the tip; z goes on as the needle does, x lies in the slice as near to a row as it can."""
    tip, joint = np.array(arrival.tip_mm), np.array(arrival.joint_mm)
    along = (tip - joint) / np.linalg.norm(tip - joint)
    across = np.array([1.0, 0.0, 0.0]) - along[0] * along
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(along, across), along], axis=1)
    return transform("NeedleGuide", at_s, axes, tip)


def _measured_s(state: RoomState) -> float:
    measured = state.measurement
    return state.at_s if measured is None or measured.finished_s is None else measured.finished_s


def _geometry(shown: SliceState | ReconstructionState) -> SliceGeometry:
    return SliceGeometry(
        shown.position_mm,
        shown.row_direction,
        shown.col_direction,
        shown.spacing_mm,
        shown.shape,
    )
