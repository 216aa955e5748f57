"""Files that 3D Slicer reads: volumes as NRRD, points as markups JSON, poses as ITK transforms.

Everything is written in LPS mm, which each of the formats says of itself.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dicom_slice.geometry import SliceGeometry

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v1.0.3.json#"
)


@dataclass(frozen=True)
class MarkupPoint:
    label: str
    patient_mm: tuple[float, float, float]
    description: str = ""


def nrrd(pixels: NDArray[np.floating], geometry: SliceGeometry, thickness_mm: float) -> bytes:
    """One slice (rows, cols) as a volume one voxel deep; teem.sourceforge.net/nrrd/format.html."""
    rows, cols = geometry.shape
    between_rows, between_cols = geometry.spacing_mm
    directions = (
        np.array(geometry.col_direction) * between_cols,
        np.array(geometry.row_direction) * between_rows,
        geometry.normal * thickness_mm,
    )
    head = (
        "NRRD0004",
        "type: float",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {cols} {rows} 1",
        f"space directions: {' '.join(map(_vector, directions))}",
        "kinds: domain domain domain",
        "endian: little",
        "encoding: gzip",
        f"space origin: {_vector(geometry.position_mm)}",
        "",
        "",
    )
    # the column index is the fastest one; no instant in it: the same case gives the same bytes
    data = gzip.compress(pixels.astype("<f4").tobytes(), mtime=0)
    return "\n".join(head).encode("ascii") + data


def markups(kind: str, points: Sequence[MarkupPoint]) -> bytes:
    """kind: Fiducial, or Line for two points."""
    listed = [
        {
            "id": str(number),
            "label": point.label,
            "description": point.description,
            "associatedNodeID": "",
            "position": list(point.patient_mm),
            "orientation": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, point in enumerate(points, start=1)
    ]
    markup = {
        "type": kind,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "labelFormat": "%N-%d",
        "lastUsedControlPointNumber": len(listed),
        "controlPoints": listed,
    }
    return json.dumps({"@schema": _SCHEMA, "markups": [markup]}, indent=1).encode()


def itk_transform(axes: ArrayLike, origin_mm: ArrayLike) -> bytes:
    """The pose of a tool: axes (3, 3) as columns, origin (3,), patient LPS.

    Files of Slicer hold the way back, from the patient to the tool, as ITK maps images.
    """
    turn = np.asarray(axes, float).T
    shift = -turn @ np.asarray(origin_mm, float)
    numbers = " ".join(f"{value:.10g}" for value in [*turn.ravel(), *shift])
    return (
        "#Insight Transform File V1.0\n#Transform 0\n"
        "Transform: AffineTransform_double_3_3\n"
        f"Parameters: {numbers}\nFixedParameters: 0 0 0\n"
    ).encode("ascii")


def _vector(values: ArrayLike) -> str:
    return "(" + ",".join(f"{value:.10g}" for value in np.asarray(values, float)) + ")"
