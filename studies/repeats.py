"""Groups of real slices of the same thing, the round objects in them, and every method's centres.

Reads a folder with `manifest.csv`: columns path, round_object, rep_group, rep_kind, spacing and
frames, as in the project's collection of public MR slices.
"""

import csv
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import fourier_shift
from skimage.registration import phase_cross_correlation

from dicom_slice.pixels import magnitude_pixels
from dicom_slice.reasons import UnusableError
from sr_engine.detect import Candidate, detect
from sr_engine.errors import EngineError
from sr_engine.locate import PSF_OBJECTS, likeliest_psf, refine
from sr_engine.psf import Psf
from studies.peers import PEERS, PeerFailedError, run_peer

Array = NDArray[np.float64]

OURS = "ml (ours)"
METHODS = (OURS, *PEERS)
KINDS = ("echo_train", "inversion_series", "repeat_acq", "dynamic_epi")
VIAL_RADII_MM = (4.5, 12.0)
SAME_OBJECT_PX = 3.0
REGISTRATION_MARGIN_PX = 8.0
MOST_LOOKED_AT = 6  # slices of a group that are searched for objects


@dataclass(frozen=True, eq=False)
class Group:
    """Slices of one thing under one geometry, in the order in which they were taken."""

    name: str
    kind: str
    spacing_mm: tuple[float, float]
    paths: tuple[Path, ...]
    frames: tuple[Array, ...]

    @property
    def has_vials(self) -> bool:
        return "nist" in self.name


@dataclass(frozen=True, eq=False)
class Tracks:
    """Centres (objects, slices, 2) in px of each method, NaN where a method failed."""

    group: Group
    objects: tuple[Candidate, ...]
    centres_px: dict[str, Array]


def load_groups(data: Path) -> list[Group]:
    """All groups of repeats with a whole round object in every slice.

    Raises FileNotFoundError where the folder has no manifest.
    """
    with (data / "manifest.csv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["rep_group"] and r["rep_kind"] in KINDS]
    names = dict.fromkeys(r["rep_group"] for r in rows if r["round_object"] == "yes")
    groups = [_load(data, name, [r for r in rows if r["rep_group"] == name]) for name in names]
    return [group for group in groups if group is not None and len(group.frames) > 1]


def _load(data: Path, name: str, rows: list[dict[str, str]]) -> Group | None:
    rows.sort(key=lambda r: r["path"])
    paths, frames = [], []
    for row in rows:
        path = data / row["path"]
        middle = int(row["frames"] or 1) // 2
        try:
            frames.append(magnitude_pixels(path, middle))
        except UnusableError:
            continue
        paths.append(path)
    if not frames:
        return None
    between_rows, between_cols = (float(x) for x in rows[0]["spacing"].split("\\"))
    spacing = (between_rows, between_cols)
    return Group(name, rows[0]["rep_kind"], spacing, tuple(paths), tuple(frames))


def find_objects(group: Group) -> list[Candidate]:
    """The round objects that most of the group's slices show, where and as large as their median.

    Of a phantom with vials the vials; otherwise all from 4 px up to half of the field of view.
    """
    spacing = group.spacing_mm[0]
    shape = group.frames[0].shape
    radii = (4.0, 0.48 * min(shape))
    if group.has_vials:
        radii = (VIAL_RADII_MM[0] / spacing, VIAL_RADII_MM[1] / spacing)
    every = max(1, len(group.frames) // MOST_LOOKED_AT)
    looked_at = group.frames[::every][:MOST_LOOKED_AT]
    clusters: list[list[Candidate]] = []
    for frame in looked_at:
        for seen in detect(frame, radii):
            for cluster in clusters:
                if _distance(cluster[0], seen) < SAME_OBJECT_PX:
                    cluster.append(seen)
                    break
            else:
                clusters.append([seen])
    return [_median(c) for c in clusters if len(c) > len(looked_at) / 2]


def _distance(one: Candidate, other: Candidate) -> float:
    return float(np.hypot(*np.subtract(one.centre_px, other.centre_px)))


def _median(cluster: list[Candidate]) -> Candidate:
    row, col = np.median([c.centre_px for c in cluster], axis=0).tolist()
    radius = float(np.median([c.radius_px for c in cluster]))
    first = cluster[0]
    return Candidate(
        (row, col), radius, first.strength, first.coverage, first.sharpness, first.contrast
    )


def track(group: Group, objects: list[Candidate], displacements_px: Array | None = None) -> Tracks:
    """Every method's centre of every object in every slice, from the same starts and radii.

    displacements_px (slices, 2): each slice is displaced by so much first (exactly, by the shift
    theorem), and the centres are given less the displacement. A method that answers in whole
    pixels repeats well on slices that do not move; this shows what it is worth on those that do.
    """
    moves = np.zeros((len(group.frames), 2)) if displacements_px is None else displacements_px
    psf = likeliest_psf(group.frames[0], objects[:PSF_OBJECTS])  # one protocol, one point spread
    shape = (len(objects), len(group.frames), 2)
    centres = {name: np.full(shape, np.nan) for name in METHODS}
    for k, (original, move) in enumerate(zip(group.frames, moves, strict=True)):
        frame = displaced(original, move) if move.any() else original
        for i, seen in enumerate(objects):
            row, col = np.add(seen.centre_px, move).tolist()
            there = replace(seen, centre_px=(row, col))
            for name in METHODS:
                with suppress(EngineError, PeerFailedError):
                    centres[name][i, k] = _centre(name, frame, there, psf) - move
    return Tracks(group, tuple(objects), centres)


def displaced(frame: Array, move_px: Array) -> Array:
    """The frame moved by (row, col) px: a phase on its k-space. It must not become negative."""
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(frame), move_px)).real
    return np.maximum(moved, 0.0) if frame.min() >= 0 else moved


def _centre(name: str, frame: Array, seen: Candidate, psf: Psf) -> Array:
    if name == OURS:
        return refine(frame, seen, psf).centre_px
    return run_peer(PEERS[name], frame, seen.centre_px, seen.radius_px)


def registered_steps_px(tracks: Tracks) -> Array:
    """(objects, slices - 1, 2): how far each object's pixels moved to the next slice.

    By correlation of all pixels of the object, without any model of its outline: independent of
    every method compared, it tells motion of the phantom from scatter of a method.
    """
    frames = tracks.group.frames
    steps = np.zeros((len(tracks.objects), len(frames) - 1, 2))
    for i, seen in enumerate(tracks.objects):
        reach = seen.radius_px + REGISTRATION_MARGIN_PX
        rows, cols = (slice(max(0, int(x - reach)), int(x + reach) + 2) for x in seen.centre_px)
        for k, (one, next_one) in enumerate(pairwise(frames)):
            shift, _, _ = phase_cross_correlation(
                one[rows, cols], next_one[rows, cols], upsample_factor=500, normalization=None
            )
            steps[i, k] = -np.asarray(shift)
    return steps


def scatter_beside_motion(tracks: Tracks, method: str, steps_px: Array) -> float:
    """Std per axis as in `Scatter`, of what the method sees less what the pixels did."""
    return _rms_per_object(np.diff(tracks.centres_px[method], axis=1) - steps_px)


@dataclass(frozen=True)
class Scatter:
    """Of one method in one group: std per axis from slice to slice, and failures.

    neighbours_px: from differences of successive slices, which leaves slow drift out;
    relative_px: likewise, less what all objects of the slice do together (several objects only).
    """

    neighbours_px: float
    relative_px: float
    failures: int
    attempts: int


def scatter(centres_px: Array) -> Scatter:
    """Median over the objects of the rms difference of neighbours, over sqrt 2."""
    steps = np.diff(centres_px, axis=1)
    failed = int(np.isnan(centres_px[..., 0]).sum())
    attempts = centres_px.shape[0] * centres_px.shape[1]
    together = np.zeros_like(steps[:1])
    if len(steps) >= 5:
        good = ~np.isnan(steps).all(axis=(0, 2))
        together[:, good] = np.nanmedian(steps[:, good], axis=0, keepdims=True)
    return Scatter(_rms_per_object(steps), _rms_per_object(steps - together), failed, attempts)


def _rms_per_object(steps: Array) -> float:
    values = []
    for own in steps:
        good = own[~np.isnan(own[:, 0])]
        if len(good) >= max(1, len(own) // 2):
            values.append(float(np.sqrt(np.mean(good**2) / 2)))
    return float(np.median(values)) if len(values) >= (len(steps) + 1) // 2 else float("nan")
