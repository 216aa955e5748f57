"""What receivers of OpenIGTLink are shown of the room: state in, messages by device name out.

| device | type | what |
| --- | --- | --- |
| AutoSPINe | STATUS | what is going on; its code says whether the robot is ready for orders |
| Fiducials | POINT | where the fiducials are, in their size: `fiducial`, or `upper`, `lower` |
| Targets | POINT | target and entry, if they are set |
| NeedleGuide | TRANSFORM | needle tip and direction (its z axis) while READY from two fiducials |
| Slice | IMAGE | the newest slice |
| SuperResolution | IMAGE | the reconstruction of the fiducials that are shown |

Every device is always in the scene, for a receiver keeps what it was told until it is told
otherwise: what there is not, or what ended, is an empty list, a transform whose meta-data
`TransformStatus` is INVALID, or a black image whose `ImageStatus` is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from case_record.record import CaseRecord
from case_record.seal_chain import TamperedError
from dicom_slice.geometry import SliceGeometry
from room_config.service import GuideConfig
from service.room.images import ImageMissingError, reconstruction_pixels, slice_pixels
from service.room.state import (
    ArrivalState,
    FiducialState,
    MeasurementState,
    ReconstructionState,
    RobotState,
    RoomState,
    SliceState,
)
from service.slicer.messages import (
    IMAGE_STATUS,
    INVALID,
    STATUS_HARDWARE_FAILURE,
    STATUS_MANUAL,
    STATUS_NOT_READY,
    STATUS_OK,
    STATUS_PANIC,
    TRANSFORM_STATUS,
    VALID,
    Message,
    Point,
    image,
    points,
    status,
    transform,
)

Array = NDArray[np.float64]
Scene = dict[str, Message]

_FIDUCIAL_RGB, _TARGET_RGB, _ENTRY_RGB = (255, 200, 0), (0, 255, 120), (0, 160, 255)


@dataclass(frozen=True)
class SceneState:
    """What of a state is true now; what is not is None."""

    measurement: MeasurementState | None
    other_fiducial: FiducialState | None
    arrival: ArrivalState | None
    reconstruction: ReconstructionState | None


def standing(state: RoomState) -> SceneState:
    """The one place that asks whether what was seen still holds; `present` has said so."""
    seen, other, made = state.measurement, state.other_fiducial, state.reconstruction
    still = state.robot.linked and not state.robot.moving
    shown = seen if still and seen and seen.patient_mm and seen.lost is None else None
    other = other if still and other and other.lost is None else None
    numbers = {one.measurement_id for one in (shown, other) if one is not None}
    return SceneState(
        measurement=shown,
        other_fiducial=other,
        arrival=state.arrival if state.ready else None,
        reconstruction=made if made is not None and made.measurement_id in numbers else None,
    )


def scene_of(state: RoomState, guide: GuideConfig | None = None) -> Scene:
    """Everything but the images. guide: of a room with two fiducials."""
    now = standing(state)
    return {
        "AutoSPINe": _status(state),
        "Fiducials": points("Fiducials", _measured_s(state), _fiducials(state, now, guide)),
        "Targets": points("Targets", state.at_s, _targets(state)),
        "NeedleGuide": _needle(state.at_s, now.arrival),
    }


def stale(state: RoomState) -> RoomState:
    """A state that is old: nobody knows what the room does now, and where its guide is."""
    text = "The control loop is not reporting what the room is doing."
    robot = state.robot.model_copy(update={"linked": False, "problem": text, "phase": "STALE"})
    change = {"robot": robot, "ready": False, "procedure": None, "prompt": text}
    return state.model_copy(update=change)


class Images:
    """The images of a scene, each made once."""

    def __init__(self) -> None:
        self._shown: dict[str, tuple[tuple[str, int], Message]] = {}

    def of(self, state: RoomState, record: CaseRecord | None) -> Scene:
        """Reads the record and files; what there is not (any more) is black."""
        made = standing(state).reconstruction
        acquired_s = (state.slice.acquired_to_s or state.slice.received_s) if state.slice else 0.0
        number = made.measurement_id if made else 0
        slice_id = state.slice.slice_id if state.slice else 0
        self._show("Slice", (state.case_uid, slice_id), acquired_s, state.slice, record)
        self._show("SuperResolution", (state.case_uid, number), _measured_s(state), made, record)
        return {device: shown for device, (_, shown) in self._shown.items()}

    def _show(
        self,
        device: str,
        key: tuple[str, int],
        at_s: float,
        shown: SliceState | ReconstructionState | None,
        record: CaseRecord | None,
    ) -> None:
        if device in self._shown and self._shown[device][0] == key:
            return
        made = None if shown is None or record is None else _image(device, at_s, shown, record)
        is_final = shown is None or record is not None  # else it is looked for again
        self._shown[device] = key if is_final else ("", -1), made or _no_image(device, at_s)


def _image(
    device: str, at_s: float, shown: SliceState | ReconstructionState, record: CaseRecord
) -> Message | None:
    try:
        if isinstance(shown, SliceState):
            number, pixels = shown.slice_id, slice_pixels(record, shown.slice_id)
        else:
            result = record.measurement(shown.measurement_id).result or {}
            number = int(result["slice_id"])
            pixels = reconstruction_pixels(record, shown.measurement_id)
    except (ImageMissingError, TamperedError):
        return None
    header = record.slice(number).header
    meta = {IMAGE_STATUS: VALID, **_of_slice(header)}
    thickness_mm = header.get("slice_thickness_mm") or 1.0
    return image(device, at_s, pixels, _geometry(shown), thickness_mm, meta)


def _of_slice(header: Mapping[str, object]) -> dict[str, str]:
    uid = header.get("frame_of_reference_uid")
    return {"FrameOfReferenceUID": str(uid)} if uid else {}


def _no_image(device: str, at_s: float) -> Message:
    one = SliceGeometry((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (1.0, 1.0), (1, 1))
    return image(device, at_s, np.zeros((1, 1)), one, meta={IMAGE_STATUS: INVALID})


def status_of(state: RoomState, device: str, name: str = "") -> Message:
    """What is going on, under a device name; name: of the state, or else the robot's phase."""
    return status(device, state.at_s, code_of(state.robot), name or state.robot.phase, state.prompt)


def code_of(robot: RobotState) -> int:
    """OK only while the robot could take an order."""
    if not robot.linked:
        return STATUS_NOT_READY
    if robot.phase == "EMERGENCY":
        return STATUS_PANIC
    if robot.fault:
        return STATUS_HARDWARE_FAILURE
    if robot.stopped or not robot.armed or not robot.position_certain:
        return STATUS_NOT_READY
    return STATUS_MANUAL if robot.phase == "MANUAL" else STATUS_OK


def _status(state: RoomState) -> Message:
    name = "READY" if standing(state).arrival else state.procedure or state.robot.phase
    return status_of(state, "AutoSPINe", name)


def _fiducials(state: RoomState, now: SceneState, guide: GuideConfig | None) -> list[Point]:
    """By name, not by which was seen last: receivers tell them apart by place in the list too."""
    found = []
    if now.measurement is not None and now.measurement.patient_mm is not None:
        found.append((now.measurement.patient_mm, now.measurement.radius_mm or 0.0))
    if now.other_fiducial is not None:
        found.append((now.other_fiducial.patient_mm, now.other_fiducial.radius_mm))
    named = [
        Point(_fiducial_name(state, guide, place), place, 2 * radius_mm, _FIDUCIAL_RGB)
        for place, radius_mm in found
    ]
    return sorted(named, key=lambda point: point.name, reverse=True)


def _fiducial_name(
    state: RoomState, guide: GuideConfig | None, place: tuple[float, float, float]
) -> str:
    if guide is None or state.slice is None:
        return "fiducial"
    along_mm = float(_geometry(state.slice).normal @ place)
    is_upper = abs(along_mm - guide.upper_slice_mm) < abs(along_mm - guide.lower_slice_mm)
    return "upper" if is_upper else "lower"


def _targets(state: RoomState) -> list[Point]:
    named = (
        ("target", state.target_patient_mm, _TARGET_RGB),
        ("entry", state.entry_patient_mm, _ENTRY_RGB),
    )
    return [Point(name, place, rgb=rgb) for name, place, rgb in named if place is not None]


def _needle(at_s: float, arrival: ArrivalState | None) -> Message:
    """At the tip; z goes on as the needle does, x lies in the slice as near to a row as it can."""
    if arrival is None or arrival.tip_mm is None:
        return transform("NeedleGuide", at_s, np.eye(3), np.zeros(3), {TRANSFORM_STATUS: INVALID})
    tip, joint = np.array(arrival.tip_mm), np.array(arrival.joint_mm)
    axes = axes_along((tip - joint) / np.linalg.norm(tip - joint))
    return transform("NeedleGuide", at_s, axes, tip, {TRANSFORM_STATUS: VALID})


def axes_along(direction: Array) -> Array:
    """(3, 3): right-handed columns whose z is the unit vector (3,), x as near to patient x as
    that lets it be.
    """
    start = np.eye(3)[0 if abs(direction[0]) < 0.9 else 2]
    across = start - (start @ direction) * direction
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(direction, across), direction], axis=1)


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
