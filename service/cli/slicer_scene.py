"""`autospine export CASE --slicer`: a case as a scene that 3D Slicer opens (.mrb).

In it: every reconstruction and the slice that was shown with it, the fiducials where they were
measured, all targets and entry points, and of each READY the guide's pose.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from case_record.record import CaseRecord
from case_record.rows import Measurement
from dicom_slice.geometry import SliceGeometry
from service.cli.slicer_formats import MarkupPoint, itk_transform, markups, nrrd
from service.procedure.registry import APPROACHES
from service.procedure.targets import ENTRY_SET, TARGET_SET
from service.room.images import ImageMissingError, reconstruction_pixels, slice_pixels

_FOLDER = "Data"
_INSTANT = (1980, 1, 1, 0, 0, 0)  # of a zip's members: the same case gives the same bytes


@dataclass(frozen=True)
class Kind:
    """The XML tags of a node, of what stores it and of what displays it, and their classes."""

    node: tuple[str, str]
    storage: tuple[str, str, dict[str, str]]
    display: tuple[str, str, dict[str, str]] | None = None


_JSON: tuple[str, str, dict[str, str]] = ("MarkupsJsonStorage", "vtkMRMLMarkupsJsonStorageNode", {})
_VOLUME = Kind(
    ("Volume", "vtkMRMLScalarVolumeNode"),
    (
        "VolumeArchetypeStorage",
        "vtkMRMLVolumeArchetypeStorageNode",
        {"useCompression": "1", "centerImage": "0", "UseOrientationFromFile": "1"},
    ),
    (
        "VolumeDisplay",
        "vtkMRMLScalarVolumeDisplayNode",
        {"colorNodeID": "vtkMRMLColorTableNodeGrey", "autoWindowLevel": "1", "interpolate": "0"},
    ),
)
_POINTS = Kind(
    ("MarkupsFiducial", "vtkMRMLMarkupsFiducialNode"),
    _JSON,
    ("MarkupsFiducialDisplay", "vtkMRMLMarkupsFiducialDisplayNode", {"visibility": "true"}),
)
_LINE = Kind(
    ("MarkupsLine", "vtkMRMLMarkupsLineNode"),
    _JSON,
    ("MarkupsDisplay", "vtkMRMLMarkupsDisplayNode", {"visibility": "true"}),
)
_POSE = Kind(
    ("LinearTransform", "vtkMRMLLinearTransformNode"),
    ("TransformStorage", "vtkMRMLTransformStorageNode", {}),
)


@dataclass(frozen=True)
class Member:
    """A file of the scene, and what it is there."""

    name: str
    title: str
    kind: Kind
    content: bytes


def write_scene(members: list[Member], target: Path, home: str) -> None:
    """Write the scene's zip. home: name of the scene, and of the folder in the zip."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for member in members:
            _put(archive, f"{home}/{_FOLDER}/{member.name}", member.content)
        _put(archive, f"{home}/{home}.mrml", mrml(members))


def _put(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, _INSTANT), content, zipfile.ZIP_DEFLATED)


def mrml(members: list[Member]) -> bytes:
    """The scene: a node for every file, what stores it and what displays it."""
    scene = ElementTree.Element("MRML", {"version": "Slicer 5.6.0", "userTags": ""})
    for number, member in enumerate(members, start=1):
        tag, kind = member.kind.node
        refers = {}
        parts = {"storage": member.kind.storage, "display": member.kind.display}
        for role, part in parts.items():
            if part is None:
                continue
            part_tag, part_kind, attributes = part
            refers[role] = f"{part_kind}{number}"
            given = {"id": refers[role], "name": f"{member.title} {role}", **attributes}
            if role == "storage":
                given["fileName"] = f"{_FOLDER}/{member.name}"
            ElementTree.SubElement(scene, part_tag, given)
        references = "".join(f"{role}:{node};" for role, node in refers.items())
        node = {"id": f"{kind}{number}", "name": member.title, "references": references}
        ElementTree.SubElement(scene, tag, node)
    ElementTree.indent(scene)
    return ElementTree.tostring(scene, encoding="utf-8", xml_declaration=True)


def scene_members(record: CaseRecord) -> Iterator[Member]:
    """Every file of the scene but the scene itself; what has no pixels any more is left out."""
    measured = record.measurements("done")
    for measurement in measured:
        yield from _volumes(record, measurement)
    seen = [
        MarkupPoint(f"measurement {row.measurement_id}", _three(row.result["patient_mm"]))
        for row in measured
        if row.result
    ]
    yield Member("fiducials.mrk.json", "Fiducials", _POINTS, markups("Fiducial", seen))
    planned = _planned(record)
    yield Member("targets.mrk.json", "Targets", _POINTS, markups("Fiducial", planned))
    yield from _arrivals(record)


def _volumes(record: CaseRecord, measurement: Measurement) -> Iterator[Member]:
    """The slice that was measured, or its reconstruction beside it."""
    result, number = measurement.result or {}, measurement.measurement_id
    row = record.slice(int(result["slice_id"]))
    values = row.header["geometry"]
    geometry = SliceGeometry(**{name: tuple(value) for name, value in values.items()})
    thickness_mm = row.header.get("slice_thickness_mm") or 1.0
    try:
        pixels = slice_pixels(record, row.slice_id)
    except ImageMissingError:
        return
    content = nrrd(pixels, geometry, thickness_mm)
    name = f"slice-{row.slice_id}-of-{number}.nrrd"
    yield Member(name, f"Slice {row.slice_id}", _VOLUME, content)
    try:
        fine = reconstruction_pixels(record, number)
    except ImageMissingError:
        return
    finer = geometry.finer_grid(fine.shape[0] // geometry.shape[0])
    content = nrrd(fine, finer, thickness_mm)
    yield Member(f"super-resolution-{number}.nrrd", f"Super-resolution {number}", _VOLUME, content)


def _planned(record: CaseRecord) -> list[MarkupPoint]:
    """Targets and entry points in the order in which they were set."""
    events = [*record.events_of_kind(TARGET_SET), *record.events_of_kind(ENTRY_SET)]
    points = []
    for event in sorted(events, key=lambda event: event.event_id):
        name = "target" if event.kind == TARGET_SET else "entry"
        label = f"{name} {event.event_id} {event.body.get('label', '')}".strip()
        points.append(MarkupPoint(label, _three(event.body["patient_mm"]), f"set by {event.who}"))
    return points


def _arrivals(record: CaseRecord) -> Iterator[Member]:
    """Of each READY: the needle's line and pose with two fiducials, else where the fiducial was."""
    for row in record.procedures():
        result = row.result or {}
        if row.name not in APPROACHES or row.state != "done":
            continue
        name, title = f"ready-{row.procedure_id}", f"READY {row.procedure_id}"
        if result.get("tip_mm"):
            tip, joint = _three(result["tip_mm"]), _three(result["joint_mm"])
            ends = [MarkupPoint("lower ball joint", joint), MarkupPoint("needle tip", tip)]
            yield Member(f"{name}.mrk.json", f"{title} needle", _LINE, markups("Line", ends))
            pose = itk_transform(_along(tip, joint), tip)
        else:
            found = record.measurement(int(result["measurement_id"])).result or {}
            pose = itk_transform(np.eye(3), found["patient_mm"])
        yield Member(f"{name}.tfm", f"{title} guide", _POSE, pose)


def _along(tip: tuple[float, ...], joint: tuple[float, ...]) -> np.ndarray:
    """Axes whose z goes from the joint to the tip."""
    along = np.subtract(tip, joint) / np.linalg.norm(np.subtract(tip, joint))
    start = np.eye(3)[0 if abs(along[0]) < 0.9 else 2]
    across = start - (start @ along) * along
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(along, across), along], axis=1)


def _three(values: object) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)  # type: ignore[attr-defined]
    return x, y, z
