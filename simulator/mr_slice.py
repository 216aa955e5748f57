"""One slice, the way a scanner makes it: analytic k-space line by line, filter, shading, noise.

No processes and no clocks here: studies call `acquire` in a loop; the virtual scanner calls it
with the path that the stages really took while it was scanning.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dicom_slice.geometry import SliceGeometry
from simulator import phantom
from simulator.config import Fiducial, SliceProtocol, StaticObject, VirtualRoom
from simulator.scene import fiducial_in_robot_mm, patient_from_robot
from sr_engine.psf import Psf

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# (row direction, column direction) in LPS, as a scanner displays each plane.
_PLANES = {
    "coronal": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),
    "axial": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    "sagittal": ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
_STILL_MM = 1e-7


@dataclass(frozen=True, eq=False)
class StagePath:
    """True stage positions over time: each sample holds until the next one.

    times_s (n,), increasing; positions_mm (n, axes), columns in the order of `axes`.
    """

    axes: tuple[str, ...]
    times_s: Floats
    positions_mm: Floats

    @classmethod
    def standing(cls, stage_mm: Mapping[str, float]) -> "StagePath":
        axes = tuple(stage_mm)
        return cls(axes, np.zeros(1), np.array([[float(stage_mm[axis]) for axis in axes]]))

    def at(self, time_s: float) -> dict[str, float]:
        """Axis → position in mm."""
        last = max(int(np.searchsorted(self.times_s, time_s, side="right")) - 1, 0)
        return dict(zip(self.axes, self.positions_mm[last].tolist(), strict=True))

    @property
    def travel_mm(self) -> float:
        """Largest distance between two positions of any axis."""
        return float(np.ptp(self.positions_mm, axis=0).max())


@dataclass(frozen=True, eq=False)
class AcquiredSlice:
    """One slice with its truth.

    signal: (rows, cols) complex, noise included, in stored units.
    stage_mm, fiducials_mm: truth (axis → mm; name → (3,) LPS mm) when the centre of k-space
        was sampled.
    centres_px: name → (row, col) at which the fiducial appears: chemical shift included.
    in_slice: names of the fiducials that the slab meets.
    travel_mm: how far the stages moved meanwhile.
    """

    signal: Complex
    geometry: SliceGeometry
    stage_mm: dict[str, float]
    fiducials_mm: dict[str, Floats]
    centres_px: dict[str, Floats]
    in_slice: tuple[str, ...]
    travel_mm: float

    @property
    def magnitude(self) -> Floats:
        return np.abs(self.signal)


def acquire(
    room: VirtualRoom,
    stage_mm: Mapping[str, float] | StagePath,
    rng: np.random.Generator,
    *,
    slice_position_mm: float | None = None,
    orientation: str | None = None,
    interval_s: tuple[float, float] = (0.0, 1.0),
) -> AcquiredSlice:
    """A slice of the room while the stages stand at `stage_mm` or move along a path.

    slice_position_mm: middle of the slab along the slice normal (for coronal slices the patient's
    y); the protocol's own position if None. orientation: instead of the protocol's.
    interval_s: from when to when k-space is sampled, on the clock of the path.
    """
    path = stage_mm if isinstance(stage_mm, StagePath) else StagePath.standing(stage_mm)
    protocol = room.protocol
    geometry = slice_geometry(protocol, slice_position_mm, orientation)
    spectrum = _background_spectrum(room.background, geometry, protocol.thickness_mm).copy()
    spectrum += _fiducial_spectrum(room, geometry, path, interval_s)
    noise_free = _image(spectrum, geometry, protocol) * _sensitivity(geometry, protocol)
    noise = _noise(geometry.shape, protocol, rng)
    stage_then = path.at(sum(interval_s) / 2)
    centres = _centres(room, geometry, stage_then)
    return AcquiredSlice(
        signal=protocol.stored_per_signal * (noise_free + noise),
        geometry=geometry,
        stage_mm=stage_then,
        fiducials_mm={name: patient_mm for name, (patient_mm, _, _) in centres.items()},
        centres_px={name: centre_px for name, (_, centre_px, _) in centres.items()},
        in_slice=tuple(
            fiducial.name
            for fiducial in room.fiducials
            if abs(centres[fiducial.name][2]) < fiducial.radius_mm + protocol.thickness_mm / 2
        ),
        travel_mm=path.travel_mm,
    )


def slice_geometry(
    protocol: SliceProtocol,
    slice_position_mm: float | None = None,
    orientation: str | None = None,
) -> SliceGeometry:
    """Where the pixels of a slice are; its field of view is centred on the protocol's."""
    row, col = (np.array(d) for d in _PLANES[orientation or protocol.orientation])
    normal = np.cross(col, row)
    centre = np.array(protocol.fov_centre_mm)
    if slice_position_mm is not None:
        centre = centre + (slice_position_mm - centre @ normal) * normal
    rows, cols = protocol.shape
    corner = centre - row * (rows - 1) / 2 * protocol.spacing_mm[0]
    x, y, z = (corner - col * (cols - 1) / 2 * protocol.spacing_mm[1]).tolist()
    row_direction, col_direction = _PLANES[orientation or protocol.orientation]
    return SliceGeometry((x, y, z), row_direction, col_direction, protocol.spacing_mm, (rows, cols))


def chemical_shift_px(protocol: SliceProtocol) -> Floats:
    """Displacement (row, col) of oil against water, along the readout."""
    hz = protocol.chemical_shift_ppm * protocol.imaging_frequency_mhz  # 1 ppm of 1 MHz is 1 Hz
    along_readout = protocol.readout_polarity * hz / protocol.bandwidth_hz_px
    readout_axis = 1 if protocol.phase_encoding == "COL" else 0
    return along_readout * np.eye(2)[readout_axis]


def _centres(
    room: VirtualRoom, geometry: SliceGeometry, stage_mm: Mapping[str, float]
) -> dict[str, tuple[Floats, Floats, float]]:
    """Name → patient mm (3,), apparent pixel (2,), mm from the middle of the slab."""
    to_patient = patient_from_robot(room.placement)
    shift = chemical_shift_px(room.protocol)
    centres = {}
    for fiducial in room.fiducials:
        patient_mm = to_patient(fiducial_in_robot_mm(fiducial, room.placement, stage_mm))
        centre_px, out_of_plane_mm = geometry.pixel_from_patient(patient_mm)
        centres[fiducial.name] = (patient_mm, centre_px + shift, float(out_of_plane_mm))
    return centres


def _fiducial_spectrum(
    room: VirtualRoom, geometry: SliceGeometry, path: StagePath, interval_s: tuple[float, float]
) -> Complex:
    """k-space of the fiducials; each line sees them where they are when it is sampled."""
    lines = _line_times(geometry.shape, room.protocol, interval_s)
    if path.travel_mm < _STILL_MM:
        lines = lines[:1]
    per_line = [_centres(room, geometry, path.at(time_s)) for time_s in lines]
    total = np.zeros(geometry.shape, dtype=complex)
    for fiducial in room.fiducials:
        centres_px = np.array([centres[fiducial.name][1] for centres in per_line])
        out_of_plane_mm = float(np.mean([centres[fiducial.name][2] for centres in per_line]))
        at_origin = _fiducial_at_origin(fiducial, geometry, room.protocol, -out_of_plane_mm)
        total += at_origin * _phases(geometry, room.protocol, centres_px)
    return total


def _line_times(
    shape: tuple[int, int], protocol: SliceProtocol, interval_s: tuple[float, float]
) -> Floats:
    """When each phase-encoding line is sampled (in the order of fftfreq): from -kmax to +kmax."""
    count = shape[0] if protocol.phase_encoding == "COL" else shape[1]
    rank = np.fft.fftfreq(count) * count + count // 2
    return interval_s[0] + (rank + 0.5) / count * (interval_s[1] - interval_s[0])


def _phases(geometry: SliceGeometry, protocol: SliceProtocol, centres_px: Floats) -> Complex:
    """Displacement phases; centres_px (1, 2) for all lines alike, or (lines, 2)."""
    if len(centres_px) == 1:
        return phantom.displacement(geometry.shape, geometry.spacing_mm, centres_px[0])
    k_row, k_col = phantom.frequencies(geometry.shape, geometry.spacing_mm)
    centres_mm = centres_px * np.array(geometry.spacing_mm)
    row_mm, col_mm = centres_mm.T
    if protocol.phase_encoding == "COL":
        turns = k_row * row_mm[:, None] + k_col * col_mm[:, None]
    else:
        turns = k_row * row_mm[None, :] + k_col * col_mm[None, :]
    return np.asarray(np.exp(-2j * np.pi * turns))


def _fiducial_at_origin(
    fiducial: Fiducial, geometry: SliceGeometry, protocol: SliceProtocol, offset_mm: float
) -> Floats:
    grid = (geometry.shape, geometry.spacing_mm)
    slab = (round(1000 * offset_mm), protocol.thickness_mm)
    if fiducial.oval == 1:
        unit = phantom.sphere_spectrum(*grid, fiducial.radius_mm, *slab)
    else:
        oval = (fiducial.oval, fiducial.oval_deg)
        unit = phantom.oval_spectrum(*grid, fiducial.radius_mm, oval, *slab)
    if fiducial.cannula_mm > 0:
        share = phantom.bored_share(
            fiducial.radius_mm, fiducial.cannula_mm, offset_mm, protocol.thickness_mm
        )
        unit = unit - share * phantom.circle_spectrum(*grid, fiducial.cannula_mm / 2)
    oil = fiducial.signal * unit
    if fiducial.shell_signal == 0 or fiducial.shell_mm == 0:
        return oil
    outer = phantom.sphere_spectrum(*grid, fiducial.radius_mm + fiducial.shell_mm, *slab)
    inner = phantom.sphere_spectrum(*grid, fiducial.radius_mm, *slab)
    return oil + fiducial.shell_signal * (outer - inner)


@lru_cache(maxsize=16)
def _background_spectrum(
    background: tuple[StaticObject, ...], geometry: SliceGeometry, thickness_mm: float
) -> Complex:
    total = np.zeros(geometry.shape, dtype=complex)
    for thing in background:
        total += phantom.static_spectrum(thing, geometry, thickness_mm)
    total.setflags(write=False)
    return total


def _image(spectrum: Complex, geometry: SliceGeometry, protocol: SliceProtocol) -> Complex:
    pixel_mm2 = geometry.spacing_mm[0] * geometry.spacing_mm[1]
    return np.fft.ifft2(spectrum * _window(geometry.shape, protocol.window)) / pixel_mm2


@lru_cache(maxsize=16)
def _window(shape: tuple[int, int], kind: str) -> Floats:
    k_row, k_col = np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1])
    return Psf(kind=kind).window(k_row[:, None], k_col[None, :])  # type: ignore[arg-type]


def _sensitivity(geometry: SliceGeometry, protocol: SliceProtocol) -> Floats:
    """Smooth receive sensitivity, 1 in the middle of the field."""
    rows, cols = geometry.shape
    row_mm = (np.arange(rows) - (rows - 1) / 2)[:, None] * geometry.spacing_mm[0]
    col_mm = (np.arange(cols) - (cols - 1) / 2)[None, :] * geometry.spacing_mm[1]
    slope_row, slope_col = protocol.shading_per_mm
    curved = protocol.shading_per_mm2 * (row_mm**2 + col_mm**2)
    return np.maximum(1 + slope_row * row_mm + slope_col * col_mm + curved, 0.0)


def _noise(shape: tuple[int, int], protocol: SliceProtocol, rng: np.random.Generator) -> Complex:
    """Noise of std 1/snr a channel; a filter lowers and colours it, as it does on a scanner."""
    white = rng.standard_normal((2, *shape)) / protocol.snr
    noise = white[0] + 1j * white[1]
    if protocol.window == "flat":
        return noise
    return np.fft.ifft2(np.fft.fft2(noise) * _window(shape, protocol.window))
