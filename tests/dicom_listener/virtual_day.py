"""A room in which everything goes wrong at once, with the truth known: for assignment alone.

Discrete events on our clock. Slices take as long to come as at some site: at once or after two
minutes, regularly or not, one by one or a series at its end. Operators start before the robot
stands. The scanner's clock is off, creeps and is set. The robot moves on when its slices are there,
or when its patience ends. No day begins with a slice that would show anything. Every assignment is
checked against the true interval of the acquisition.
"""

import heapq
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from made_slices import CORONAL, a_slice

from dicom_listener.assign import Assigned, AssignRules, HoldWindow, Known, assign
from dicom_listener.clock_offset import (
    ClockRules,
    Comparison,
    Offset,
    Received,
    ScannerClock,
    observe,
)
from dicom_listener.promptness import FEWEST_DELAYS, Promptness, promptness_of
from dicom_slice.header import Slice
from dicom_slice.reasons import Reason
from dicom_slice.times import AcquisitionInterval

DELAYS = ("regular", "varied", "any", "series")
KNOWLEDGE = ("comparison", "promptness", "both", "neither")


@dataclass(frozen=True)
class Trouble:
    """How much of what goes wrong.

    held_up: a slice comes up to two minutes later than is usual at this site.
    early: the operator starts before the robot stands.
    steps: how often the scanner's clock is set, forward or back, by little or much.
    synchronizes: it follows a time server in the end, is not set any more, and slices say so.
    stack: an acquisition gives so many slices or frames, of the same times and sent together.
    """

    knowledge: str = "comparison"
    delays: str = "regular"
    loss: float = 0.0
    held_up: float = 0.0
    early: float = 0.0
    extra_scans: float = 0.0
    steps: int = 0
    creep_ppm: float = 20.0
    impatience: float = 0.0
    unnumbered: bool = False
    no_duration: float = 0.0
    estimated: float = 0.0
    synchronizes: bool = False
    stack: int = 1


@dataclass
class Outcome:
    """good: slices that were acquired wholly at a standing hold which lacked one.

    filled: of the holds, how many have all their slices in the end.
    """

    assigned: int = 0
    good: int = 0
    filled: int = 0
    set_aside: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Arrival:
    true_from_s: float
    true_to_s: float
    received_s: float
    slice: Slice


def delays_of_site(dice: random.Random, kind: str) -> Callable[[], float]:
    """How long a slice takes to come there, as a function to be asked for each slice."""
    usual_s = 0.2 * 600 ** dice.random()  # 0.2 to 120 s
    if kind == "regular":
        spread_s = min(usual_s, dice.uniform(0.05, 2.0))
        return lambda: usual_s + dice.uniform(-0.5, 0.5) * spread_s
    if kind == "varied":
        return lambda: min(120.0, usual_s * dice.uniform(0.5, 1.5))
    return lambda: 0.2 * 600 ** dice.random()


class VirtualDay:
    """One case of some holds. `run` returns what was assigned, and what wrongly."""

    def __init__(self, dice: random.Random, trouble: Trouble) -> None:
        self.dice, self.trouble = dice, trouble
        self.delay_s = delays_of_site(dice, trouble.delays)
        self.rules = AssignRules()
        promptness = None
        if trouble.knowledge in ("promptness", "both"):
            promptness = self.commissioned()
        self.clock_rules = ClockRules(promptness=promptness)
        self.offset_s = dice.uniform(-300, 300)  # our clock - the scanner's
        self.first_offset_s = self.offset_s
        self.creep = dice.uniform(-1, 1) * trouble.creep_ppm * 1e-6
        self.number = 0
        self.uid = 0
        self.holds: list[HoldWindow] = []
        self.known: dict[int, Known] = {}
        self.waiting: dict[int, tuple[int, Arrival]] = {}
        self.outcome = Outcome()
        self.arrivals: list[tuple[float, int, Arrival]] = []
        self.series: list[tuple[Arrival, ...]] = []
        self.sent = 0
        self.step_times = sorted(dice.uniform(0, 300) for _ in range(trouble.steps))
        self.steps: list[tuple[float, float]] = []
        self.synchronized_from_s = self.step_times[-1] if self.step_times else 0.0
        self.clock = ScannerClock()

    def commissioned(self) -> Promptness:
        return promptness_of([self.delay_s() for _ in range(FEWEST_DELAYS)])

    def run(self, n_holds: int) -> Outcome:
        now_s = 0.0
        if self.trouble.knowledge in ("comparison", "both"):
            self.compare(now_s)
        for place in range(n_holds):
            now_s += self.dice.uniform(0.3, 8.0)  # the robot moves
            now_s = self.stand(now_s, place)
        self.receive_until(now_s + 500, None)
        self.outcome.filled = sum(self.count(h) >= h.expected_slices for h in self.holds)
        return self.outcome

    def compare(self, now_s: float) -> None:
        """Somebody reads the scanner's clock, to 0.2 s, and says that it is 0.25 s."""
        offset_s = now_s - self.scanner_s(now_s) + self.dice.uniform(-0.2, 0.2)
        self.clock = self.clock.compared(Comparison(offset_s, 0.25, now_s), self.clock_rules)
        for key in list(self.waiting):
            number, arrival = self.waiting.pop(key)
            self.decide(arrival, number)

    def stand(self, settled_s: float, place: int) -> float:
        """One hold: scans are asked for until all slices are there or patience ends."""
        wanted = self.dice.randint(1, 3) * self.trouble.stack
        hold = HoldWindow(place + 1, place // 3, settled_s, None, wanted)
        self.holds.append(hold)
        now_s = settled_s
        patience_s = self.dice.expovariate(1 / 30) + 0.5 if self.chance("impatience") else 600.0
        deadline_s = settled_s + patience_s
        while now_s < deadline_s and self.count(hold) < wanted:
            lacking = wanted - self.count(hold)
            now_s = self.scan_some(now_s, math.ceil(lacking / self.trouble.stack))
            wait_s = self.dice.uniform(0.5, 15.0) + self.delay_s() * self.dice.choice((0, 1))
            now_s = self.receive_until(min(now_s + wait_s, deadline_s), (hold, wanted))
            self.heed_page(now_s)
        now_s = max(now_s, settled_s + 0.01)
        self.holds[-1] = replace(hold, ended_at_s=now_s)
        if self.chance("extra_scans"):  # somebody scans while the robot moves
            self.send(*self.scan(now_s + self.dice.uniform(-3.0, 3.0), self.dice.uniform(0.1, 3.0)))
            self.push_series()
        return now_s

    def heed_page(self, now_s: float) -> None:
        """Who is asked to compare the clocks sometimes does; not in a room that never does."""
        told = self.clock.contradicted or self.clock.suspicion or self.waiting
        if told and self.trouble.knowledge != "neither" and self.dice.random() < 0.5:
            self.compare(now_s)

    def scan_some(self, now_s: float, count: int) -> float:
        early_s = self.dice.choice((0.3, 3.0, 20.0)) if self.chance("early") else 0.0
        began_s = now_s + self.dice.uniform(-early_s, 3.0)
        for _ in range(count):
            length_s = self.dice.uniform(0.1, 8.0)
            self.send(*self.scan(began_s, length_s))
            began_s += length_s + self.dice.uniform(0.0, 0.5)
        self.push_series()
        return max(now_s, began_s)

    def chance(self, name: str) -> bool:
        return self.dice.random() < getattr(self.trouble, name)

    def count(self, hold: HoldWindow) -> int:
        return sum(known.hold_id == hold.hold_id for known in self.known.values())

    def scanner_s(self, our_s: float) -> float:
        while self.step_times and self.step_times[0] <= our_s:
            at_s = self.step_times.pop(0)
            self.steps.append((at_s, self.step_s()))
        offset_s = self.offset_s + sum(size for at_s, size in self.steps if at_s <= our_s)
        return our_s - offset_s - self.creep * our_s

    def step_s(self) -> float:
        """By how much the offset changes: less than 0 where the scanner's clock goes forward."""
        size_s = self.dice.choice((0.3, 1.0, 5.0, 20.0, 60.0, 3600.0)) * self.dice.random()
        return size_s if self.dice.random() < 0.5 else -size_s

    def scan(self, began_s: float, length_s: float) -> list[Arrival]:
        """One acquisition: its slices lie side by side, in objects of their own or as frames."""
        self.number += 1
        from_s = self.scanner_s(began_s)
        end_s: float | None = from_s + length_s
        estimated = False
        if self.chance("no_duration"):
            end_s = None
        elif self.chance("estimated"):
            end_s, estimated = from_s + length_s * self.dice.uniform(1.0, 3.0), True
        common = a_slice(
            interval=AcquisitionInterval(from_s, end_s, "AcquisitionDateTime", estimated),
            acquisition_number=1 if self.trouble.unnumbered else self.number,
            clock_synchronized=self.trouble.synchronizes and began_s > self.synchronized_from_s,
        )
        n_slices = self.trouble.stack
        in_one_object = n_slices > 1 and self.dice.random() < 0.5
        scans = []
        for place in range(n_slices):
            self.uid += place == 0 or not in_one_object
            slice_ = replace(
                common,
                sop_instance_uid=f"1.2.{self.uid}",
                frame=place if in_one_object else 0,
                n_frames=n_slices if in_one_object else 1,
                geometry=replace(CORONAL, position_mm=(-40.0, 10.0 + 5 * place, 60.0)),
            )
            scans.append(Arrival(began_s, began_s + length_s, math.nan, slice_))
        return scans

    def send(self, *scans: Arrival) -> None:
        if self.chance("loss"):
            return
        self.series.append(scans)

    def push_series(self) -> None:
        """Each acquisition in one push as it ends, or all of them when the last one has."""
        last_s = max((scans[0].true_to_s for scans in self.series), default=0.0)
        for scans in self.series:
            ready_s = last_s if self.trouble.delays == "series" else scans[0].true_to_s
            received_s = ready_s + self.delay_s()
            if self.chance("held_up"):
                received_s += self.dice.uniform(0.0, 120.0)
            for scan in scans:
                arrival = replace(scan, received_s=received_s)
                self.sent += 1
                heapq.heappush(self.arrivals, (received_s, self.sent, arrival))
                if scan.slice.n_frames == 1:
                    received_s += self.dice.uniform(0.0, 0.2)
        self.series.clear()

    def receive_until(self, limit_s: float, wanted: tuple[HoldWindow, int] | None) -> float:
        """Take what arrives; return when: at the limit, or as soon as the hold has its slices."""
        while self.arrivals and self.arrivals[0][0] <= limit_s:
            received_s, _, arrival = heapq.heappop(self.arrivals)
            self.receive(arrival)
            if wanted and self.count(wanted[0]) >= wanted[1]:
                return received_s
        return limit_s

    def receive(self, arrival: Arrival) -> None:
        self.outcome.good += self.is_good(arrival)
        before = self.clock
        self.clock = observe(before, self.received(arrival), self.clock_rules).clock
        self.decide(arrival, len(self.known))
        rules = self.clock_rules
        if self.clock.is_witnessed(rules) and not before.is_witnessed(rules):
            for key in list(self.waiting):
                number, waited = self.waiting.pop(key)
                self.decide(waited, number)

    def received(self, arrival: Arrival) -> Received:
        assert arrival.slice.interval is not None
        return Received(
            arrival.slice.interval, arrival.received_s, arrival.slice.clock_synchronized is True
        )

    def decide(self, arrival: Arrival, number: int) -> None:
        known = [k for key, k in self.known.items() if key < number or k.hold_id is not None]
        decision = assign(
            arrival.slice,
            arrival.received_s,
            self.holds,
            known,
            self.bounds_of(arrival),
            self.rules,
        )
        hold_id, code = None, ""
        if isinstance(decision, Assigned):
            hold_id = decision.hold_id
            self.check(arrival, hold_id)
        else:
            code = str(decision.code)
            assert decision.text
            if decision.code == Reason.CLOCK_UNKNOWN:
                self.waiting[number] = number, arrival
            where = self.outcome.set_aside
            where[code] = where.get(code, 0) + 1
        self.known[number] = Known(arrival.slice, arrival.received_s, hold_id, code)

    def bounds_of(self, arrival: Arrival) -> Offset:
        return self.clock.bounds_for(self.received(arrival), self.clock_rules)

    def is_good(self, arrival: Arrival) -> bool:
        """Acquired at the standing hold, which lacked it, and here before the robot went on."""
        hold = self.holds[-1]
        return (
            hold.ended_at_s is None
            and arrival.true_from_s >= hold.settled_at_s
            and self.count(hold) < hold.expected_slices
        )

    def check(self, arrival: Arrival, hold_id: int) -> None:
        self.outcome.assigned += 1
        hold = next(hold for hold in self.holds if hold.hold_id == hold_id)
        end_s = hold.ended_at_s
        if not hold.settled_at_s <= arrival.true_from_s or (
            end_s is not None and arrival.true_to_s > end_s
        ):
            self.outcome.wrong.append(
                f"acquired {arrival.true_from_s:.2f} to {arrival.true_to_s:.2f}, received "
                f"{arrival.received_s:.2f}, assigned to hold {hold_id} "
                f"({hold.settled_at_s:.2f} to {end_s})"
            )
