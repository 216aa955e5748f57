"""Which hold a slice belongs to; none is ever used for a hold at which it was not acquired."""

import random
from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_slices import CORONAL, a_slice
from virtual_day import DELAYS, KNOWLEDGE, Trouble, VirtualDay

from dicom_listener.assign import (
    ARRIVAL,
    Assigned,
    AssignRules,
    HoldWindow,
    Known,
    Pending,
    Quarantined,
    assign,
)
from dicom_listener.clock_offset import OffsetBounds, OffsetUnknown
from dicom_listener.promptness import Promptness, Witness
from dicom_slice.reasons import Reason
from dicom_slice.times import AcquisitionInterval

RULES = AssignRules(guard_s=0.1)
SAME_CLOCK = OffsetBounds(-0.05, 0.05)
STANDING = HoldWindow(1, 1, 990.0, None, 2)


def decide(slice_=None, received_s=1003.0, holds=(STANDING,), known=(), offset=SAME_CLOCK, **rules):
    wanted = replace(RULES, **rules)
    return assign(slice_ or a_slice(), received_s, holds, known, offset, wanted)


def why(decision) -> Reason:
    assert isinstance(decision, (Quarantined, Pending))
    assert decision.text
    return decision.code


def test_a_slice_acquired_within_the_standing_hold_is_assigned_to_it():
    decision = decide()
    assert decision == Assigned(1, "AcquisitionDateTime", 999.95, 1002.05)


def test_the_acquisition_must_begin_after_settling_with_the_guard_and_the_worst_clock():
    hold = replace(STANDING, settled_at_s=1000.0 - 0.05 - 0.1)
    assert isinstance(decide(holds=[hold]), Assigned)
    later = replace(hold, settled_at_s=hold.settled_at_s + 0.01)
    assert why(decide(holds=[later])) == Reason.OUTSIDE_HOLD
    assert "begun only 0.09 s after hold 1 had settled" in decide(holds=[later]).text


def test_an_acquisition_that_may_have_lasted_into_the_move_is_not_used():
    hold = replace(STANDING, ended_at_s=1002.1)
    assert why(decide(received_s=1002.09, holds=[hold])) == Reason.OUTSIDE_HOLD
    assert isinstance(
        decide(received_s=1002.09, holds=[replace(hold, ended_at_s=1002.3)]), Assigned
    )


def test_a_slice_that_comes_after_its_hold_ended_is_not_used():
    holds = [replace(STANDING, ended_at_s=1005.0), HoldWindow(2, 1, 1007.0, None, 1)]
    assert why(decide(received_s=1008.0, holds=holds)) == Reason.RECEIVED_AFTER_HOLD


def test_without_any_hold_or_before_the_first_there_is_none_to_belong_to():
    assert why(decide(holds=[])) == Reason.NO_HOLD
    assert why(decide(holds=[HoldWindow(1, 1, 1500.0, None, 1)])) == Reason.NO_HOLD


def test_a_slice_between_two_holds_is_not_used():
    holds = [replace(STANDING, ended_at_s=995.0), HoldWindow(2, 1, 1002.5, None, 1)]
    assert why(decide(holds=holds)) == Reason.NO_HOLD
    during_move = [replace(STANDING, ended_at_s=1001.0), HoldWindow(2, 1, 1002.5, None, 1)]
    assert why(decide(holds=during_move)) == Reason.OUTSIDE_HOLD


def test_a_slice_without_time_or_with_a_nonsense_time_says_so():
    assert why(decide(a_slice(interval=None))) == Reason.NO_TIME
    nonsense = a_slice(interval=None, time_problem="the year is 0001")
    assert why(decide(nonsense)) == Reason.IMPLAUSIBLE_TIME


def test_where_the_clock_is_not_known_a_slice_waits_if_a_hold_was_open_when_it_came():
    unknown = OffsetUnknown("not compared: compare the clocks")
    waiting = decide(offset=unknown)
    assert waiting == Pending(Reason.CLOCK_UNKNOWN, unknown.text)
    gone = [replace(STANDING, ended_at_s=1002.9)]
    assert why(decide(offset=unknown, holds=gone)) == Reason.NO_HOLD


def test_where_the_clock_may_have_been_set_unseen_a_slice_waits_for_another_comparison():
    waiting = decide(offset=replace(SAME_CLOCK, low_if_set_s=-20.0))
    assert isinstance(waiting, Pending)
    assert why(waiting) == Reason.CLOCK_UNKNOWN
    assert "not been compared since hold 1 settled" in waiting.text
    assert isinstance(decide(offset=replace(SAME_CLOCK, low_if_set_s=-9.9)), Assigned)
    before = replace(STANDING, settled_at_s=1000.5)
    assert why(decide(holds=[before], offset=replace(SAME_CLOCK, low_if_set_s=0.6))) == (
        Reason.OUTSIDE_HOLD
    )


def test_a_slice_from_the_future_or_from_long_ago_shows_a_clock_that_jumped():
    assert why(decide(received_s=999.0)) == Reason.FUTURE
    assert why(decide(received_s=1500.0)) == Reason.LATE


def test_an_estimated_end_is_replaced_by_the_receipt():
    estimated = a_slice(interval=AcquisitionInterval(1000.0, 1060.0, "AcquisitionDateTime", True))
    assert decide(estimated).acquired_to_s == 1003.0
    unknown = a_slice(interval=AcquisitionInterval(1000.0, None, "AcquisitionDateTime"))
    assert decide(unknown).acquired_to_s == 1003.0


def known_at(hold_id, received_s=980.0, code="", **changes) -> Known:
    return Known(a_slice(**changes), received_s, hold_id, code)


def test_an_acquisition_numbered_before_one_that_came_before_the_hold_is_not_used():
    earlier = known_at(None, series_number=2, acquisition_number=1)
    assert why(decide(known=[earlier])) == Reason.OUT_OF_ORDER
    other_study = replace(earlier, slice=replace(earlier.slice, study_instance_uid="9.9"))
    assert isinstance(decide(known=[other_study]), Assigned)


def test_swapped_slices_of_one_hold_are_both_used():
    newer = known_at(1, received_s=1002.5, acquisition_number=2)
    assert isinstance(decide(known=[newer]), Assigned)


def test_after_a_hold_that_lacks_a_slice_the_first_acquisition_is_not_believed():
    holds = [HoldWindow(1, 1, 900.0, 950.0, 1), HoldWindow(2, 1, 960.0, None, 1)]
    assert why(decide(holds=holds)) == Reason.AFTER_INCOMPLETE_HOLD
    first = known_at(None, 1003.0, Reason.AFTER_INCOMPLETE_HOLD)
    again = a_slice(
        acquisition_number=2,
        interval=AcquisitionInterval(1010.0, 1011.0, "AcquisitionDateTime"),
    )
    assert isinstance(decide(again, 1012.0, holds, [first]), Assigned)
    # the other slices of the doubtful acquisition remain doubtful
    assert why(decide(a_slice(frame=1), 1003.1, holds, [first])) == Reason.AFTER_INCOMPLETE_HOLD


def test_a_set_is_made_of_the_same_slice_positions_on_the_same_grid():
    holds = [HoldWindow(1, 7, 900.0, 950.0, 1), HoldWindow(2, 7, 960.0, None, 1)]
    first = known_at(1, 940.0, interval=AcquisitionInterval(930.0, 931.0, "x"))
    assert isinstance(decide(holds=holds, known=[first]), Assigned)
    for change in (
        {"position_mm": (-40.0, 11.0, 60.0)},
        {"spacing_mm": (1.0, 1.0)},
        {"shape": (64, 96)},
        {"row_direction": (0, 0.0998, -0.995), "col_direction": (1, 0, 0)},
    ):
        moved = a_slice(geometry=replace(CORONAL, **change))
        assert why(decide(moved, holds=holds, known=[first])) == Reason.GEOMETRY_DIFFERS
    other_set = [holds[0], replace(holds[1], set_id=8)]
    moved = a_slice(geometry=replace(CORONAL, position_mm=(0.0, 11.0, 60.0)))
    assert isinstance(decide(moved, holds=other_set, known=[first]), Assigned)


def test_two_fiducials_in_two_slice_positions_fill_a_hold_together():
    lower = replace(CORONAL, position_mm=(-40.0, 40.0, 60.0))
    holds = [HoldWindow(1, 7, 900.0, 950.0, 2), HoldWindow(2, 7, 960.0, None, 2)]
    known = [known_at(1, 940.0), known_at(1, 941.0, geometry=lower)]
    assert isinstance(decide(a_slice(geometry=lower), holds=holds, known=known), Assigned)
    third = a_slice(geometry=replace(CORONAL, position_mm=(-40.0, 25.0, 60.0)))
    assert why(decide(third, holds=holds, known=known)) == Reason.GEOMETRY_DIFFERS


def test_the_distortion_corrected_twin_of_a_slice_is_set_aside():
    plain = known_at(1, 1002.5, distortion_corrected=False)
    twin = a_slice(sop_instance_uid="1.2.9", distortion_corrected=True)
    assert why(decide(twin, known=[plain])) == Reason.DISTORTION_TWIN
    holds = [HoldWindow(1, 7, 900.0, 950.0, 1), HoldWindow(2, 7, 960.0, None, 1)]
    earlier = known_at(1, 940.0, distortion_corrected=False)
    assert why(decide(twin, holds=holds, known=[earlier])) == Reason.DISTORTION_TWIN


def test_more_slices_than_expected_wait_while_the_hold_stands_and_are_set_aside_after():
    full = [known_at(1, 1001.0), known_at(1, 1001.5)]
    waiting = decide(known=full)
    assert isinstance(waiting, Pending)
    assert why(waiting) == Reason.NOT_EXPECTED
    ended = decide(holds=[replace(STANDING, ended_at_s=1010.0)], known=full)
    assert isinstance(ended, Quarantined)
    more = replace(STANDING, expected_slices=3)
    assert isinstance(decide(holds=[more], known=full), Assigned)


def test_in_arrival_mode_the_operators_confirmation_replaces_the_time():
    timeless = a_slice(interval=None)
    waiting = decide(timeless, offset=OffsetUnknown("not compared"), arrival_mode=True)
    assert isinstance(waiting, Pending)
    assert why(waiting) == Reason.NOT_CONFIRMED
    confirmed = [replace(STANDING, confirmed=True)]
    decision = decide(
        timeless, holds=confirmed, offset=OffsetUnknown("not compared"), arrival_mode=True
    )
    assert decision == Assigned(1, ARRIVAL, 990.0, 1003.0)
    gone = [replace(STANDING, ended_at_s=1001.0, confirmed=True)]
    assert (
        why(decide(timeless, holds=gone, offset=OffsetUnknown("not compared"), arrival_mode=True))
        == Reason.NO_HOLD
    )


troubles = st.builds(
    Trouble,
    knowledge=st.sampled_from(KNOWLEDGE),
    delays=st.sampled_from(DELAYS),
    loss=st.sampled_from((0.0, 0.1, 0.5)),
    held_up=st.sampled_from((0.0, 0.02, 0.3)),
    early=st.sampled_from((0.0, 0.1, 0.5)),
    extra_scans=st.sampled_from((0.0, 0.3, 1.0)),
    steps=st.integers(0, 3),
    creep_ppm=st.sampled_from((20.0, 500.0)),
    impatience=st.sampled_from((0.0, 0.3, 1.0)),
    unnumbered=st.booleans(),
    no_duration=st.sampled_from((0.0, 0.2, 1.0)),
    estimated=st.sampled_from((0.0, 0.3, 1.0)),
    synchronizes=st.booleans(),
    stack=st.sampled_from((1, 1, 3, 5)),
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(trouble=troubles, seed=st.integers(0, 2**32), n_holds=st.integers(1, 8))
def test_no_slice_is_ever_used_for_a_hold_at_which_it_was_not_acquired(trouble, seed, n_holds):
    trouble = one_at_a_time(trouble, is_held_up=seed % 3 == 0)
    outcome = VirtualDay(random.Random(seed), trouble).run(n_holds)
    assert outcome.wrong == []


def one_at_a_time(trouble: Trouble, *, is_held_up: bool) -> Trouble:
    """Promptness was measured: it may fail, or the clock may be set; not both on one day."""
    if trouble.knowledge not in ("promptness", "both"):
        return trouble
    return replace(trouble, steps=0) if is_held_up else replace(trouble, held_up=0.0)


def any_trouble(dice: random.Random, knowledge: str) -> Trouble:
    trouble = all_troubles(dice, knowledge)
    return one_at_a_time(trouble, is_held_up=dice.random() < 0.3)


def all_troubles(dice: random.Random, knowledge: str) -> Trouble:
    return Trouble(
        knowledge=knowledge,
        delays=dice.choice(DELAYS),
        loss=dice.choice((0, 0, 0.1, 0.5)),
        held_up=dice.choice((0, 0, 0.02, 0.3)),
        early=dice.choice((0, 0.1, 0.5)),
        extra_scans=dice.choice((0, 0, 0.3, 1)),
        steps=dice.choice((0, 0, 1, 3)),
        creep_ppm=dice.choice((20, 500)),
        impatience=dice.choice((0, 0.3, 1)),
        unnumbered=dice.random() < 0.3,
        no_duration=dice.choice((0, 0, 0.2, 1)),
        estimated=dice.choice((0, 0, 0.3, 1)),
        synchronizes=dice.random() < 0.3,
        stack=dice.choice((1, 1, 3, 5)),
    )


@dataclass
class Campaign:
    """Sums over days that differ in nothing but their seed."""

    assigned: int = 0
    good: int = 0
    holds: int = 0
    filled: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def share(self) -> float:
        """Of the slices acquired at a hold that lacked one, how many were used."""
        return (self.assigned - len(self.wrong)) / self.good


def campaign(knowledge: str, n_days: int, first_seed: int, troubles=any_trouble) -> Campaign:
    sums = Campaign()
    for seed in range(first_seed, first_seed + n_days):
        dice = random.Random(seed)
        day = VirtualDay(dice, troubles(dice, knowledge))
        outcome = day.run(dice.randint(1, 8))
        sums.holds += len(day.holds)
        sums.filled += outcome.filled
        sums.assigned += outcome.assigned
        sums.good += outcome.good
        sums.wrong += [f"seed {seed}: {text}" for text in outcome.wrong]
    return sums


@pytest.mark.parametrize("knowledge", ["comparison", "promptness", "both"])
def test_a_short_campaign_of_bad_days_assigns_much_and_nothing_wrongly(knowledge):
    sums = campaign(knowledge, 200, first_seed=0)
    assert sums.wrong == []
    assert sums.share > 0.15


def test_with_neither_a_comparison_nor_a_measured_promptness_nothing_is_assigned_by_time():
    sums = campaign("neither", 40, first_seed=0)
    assert sums.assigned == 0
    assert sums.good > 500


@pytest.mark.soak
@pytest.mark.parametrize(
    ("knowledge", "n_days"),
    [("comparison", 80_000), ("promptness", 55_000), ("both", 55_000), ("neither", 10_000)],
)
def test_two_hundred_thousand_bad_days_assign_nothing_wrongly(knowledge, n_days):
    sums = campaign(knowledge, n_days, first_seed=10_000)
    print(
        f"{knowledge}: {n_days} days, {len(sums.wrong)} of {sums.assigned} assigned wrongly; used "
        f"{sums.share:.1%} of the good slices; complete {sums.filled / sums.holds:.1%} of the holds"
    )
    assert sums.wrong == []


@pytest.mark.soak
@pytest.mark.parametrize("knowledge", ["promptness", "both"])
def test_slices_that_are_held_up_while_the_clock_is_set_are_rarely_taken_for_prompt_ones(knowledge):
    """What measured promptness leaves open, as the docs say: less than 1 of 10,000 assignments."""
    sums = campaign(knowledge, 20_000, 10_000, all_troubles)
    print(f"{knowledge}: {len(sums.wrong)} of {sums.assigned} assigned wrongly")
    assert len(sums.wrong) < 1e-4 * sums.assigned


@pytest.mark.parametrize("knowledge", ["comparison", "promptness", "both"])
def test_on_a_good_day_every_hold_gets_its_slices(knowledge):
    for seed in range(50):
        day = VirtualDay(random.Random(seed), Trouble(knowledge=knowledge))
        outcome = day.run(6)
        assert outcome.wrong == []
        for hold in day.holds:
            assert day.count(hold) == hold.expected_slices


def test_the_generator_does_catch_an_assignment_that_is_too_trusting():
    """With the guard against clocks taken out, the same days give wrong assignments."""

    class Trusting(VirtualDay):
        def bounds_of(self, arrival):
            return OffsetBounds(self.first_offset_s, self.first_offset_s)

    def is_wrong(seed: int) -> bool:
        dice = random.Random(seed)
        trouble = replace(any_trouble(dice, "comparison"), steps=3, early=0.5)
        return bool(Trusting(dice, trouble).run(6).wrong)

    assert any(is_wrong(seed) for seed in range(100))


def test_the_generator_does_catch_a_stack_that_is_its_own_witness(monkeypatch):
    """With every slice a witness for itself, the same days give wrong assignments."""
    monkeypatch.setattr(Witness, "is_one_with", lambda self, other: False)

    def is_wrong(seed: int) -> bool:
        dice = random.Random(seed)
        trouble = any_trouble(dice, "promptness")
        trouble = replace(trouble, delays="regular", early=0.5, held_up=0.3, steps=0, stack=5)
        return bool(VirtualDay(dice, trouble).run(3).wrong)

    assert any(is_wrong(seed) for seed in range(300))


def test_the_generator_does_catch_a_promptness_that_nobody_measured():
    """Three seconds taken for granted: what was wrong with days that begin with a prompt slice."""

    class Assuming(VirtualDay):
        def commissioned(self):
            return Promptness(0.0, 3.0)

    def is_wrong(seed: int) -> bool:
        dice = random.Random(seed)
        trouble = replace(any_trouble(dice, "promptness"), delays="regular", early=0.5)
        return bool(Assuming(dice, trouble).run(6).wrong)

    assert any(is_wrong(seed) for seed in range(300))
