"""A room in which everything goes wrong at once, with the truth known: for assignment alone.

Discrete events on our clock. A scanner acquires when asked, and when not; its clock is off, drifts
and jumps; slices come late, swapped, or never; the robot moves on when its slices are there, or
when its patience ends. Every assignment is checked against the true interval of the acquisition.
"""

import heapq
import random
from dataclasses import dataclass, field, replace

from listener_room import a_slice

from dicom_listener.assign import Assigned, AssignRules, HoldWindow, Known, Pending, assign
from dicom_listener.clock import ClockRules, OffsetBounds, ScannerClock, Sync, observe
from dicom_slice.header import Slice
from dicom_slice.times import AcquisitionInterval


@dataclass(frozen=True)
class Trouble:
    """How much of what goes wrong.

    late_after_jump: slices may be late although the clock has just jumped and no prompt slice has
    shown it. Nothing in a slice tells such a pair of faults from a good slice where they cancel.
    """

    loss: float = 0.0
    late: float = 0.0
    extra_scans: float = 0.0
    jumps: int = 0
    impatience: float = 0.0
    unnumbered: bool = False
    no_duration: float = 0.0
    estimated: float = 0.0
    synced: bool = True
    late_after_jump: bool = False


@dataclass
class Outcome:
    assigned: int = 0
    set_aside: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Arrival:
    true_from_s: float
    true_to_s: float
    received_s: float
    slice: Slice


class VirtualDay:
    """One case of some holds. `run` returns what was assigned, and what wrongly."""

    prompt_s = 2.0

    def __init__(self, dice: random.Random, trouble: Trouble, *, ask_after_s: float = 0.0) -> None:
        self.dice, self.trouble = dice, trouble
        self.ask_after_s = ask_after_s  # how long the robot stands before slices are asked for
        self.rules = AssignRules(guard_s=0.05, late_limit_s=120.0)
        self.clock_rules = ClockRules(prompt_delay_s=self.prompt_s, late_limit_s=120.0)
        self.offset_s = dice.uniform(-300, 300)  # our clock - the scanner's
        self.first_offset_s = self.offset_s
        self.drift = dice.uniform(-20e-6, 20e-6)
        self.jumped_s: float | None = None  # a jump that no prompt slice has shown yet
        self.number = 0
        self.uid = 0
        self.holds: list[HoldWindow] = []
        self.known: list[Known] = []
        self.outcome = Outcome()
        self.arrivals: list[tuple[float, int, Arrival]] = []
        self.jumps = sorted(dice.uniform(0, 300) for _ in range(trouble.jumps))
        sync = None
        if trouble.synced:
            error_s = dice.uniform(-0.2, 0.2)
            sync = Sync(self.offset_s + error_s, 0.25, 0.0)
        self.clock = ScannerClock(sync=sync)

    def run(self, n_holds: int) -> Outcome:
        now_s = 0.0
        self.warm_up()
        for place in range(n_holds):
            now_s += self.dice.uniform(0.3, 8.0)  # the robot moves
            now_s = self.stand(now_s, place)
        self.receive_until(now_s + 500, None)
        return self.outcome

    def warm_up(self) -> None:
        """A localizer comes promptly before anything else: it shows how late the clock is."""
        scan = self.scan(-10.0, 1.0)
        self.receive(replace(scan, received_s=-9.0 + self.dice.uniform(0.0, self.prompt_s)))

    def stand(self, settled_s: float, place: int) -> float:
        """One hold: scans are asked for until all slices are there or patience ends."""
        wanted = self.dice.randint(1, 3)
        hold = HoldWindow(place + 1, place // 3, settled_s, None, wanted)
        self.holds.append(hold)
        now_s = settled_s
        patience_s = self.dice.expovariate(1 / 30) + 0.5 if self.chance("impatience") else 400.0
        deadline_s = settled_s + patience_s
        while now_s < deadline_s and self.count(hold) < wanted:
            now_s = self.scan_some(now_s, wanted - self.count(hold))
            wait_s = self.dice.uniform(0.5, 15.0)
            now_s = self.receive_until(min(now_s + wait_s, deadline_s), (hold, wanted))
        now_s = max(now_s, settled_s + 0.01)
        self.holds[-1] = replace(hold, ended_at_s=now_s)
        if self.chance("extra_scans"):  # somebody scans while the robot moves
            self.send(self.scan(now_s + self.dice.uniform(-3.0, 3.0), self.dice.uniform(0.1, 3.0)))
        return now_s

    def scan_some(self, now_s: float, count: int) -> float:
        began_s = now_s + self.ask_after_s
        began_s += self.dice.uniform(-0.3 if self.chance("extra_scans") else 0.0, 3.0)
        for _ in range(count):
            length_s = self.dice.uniform(0.1, 8.0)
            self.send(self.scan(began_s, length_s))
            began_s += length_s + self.dice.uniform(0.0, 0.5)
        return began_s

    def chance(self, name: str) -> bool:
        return self.dice.random() < getattr(self.trouble, name)

    def count(self, hold: HoldWindow) -> int:
        return sum(known.hold_id == hold.hold_id for known in self.known)

    def scanner_s(self, our_s: float) -> float:
        while self.jumps and self.jumps[0] <= our_s:
            self.jumps.pop(0)
            size_s = self.dice.choice((0.3, 1.0, 5.0, 20.0, 60.0, 3600.0)) * self.dice.random()
            self.offset_s += self.dice.choice((-1, 1)) * size_s
            self.jumped_s = our_s
        return our_s - self.offset_s - self.drift * our_s

    def scan(self, began_s: float, length_s: float) -> Arrival:
        self.number += 1
        self.uid += 1
        from_s = self.scanner_s(began_s)
        end_s: float | None = from_s + length_s
        estimated = False
        if self.chance("no_duration"):
            end_s = None
        elif self.chance("estimated"):
            end_s, estimated = from_s + length_s * self.dice.uniform(1.0, 3.0), True
        slice_ = a_slice(
            sop_instance_uid=f"1.2.{self.uid}",
            interval=AcquisitionInterval(from_s, end_s, "AcquisitionDateTime", estimated),
            acquisition_number=1 if self.trouble.unnumbered else self.number,
        )
        return Arrival(began_s, began_s + length_s, began_s + length_s, slice_)

    def send(self, scan: Arrival) -> None:
        if self.chance("loss"):
            return
        delay_s = self.dice.uniform(0.0, self.prompt_s)
        if self.chance("late") and (self.jumped_s is None or self.trouble.late_after_jump):
            delay_s = self.dice.uniform(0.0, self.dice.choice((5.0, 30.0, 100.0, 400.0)))
        arrival = replace(scan, received_s=scan.true_to_s + delay_s)
        heapq.heappush(self.arrivals, (arrival.received_s, self.uid, arrival))

    def receive_until(self, limit_s: float, wanted: tuple[HoldWindow, int] | None) -> float:
        """Take what arrives; return when: at the limit, or as soon as the hold has its slices."""
        while self.arrivals and self.arrivals[0][0] <= limit_s:
            received_s, _, arrival = heapq.heappop(self.arrivals)
            self.receive(arrival)
            if wanted and self.count(wanted[0]) >= wanted[1]:
                return received_s
        return limit_s

    def receive(self, arrival: Arrival) -> None:
        slice_ = arrival.slice
        is_prompt = arrival.received_s - arrival.true_to_s <= self.prompt_s
        if self.jumped_s is not None and is_prompt and arrival.true_from_s >= self.jumped_s:
            self.jumped_s = None
        assert slice_.interval is not None
        seen = observe(self.clock, slice_.interval, arrival.received_s, self.clock_rules)
        self.clock = seen.clock
        bounds = self.bounds_of(arrival)
        holds = self.holds
        decision = assign(slice_, arrival.received_s, holds, self.known, bounds, self.rules)
        hold_id, code = None, ""
        if isinstance(decision, Assigned):
            hold_id = decision.hold_id
            self.check(arrival, hold_id)
        else:
            code = str(decision.code)
            where = self.outcome.set_aside
            where[code] = where.get(code, 0) + 1
            assert decision.text
            assert not isinstance(decision, Pending) or decision.code
        self.known.append(Known(slice_, arrival.received_s, hold_id, code))

    def bounds_of(self, arrival: Arrival) -> OffsetBounds | None:
        assert arrival.slice.interval is not None
        return self.clock.bounds_for(arrival.slice.interval, arrival.received_s, self.clock_rules)

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
