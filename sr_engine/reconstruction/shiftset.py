"""Shift sets: where the fiducial is moved to for the frames of one measurement, in pixels.

A shift is the displacement (row, col) of the fiducial from the reference pose, in pixels of
the frame. What a set is worth for reconstruction depends only on the shifts modulo one pixel:
the aliases of one frame frequency are told apart by the phases exp(-2 pi i m.d) with m in
{0..factor-1}^2 (numerics: Elad & Hel-Or, IEEE TIP 10:1187, 2001).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.errors import ParameterError, SingularShiftSetError
from sr_engine.frames import check_factor, check_shifts

Shift = tuple[float, float]

MAX_CONDITION_NUMBER = 1e6
"""Above this the noise is amplified beyond any use: the set counts as singular."""


@dataclass(frozen=True)
class ShiftSet:
    """An ordered set of shifts (row, col) in px."""

    name: str
    shifts_px: tuple[Shift, ...]

    def __post_init__(self) -> None:
        check_shifts(self.shifts_px)

    def __len__(self) -> int:
        return len(self.shifts_px)

    def as_array(self) -> NDArray[np.float64]:
        """Shape (N, 2), (row, col), px."""
        return np.array(self.shifts_px, dtype=np.float64)

    def steps_px(self) -> NDArray[np.float64]:
        """The moves between consecutive points, last of all the return to the first: (N, 2)."""
        shifts = self.as_array()
        return np.roll(shifts, -1, axis=0) - shifts

    def mean_px(self) -> Shift:
        row, col = self.as_array().mean(axis=0)
        return float(row), float(col)

    def condition_number(self, factor: int = 2) -> float:
        return condition_number(self.shifts_px, factor)

    def noise_factor(self, factor: int = 2) -> float:
        return noise_factor(self.shifts_px, factor)


def _grid(name: str, per_axis: Sequence[float]) -> ShiftSet:
    return ShiftSet(name, tuple((row, col) for row in per_axis for col in per_axis))


NAMED: MappingProxyType[str, ShiftSet] = MappingProxyType(
    {
        "single": ShiftSet("single", ((0.0, 0.0),)),
        # Zero mean: a first-order error of the image Jacobian cancels. Lands on the fine grid.
        "quarter": _grid("quarter", (-0.25, 0.25)),
        "half": _grid("half", (0.0, 0.5)),
        # (k/5, 2k/5) wrapped into half a pixel: five different phases on each axis.
        "lattice5": ShiftSet(
            "lattice5", ((0.0, 0.0), (0.2, 0.4), (0.4, -0.2), (-0.4, 0.2), (-0.2, -0.4))
        ),
        "third": _grid("third", (-1 / 3, 0.0, 1 / 3)),
        "eighth": _grid("eighth", (-0.375, -0.125, 0.125, 0.375)),
    }
)
"""``quarter`` is the default of the room; ``third`` and ``eighth`` serve factors 3 and 4."""


def named(name: str) -> ShiftSet:
    """One of ``NAMED``. Raises ParameterError with the known names."""
    if name not in NAMED:
        raise ParameterError(f"unknown shift set {name!r}; known: {', '.join(NAMED)}, paper")
    return NAMED[name]


def paper_random(rng: np.random.Generator, count: int = 4, half_width_px: float = 1.0) -> ShiftSet:
    """The paper's set: the first point is the origin, the rest uniform in ±half_width_px."""
    if count < 1:
        raise ParameterError(f"a shift set needs at least one point; {count} were asked for")
    rest = rng.uniform(-half_width_px, half_width_px, size=(count - 1, 2))
    return ShiftSet("paper", ((0.0, 0.0), *((float(row), float(col)) for row, col in rest)))


def from_points(shifts_px: ArrayLike, name: str = "own") -> ShiftSet:
    """The user's own set. Raises ShapeError or NotFiniteError on anything but (N, 2) numbers."""
    shifts = check_shifts(shifts_px)
    return ShiftSet(name, tuple((float(row), float(col)) for row, col in shifts))


def _singular_values(shifts_px: ArrayLike, factor: int) -> NDArray[np.float64]:
    """Of the matrix exp(-2 pi i m.d_k), zero-padded to factor^2 when there are too few shifts."""
    shifts = check_shifts(shifts_px)
    aliases = np.arange(factor)
    rows = np.exp(-2j * math.pi * shifts[:, :1] * aliases)
    cols = np.exp(-2j * math.pi * shifts[:, 1:] * aliases)
    phases = (rows[:, :, None] * cols[:, None, :]).reshape(len(shifts), -1)
    found = np.linalg.svd(phases, compute_uv=False)
    return np.concatenate([found, np.zeros(max(0, factor**2 - len(found)))])


def condition_number(shifts_px: ArrayLike, factor: int = 2) -> float:
    """Largest over smallest singular value: 1 is ideal, inf cannot be reconstructed."""
    values = _singular_values(shifts_px, check_factor(factor))
    if values[-1] <= values[0] * 1e-14:
        return math.inf
    return float(values[0] / values[-1])


def noise_factor(shifts_px: ArrayLike, factor: int = 2) -> float:
    """Noise variance of the reconstruction over that of an ideal set of as many frames (>= 1)."""
    values = _singular_values(shifts_px, check_factor(factor))
    if values[-1] <= values[0] * 1e-14:
        return math.inf
    count = len(check_shifts(shifts_px))
    return float(np.sum(values**-2.0) * count / factor**2)


def require_regular(
    shifts_px: ArrayLike, factor: int, max_condition_number: float = MAX_CONDITION_NUMBER
) -> float:
    """The condition number of the set, or SingularShiftSetError with the reason in words."""
    shifts = check_shifts(shifts_px)
    condition = condition_number(shifts, factor)
    if condition <= max_condition_number:
        return condition
    if len(shifts) < factor**2:
        raise SingularShiftSetError(
            f"factor {factor} needs at least {factor**2} shifts, got {len(shifts)}"
        )
    raise SingularShiftSetError(
        f"the {len(shifts)} shifts are singular for factor {factor} (condition number "
        f"{condition:.3g}, limit {max_condition_number:.3g}): modulo one pixel they do not "
        "separate the aliases, as when all lie on one line"
    )
