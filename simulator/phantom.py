"""Spectra of the things in the room: analytic k-space of what a slab cuts out of each of them.

Units: mm and cycles/mm. Spectra are of objects centred at the origin, real and even, shape
(rows, cols) in the order of `numpy.fft.fftfreq`; moving an object multiplies by a phase.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dicom_slice.geometry import SliceGeometry
from simulator.config import StaticObject
from sr_engine.model import disc_spectrum, sphere_slab_spectrum

Floats = NDArray[np.float64]
Shape = tuple[int, int]
Spacing = tuple[float, float]

_SLAB_NODES = 24


def frequencies(shape: Shape, spacing_mm: Spacing) -> tuple[Floats, Floats]:
    """Sampled frequencies along rows (rows, 1) and columns (1, cols), cycles/mm."""
    along_rows = np.asarray(np.fft.fftfreq(shape[0], spacing_mm[0]), dtype=np.float64)
    along_cols = np.asarray(np.fft.fftfreq(shape[1], spacing_mm[1]), dtype=np.float64)
    return along_rows[:, None], along_cols[None, :]


@lru_cache(maxsize=64)
def sphere_spectrum(
    shape: Shape, spacing_mm: Spacing, radius_mm: float, offset_um: int, thickness_mm: float
) -> Floats:
    """A unit sphere cut by a slab whose middle is `offset_um` from its centre.

    A whole number of micrometres, so that slices at the same position share one computation.
    """
    slab_mm = (offset_um / 1000, thickness_mm)
    quadrant = sphere_slab_spectrum(_quadrant(shape, spacing_mm), radius_mm, slab_mm)
    return _unfold(quadrant, shape)


@lru_cache(maxsize=64)
def oval_spectrum(
    shape: Shape,
    spacing_mm: Spacing,
    radius_mm: float,
    oval: tuple[float, float],
    offset_um: int,
    thickness_mm: float,
) -> Floats:
    """As `sphere_spectrum`, of a sphere stretched in the plane at constant area.

    oval: longer over shorter diameter, and the longer one's angle (deg) from rows to columns.
    """
    stretch, angle = np.sqrt(oval[0]), np.radians(oval[1])
    k_row, k_col = frequencies(shape, spacing_mm)
    along = (np.cos(angle) * k_row + np.sin(angle) * k_col) * stretch
    across = (np.cos(angle) * k_col - np.sin(angle) * k_row) / stretch
    slab_mm = (offset_um / 1000, thickness_mm)
    full = sphere_slab_spectrum(np.hypot(along, across), radius_mm, slab_mm)
    full.setflags(write=False)
    return full


def bored_share(radius_mm: float, bore_mm: float, offset_mm: float, thickness_mm: float) -> float:
    """How much of a slab's thickness lies inside of a sphere, along a bore through its middle.

    The bore's ends are taken for flat.
    """
    depth_mm = 2 * np.sqrt(max(radius_mm**2 - (bore_mm / 2) ** 2, 0.0))
    return _overlap(offset_mm, float(depth_mm), thickness_mm)


@lru_cache(maxsize=64)
def circle_spectrum(shape: Shape, spacing_mm: Spacing, radius_mm: float) -> Floats:
    """A unit disc."""
    return _unfold(disc_spectrum(_quadrant(shape, spacing_mm), radius_mm), shape)


def rectangle_spectrum(shape: Shape, spacing_mm: Spacing, edges_mm: tuple[float, float]) -> Floats:
    """A unit rectangle with full edges (along rows, along columns)."""
    k_row, k_col = frequencies(shape, spacing_mm)
    across = edges_mm[0] * np.sinc(k_row * edges_mm[0])
    return np.asarray(across * (edges_mm[1] * np.sinc(k_col * edges_mm[1])))


def displacement(shape: Shape, spacing_mm: Spacing, centre_px: Floats) -> NDArray[np.complex128]:
    """The phase that moves an object from the origin to pixel (row, col) `centre_px` (2,)."""
    k_row, k_col = frequencies(shape, spacing_mm)
    across = np.exp(-2j * np.pi * k_row * (centre_px[0] * spacing_mm[0]))
    return np.asarray(across * np.exp(-2j * np.pi * k_col * (centre_px[1] * spacing_mm[1])))


def static_spectrum(
    thing: StaticObject, geometry: SliceGeometry, thickness_mm: float
) -> NDArray[np.complex128]:
    """The section of one static object, in place, times its signal.

    Exact for slices along the patient's axes; an oblique slice is treated as its nearest one.
    """
    centre_px, out_of_plane_mm = geometry.pixel_from_patient(np.array(thing.centre_mm))
    section = _section(thing, geometry, thickness_mm, -float(out_of_plane_mm))
    return thing.signal * section * displacement(geometry.shape, geometry.spacing_mm, centre_px)


def _section(
    thing: StaticObject, geometry: SliceGeometry, thickness_mm: float, offset_mm: float
) -> Floats:
    grid = (geometry.shape, geometry.spacing_mm)
    row, col, normal = (
        int(np.argmax(np.abs(direction)))
        for direction in (geometry.row_direction, geometry.col_direction, geometry.normal)
    )
    if thing.kind == "sphere":
        assert thing.radius_mm is not None
        return sphere_spectrum(*grid, thing.radius_mm, round(1000 * offset_mm), thickness_mm)
    if thing.kind == "box":
        assert thing.size_mm is not None
        inside = _overlap(offset_mm, thing.size_mm[normal], thickness_mm)
        return inside * rectangle_spectrum(*grid, (thing.size_mm[row], thing.size_mm[col]))
    assert thing.radius_mm is not None
    assert thing.length_mm is not None
    axis = "xyz".index(thing.axis)
    if axis == normal:
        inside = _overlap(offset_mm, thing.length_mm, thickness_mm)
        return inside * circle_spectrum(*grid, thing.radius_mm)
    total = np.zeros(geometry.shape)
    for chord_mm, weight in _chords(thing.radius_mm, offset_mm, thickness_mm):
        edges = (thing.length_mm, chord_mm) if axis == row else (chord_mm, thing.length_mm)
        total += weight * rectangle_spectrum(*grid, edges)
    return total


def _overlap(offset_mm: float, depth_mm: float, thickness_mm: float) -> float:
    """Share of the slab that lies inside of an object of a given depth."""
    low = max(offset_mm - thickness_mm / 2, -depth_mm / 2)
    high = min(offset_mm + thickness_mm / 2, depth_mm / 2)
    return max(high - low, 0.0) / thickness_mm


def _chords(radius_mm: float, offset_mm: float, thickness_mm: float) -> list[tuple[float, float]]:
    """Widths at which the layers of a slab cut a lying cylinder, and the share of each layer."""
    low = max(offset_mm - thickness_mm / 2, -radius_mm)
    high = min(offset_mm + thickness_mm / 2, radius_mm)
    if high <= low:
        return []
    x, w = np.polynomial.legendre.leggauss(_SLAB_NODES)
    layers = (high - low) / 2 * x + (high + low) / 2
    chords = 2 * np.sqrt(radius_mm**2 - layers**2)
    return list(zip(chords.tolist(), (w * (high - low) / 2 / thickness_mm).tolist(), strict=True))


def _quadrant(shape: Shape, spacing_mm: Spacing) -> Floats:
    """|k| for frequencies from 0 to Nyquist: the other quadrants mirror it."""
    rows = np.arange(shape[0] // 2 + 1) / (shape[0] * spacing_mm[0])
    cols = np.arange(shape[1] // 2 + 1) / (shape[1] * spacing_mm[1])
    return np.hypot(rows[:, None], cols[None, :])


def _unfold(quadrant: Floats, shape: Shape) -> Floats:
    rows, cols = (np.abs(np.rint(np.fft.fftfreq(n) * n)).astype(int) for n in shape)
    full = quadrant[rows[:, None], cols[None, :]]
    full.setflags(write=False)
    return full
