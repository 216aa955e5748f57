"""How soon slices come after their acquisition: what was measured, and what bears witness to it.

Slices that were held up do not come equally late, if they were held up each for itself. So only
acquisitions that are independent of each other count: the slices of one acquisition are as late as
each other, and so are acquisitions that a network or a console lets go at once.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

FEWEST_DELAYS = 20
_MARGIN_S = 0.1
# what comes within this of another slice may have been sent together with it
_SAME_PUSH_S = 1.0
# clocks in headers are rounded
_SAME_START_S = 0.01


@dataclass(frozen=True)
class Promptness:
    """How soon slices come after their acquisition has ended, as measured at this site."""

    least_s: float
    most_s: float


@dataclass(frozen=True)
class Witness:
    """Slices that may have been acquired or sent together, as one.

    least_lag (s, whether its end is certain): of the least late one. acquired_s: from and to, by
    the scanner's clock; received_s: from and to, by ours.
    """

    least_lag: tuple[float, bool]
    acquired_s: tuple[float, float]
    received_s: tuple[float, float]

    def is_one_with(self, other: "Witness") -> bool:
        """Whether anything of one overlaps with the other's acquisitions, or came with it."""
        apart_s = _gap_s(self.acquired_s, other.acquired_s)
        same_start = abs(self.acquired_s[0] - other.acquired_s[0]) <= _SAME_START_S
        together = _gap_s(self.received_s, other.received_s) <= _SAME_PUSH_S
        return apart_s < 0 or same_start or together


def with_witness(before: Iterable[Witness], new: Witness, most: int) -> tuple[Witness, ...]:
    """The least late ones, at most so many, by their lag; and the one that came last.

    What comes next may belong to that, however late it is.
    """
    others = []
    for one in before:
        if one.is_one_with(new):
            new = _merged(one, new)
        else:
            others.append(one)
    kept = sorted((*others, new), key=lambda one: one.least_lag)
    return tuple(one for place, one in enumerate(kept) if place < most or one is new)


def _merged(one: Witness, other: Witness) -> Witness:
    return Witness(
        min(one.least_lag, other.least_lag),
        _hull(one.acquired_s, other.acquired_s),
        _hull(one.received_s, other.received_s),
    )


def _hull(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    return min(one[0], other[0]), max(one[1], other[1])


def _gap_s(one: tuple[float, float], other: tuple[float, float]) -> float:
    """How long lies between two intervals; below 0 where they overlap."""
    return max(one[0], other[0]) - min(one[1], other[1])


class TooFewDelaysError(ValueError):
    """So few slices say nothing of the latest one."""


def promptness_of(delays_s: Sequence[float]) -> Promptness:
    """Bounds for the delay of a slice, from those of `FEWEST_DELAYS` or more (seconds).

    The range seen is widened by half of itself at both ends: of the next slice, 20 delays bound
    the range alone with a probability of 19/21.
    """
    if len(delays_s) < FEWEST_DELAYS:
        raise TooFewDelaysError(f"at least {FEWEST_DELAYS} delays are needed, got {len(delays_s)}")
    least_s, most_s = min(delays_s), max(delays_s)
    margin_s = (most_s - least_s) / 2 + _MARGIN_S
    return Promptness(max(0.0, least_s - margin_s), most_s + margin_s)
