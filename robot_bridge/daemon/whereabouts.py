"""What is known of where each axis stands, beyond what its motor counts.

A count is believed only since it was declared or homed, and less with every run of an axis without
encoder, because no step is as long as it is said to be. What images say of it corrects it. All of
this is in the journal, so that a bridge that was killed in a motion knows afterwards that the axis
stands somewhere between where it came from and where it was going.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

RUN_SIGMAS = 2.0  # where a single run ends, in units of the axis's tolerance


@dataclass(frozen=True)
class Growth:
    """How what is not known of an axis grows as it moves; zeros for one with an encoder.

    step_error: fraction of the way. run_um: by each run, independent of the others.
    approach_um: how far below its setpoint a move may go to arrive from there.
    """

    step_error: float = 0.0
    run_um: float = 0.0
    approach_um: int = 0
    tolerance_um: int = 20


@dataclass(frozen=True)
class Stand:
    """The axis counts `at_um` and truly stands at `at_um + correction_um`, give or take
    `bound_um`. `spread_um2`: the variance that independent runs have added to it.
    """

    at_um: int
    known_to_um: float = 0.0
    spread_um2: float = 0.0
    correction_um: int = 0

    @property
    def true_um(self) -> int:
        return self.at_um + self.correction_um

    @property
    def bound_um(self) -> int:
        return math.ceil(self.known_to_um + math.sqrt(self.spread_um2))

    def moved(self, to_um: int, growth: Growth) -> "Stand":
        """At the end of a move that arrived at `to_um`."""
        way_um = abs(to_um - self.at_um)
        if way_um == 0:
            return self
        runs = 1
        if growth.approach_um and to_um < self.at_um + growth.approach_um:
            way_um, runs = way_um + 2 * growth.approach_um, 2
        return replace(
            self,
            at_um=to_um,
            known_to_um=self.known_to_um + growth.step_error * way_um,
            spread_um2=self.spread_um2 + runs * growth.run_um**2,
        )

    def on_the_way(self, to_um: int, growth: Growth) -> "Stand":
        """Anywhere between here and the end of a move to `to_um`."""
        there = self.moved(to_um, growth)
        half_um = abs(to_um - self.at_um) / 2
        return replace(
            there, at_um=(self.at_um + to_um) // 2, known_to_um=there.known_to_um + half_um + 1
        )

    def cut_short(self, at_um: int, within_um: int, growth: Growth) -> "Stand":
        """A move ended before its time; the way to within `within_um` of `at_um` was counted."""
        there = self.moved(at_um, growth)
        return replace(there, known_to_um=there.known_to_um + within_um)

    def as_entry(self) -> list[float]:
        return [self.at_um, round(self.known_to_um, 3), round(self.spread_um2, 3),
                self.correction_um]  # fmt: skip


def stand_from_entry(entry: list[float]) -> Stand:
    """Raises ValueError or TypeError."""
    at_um, known_to_um, spread_um2, correction_um = entry
    return Stand(int(at_um), float(known_to_um), float(spread_um2), int(correction_um))


class Whereabouts:
    """By axis; an axis of which nothing was ever known has no `Stand`."""

    def __init__(self, growth: Mapping[str, Growth], stands: Mapping[str, Stand]) -> None:
        self.growth = dict(growth)
        self.stands = dict(stands)

    def growth_of(self, axis: str) -> Growth:
        return self.growth.get(axis, Growth())

    def declared(
        self,
        positions_um: Mapping[str, int],
        within_um: Mapping[str, int],
        were_certain: Collection[str] = (),
    ) -> None:
        """An axis that is declared where it was only guessed to be is known no better by that.

        were_certain: nobody was asked to confirm a guess of these; they were measured.
        """
        for axis, at_um in positions_um.items():
            guess = self.stands.get(axis)
            if axis in within_um:
                stand = Stand(at_um, float(within_um[axis]))
            elif (
                guess
                and axis not in were_certain
                and abs(guess.true_um - at_um) <= self.growth_of(axis).tolerance_um
            ):
                stand = replace(guess, at_um=at_um, correction_um=0)
            else:
                stand = Stand(at_um)
            self.stands[axis] = stand

    def homed(self, positions_um: Mapping[str, int]) -> None:
        self.stands |= {axis: Stand(at_um) for axis, at_um in positions_um.items()}

    def strayed(self, axes: Collection[str], readback_um: Mapping[str, int]) -> None:
        """These are not certain any longer, and read something else without a command of ours."""
        for axis in axes & self.stands.keys():
            stand, growth = self.stands[axis], self.growth_of(axis)
            if abs(readback_um[axis] - stand.at_um) > growth.tolerance_um:
                self.stands[axis] = stand.on_the_way(readback_um[axis], growth)

    def forget(self, axes: Collection[str]) -> None:
        for axis in axes:
            self.stands.pop(axis, None)

    def going(self, setpoints_um: Mapping[str, int]) -> dict[str, Stand]:
        """What is left to know if nothing more is heard of a move to these setpoints."""
        return {
            axis: stand.on_the_way(setpoints_um[axis], self.growth_of(axis))
            for axis, stand in self.stands.items()
            if self.moves(axis, setpoints_um)
        }

    def arrived(
        self, readback_um: Mapping[str, int], axes: Collection[str], within_um: Mapping[str, int]
    ) -> None:
        """These axes stand, certain, where they read, give or take `within_um`, if it is there."""
        for axis in axes:
            if axis in self.stands:
                stand, within = self.stands[axis], within_um.get(axis, 0)
                growth = self.growth_of(axis)
                self.stands[axis] = stand.cut_short(readback_um[axis], within, growth)

    def ended_early(
        self, going: Mapping[str, Stand], readback_um: Mapping[str, int],
        within_um: Mapping[str, int],
    ) -> None:  # fmt: skip
        """These axes are not certain after a move; `going`: if nothing more is known of it."""
        for axis, anywhere in going.items():
            if axis in within_um:
                stand, growth = self.stands[axis], self.growth_of(axis)
                anywhere = stand.cut_short(readback_um[axis], within_um[axis], growth)
            self.stands[axis] = anywhere

    def corrected(self, correction_um: Mapping[str, int], within_um: Mapping[str, int]) -> None:
        for axis, by_um in correction_um.items():
            if axis in self.stands:
                stand = self.stands[axis]
                self.stands[axis] = Stand(stand.at_um, float(within_um[axis]), 0.0, by_um)

    def moves(self, axis: str, setpoints_um: Mapping[str, int]) -> bool:
        stand = self.stands.get(axis)
        if axis not in setpoints_um:
            return False
        return stand is None or (
            abs(setpoints_um[axis] - stand.at_um) > self.growth_of(axis).tolerance_um
        )

    def reach_um(self, axis: str, setpoint_um: int) -> tuple[float, float]:
        """Between which places the axis may truly come to stand, or pass, if it is sent there."""
        stand, growth = self.stands.get(axis, Stand(setpoint_um)), self.growth_of(axis)
        end = stand.moved(setpoint_um, growth)
        true_um = setpoint_um + stand.correction_um
        return true_um - end.bound_um, true_um + end.bound_um
