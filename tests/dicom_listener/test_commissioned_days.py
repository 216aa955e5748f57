"""Generated days at sites that were commissioned: what was written keeps them right."""

import random

import numpy as np
import pytest
from made_slices import a_slice
from test_assignment import any_trouble
from virtual_day import VirtualDay

from dicom_listener.clock_offset import Comparison
from dicom_slice.times import AcquisitionInterval
from service.commissioning.clocks import find_clock
from service.commissioning.evidence import Press, Reception, one_series


def made_up(delay_s, dice: random.Random, offset_s: float, ended_s: float):
    """A commissioning of five series in made-up time, without pixels: for the clocks alone."""
    now_s, sessions, number = ended_s - 200.0, [], 0
    for _ in range(5):
        now_s += 20.0
        started = Press("start", now_s + dice.uniform(-0.4, 0.9))
        receptions = []
        for _ in range(5):
            number += 1
            length_s = dice.uniform(0.5, 3.0)
            by_scanner_s = now_s - offset_s
            interval = AcquisitionInterval(by_scanner_s, by_scanner_s + length_s, "made up")
            header = a_slice(interval=interval, series_instance_uid="1.2")
            received_s = now_s + length_s + delay_s()
            receptions.append(Reception(header, np.zeros((1, 1)), received_s))
            now_s += length_s
        ended = Press("end", now_s + dice.uniform(-0.4, 0.9))
        sessions.append(one_series(receptions, started, ended))
    return sessions


class CommissionedDay(VirtualDay):
    """A day at a site that was commissioned just before it."""

    def commissioned(self):
        usual = made_up(self.delay_s, self.dice, 0.0, -60.0)
        return find_clock(usual).promptness

    def compare(self, now_s):
        """The first comparison is the one that the commissioning wrote."""
        if self.clock.comparisons:
            super().compare(now_s)
            return
        offset_s = now_s - self.scanner_s(now_s)
        found = find_clock(made_up(self.delay_s, self.dice, offset_s, now_s))
        assert abs(found.offset_s - offset_s) <= found.uncertainty_s
        made = Comparison(found.offset_s, found.uncertainty_s, now_s)
        self.clock = self.clock.compared(made, self.clock_rules)


def days(n_days: int, first_seed: int) -> tuple[int, int, list[str]]:
    assigned = good = 0
    wrong: list[str] = []
    for seed in range(first_seed, first_seed + n_days):
        dice = random.Random(seed)
        knowledge = dice.choice(("promptness", "both"))
        day = CommissionedDay(dice, any_trouble(dice, knowledge))
        outcome = day.run(dice.randint(1, 8))
        assigned, good = assigned + outcome.assigned, good + outcome.good
        wrong += [f"seed {seed}: {text}" for text in outcome.wrong]
    return assigned, good, wrong


def test_with_what_a_commissioning_wrote_no_slice_of_bad_days_is_assigned_wrongly():
    assigned, good, wrong = days(200, first_seed=0)
    assert wrong == []
    assert assigned > 0.1 * good


@pytest.mark.soak
def test_ten_thousand_days_with_what_a_commissioning_wrote():
    assigned, good, wrong = days(10_000, first_seed=1000)
    print(f"{assigned} assigned, {assigned / good:.1%} of the good ones, {len(wrong)} wrong")
    assert wrong == []
